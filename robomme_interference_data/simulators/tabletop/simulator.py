"""The embedded suite as a simulator: nine families in one environment, an episode at a time."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.lazy import load_extra
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.shifts import NO_SHIFT, Shift, parse_shift
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import (
    CAMERAS,
    Begun,
    EpisodeInfo,
    Observation,
    Simulator,
    choose_cameras,
)

from . import SUITE_VERSION
from .episodes import episode_ids, seed_of
from .families import known_scene, other_answer
from .family import Family

POLICIES = ("oracle", "guess", "recall")


class TabletopSimulator(Simulator):
    """See `Simulator`. Keep to one in a process: an executor's workers are for more.

    Args:
        cameras: Names of the cameras to draw; fewer are faster. Without any, episodes run several
            times as fast: for policies that do not look.
        shift: How the live scene differs from that of the demonstration: `none`, or such as
            `light:2`. It is only seen: states, judgements and built-in policies stay what they
            are.
    """

    name = "tabletop"
    about = (
        "tabletop, the simulator embedded in this project, which is not RoboMME: its results stand "
        "beside each other, not beside the paper's"
    )
    settings = ("cameras", "shift")
    shifts = True
    suite_version = SUITE_VERSION
    packages = ("mani-skill", "sapien")

    def __init__(self, cameras: Sequence[str] = CAMERAS, shift: str = NO_SHIFT):
        self._cameras = choose_cameras(cameras)
        wanted = parse_shift(shift)
        make: Any = load_extra(f"{__package__}.env", "TabletopEnv", "the tabletop simulator", "sim")
        # Pictures come straight from the cameras, so ManiSkill need not make observations too.
        self.env = make(render=bool(cameras), obs_mode="none")
        self.env.shift = wanted
        self.env.observe(self._cameras)  # the first picture is slow: shaders are compiled

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        """List the suite's episodes."""
        return episode_ids()

    @classmethod
    def other_answer(cls, episode: EpisodeId) -> int:
        """Return the number of another answer than an episode's own; they take turns."""
        return other_answer(episode)

    @classmethod
    def scene(cls, family: str, seed: int, difficulty: str) -> Family | None:
        """Return the scene of a seed, to be looked at and not played."""
        return known_scene(family, seed, difficulty)

    def act(self, policy: str, known: Mapping[int, str] | None = None) -> NDArray[np.float32]:
        """Return the next action of `oracle`, `guess` or `recall`; see `Simulator.act`."""
        self._running()
        if policy not in POLICIES:
            raise UnknownNameError.among("built-in policy", policy, self.name, POLICIES)
        return self.env.act(policy, known)

    def subgoal(self) -> Subgoal:
        """Return what is to be done next, as the scene stands; see `Simulator.subgoal`."""
        self._running()
        return self.env.subgoal()

    def follow_subgoal(self, subgoal: Subgoal | None) -> NDArray[np.float32]:
        """Return the next action of the script that obeys; see `Simulator.follow_subgoal`."""
        self._running()
        return self.env.follow_subgoal(subgoal)

    def views(self, shifts: Iterable[Shift]) -> Iterator[Observation]:
        """Yield what is seen now as under each of several shifts; see `Simulator.views`."""
        self._running()
        for shift in shifts:
            self.env.show(shift)
            yield self.env.observe(self._cameras)
        self.env.show(self.env.shift)

    def close(self) -> None:
        """Release the scene; further calls but `close` are errors."""
        super().close()
        self.env.close()

    def _begin(self, episode: EpisodeId, demonstration: bool) -> Begun:
        seed = seed_of(episode)
        self.env.family = episode.family
        self.env.demonstrated = self._cameras if demonstration else ()
        options = {} if episode.answer is None else {"answer": episode.answer}
        _, info = self.env.reset(seed=seed, options=options)
        about = EpisodeInfo(info["goals"], info["difficulty"], seed, self.name)
        return info["demonstration"], self.env.observe(self._cameras), about

    def _execute(
        self, episode: EpisodeId, action: NDArray[np.float32], observe: bool
    ) -> tuple[Observation, Status]:
        self.env._step_action(action)
        return self.env.observe(self._cameras if observe else ()), self.env.status
