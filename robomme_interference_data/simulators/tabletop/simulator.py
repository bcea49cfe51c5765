"""The embedded suite as a `Simulator`."""

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import VALUE_NAMES
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.lazy import load_extra
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.shifts import NO_SHIFT, Shift, parse_shift
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import (
    CAMERAS,
    EpisodeInfo,
    EpisodeStart,
    Observation,
    choose_cameras,
)
from robomme_interference_data.simulators.sapien_renderer import renderer_in

from . import SUITE_VERSION
from .episodes import episode_ids, further_ids, seed_of
from .families import known_scene, other_answer
from .family import Family


class TabletopSimulator(Simulator):
    """The simulator embedded in this project; see `Simulator`. Make only one per process.

    Args:
        cameras: Names of the cameras to render. Fewer are faster; without any, episodes run
            several times as fast.
        shift: How the live scene looks different from the demonstration: `none`, or a kind and
            strength such as `light:2`. It changes images only, not states, judgments or built-in
            policies.

    Raises:
        InvalidOptionError: A camera or the shift is unknown.
        MissingExtraError: The extra `sim` is not installed.
        NoRendererError: This machine cannot render.
    """

    name = "tabletop"
    state_names = VALUE_NAMES
    action_names = VALUE_NAMES
    about = (
        "tabletop, the simulator embedded in this project, which is not RoboMME: its results stand "
        "beside each other, not beside the paper's"
    )
    settings = ("cameras", "shift")
    shifts = True
    own_episodes = True
    try_out = False
    suite_version = SUITE_VERSION
    packages = ("mani-skill", "sapien")

    def __init__(self, cameras: Sequence[str] = CAMERAS, shift: str = NO_SHIFT):
        self._cameras = choose_cameras(cameras)
        parsed_shift = parse_shift(shift)
        make: Any = load_extra(f"{__package__}.env", "TabletopEnv", "the tabletop simulator", "sim")
        # Images come straight from the cameras, so ManiSkill makes no observations.
        self.env = make(render=bool(cameras), obs_mode="none")
        self.env.shift = parsed_shift
        self.env.observe(self._cameras)  # the first image is slow: shaders are compiled

    @classmethod
    def renderer(cls) -> str | None:
        """Return the renderer of this environment; see `Simulator.renderer`."""
        return renderer_in(sys.executable)

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        """Return the suite's episodes."""
        return episode_ids()

    @classmethod
    def extra_episodes(cls) -> list[EpisodeId]:
        """Return the suite's further train episodes."""
        return further_ids()

    @classmethod
    def other_answer(cls, episode: EpisodeId) -> int:
        """Return the number of another answer; over the episodes they occur equally often."""
        return other_answer(episode)

    @classmethod
    def scene(
        cls, family: str, seed: int, difficulty: str, recorded: str | None = None
    ) -> Family | None:
        """Return the scene of a seed; see `Simulator.scene`."""
        return known_scene(family, seed, difficulty)

    def subgoal(self) -> Subgoal:
        """Return the next subgoal; see `Simulator.subgoal`."""
        self._running()
        return self.env.subgoal()

    def follow_subgoal(self, subgoal: Subgoal | None) -> NDArray[np.float32]:
        """Return the next action towards a subgoal; see `Simulator.follow_subgoal`."""
        self._running()
        return self.env.follow_subgoal(subgoal)

    def views(self, shifts: Iterable[Shift]) -> Iterator[Observation]:
        """Yield the current observation under each shift; see `Simulator.views`."""
        self._running()
        for shift in shifts:
            self.env.show(shift)
            yield self.env.observe(self._cameras)
        self.env.show(self.env.shift)

    def close(self) -> None:
        """Release the scene; afterwards, every method except `close` raises."""
        super().close()
        self.env.close()

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        seed = seed_of(episode)
        self.env.family = episode.family
        self.env.demonstrated = self._cameras if frame_step else ()
        self.env.frame_step = frame_step or 1
        options = {} if episode.answer is None else {"answer": episode.answer}
        _, info = self.env.reset(seed=seed, options=options)
        about = EpisodeInfo(info["goals"], info["difficulty"], seed, self.name)
        return info["demonstration"], self.env.observe(self._cameras), about

    def _act(
        self, policy: str, known: Mapping[int, str], answer: int | None
    ) -> NDArray[np.float32]:
        return self.env.act(policy, known, answer)

    def _execute(
        self, episode: EpisodeId, action: NDArray[np.float32], observe: bool
    ) -> tuple[Observation, Status]:
        self.env._step_action(action)
        return self.env.observe(self._cameras if observe else ()), self.env.status
