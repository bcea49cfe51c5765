"""Sources that are simulators: they play each episode while it is read."""

from collections.abc import Generator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, override

from robomme_interference_data.constants import ACTION, STATE
from robomme_interference_data.errors import SimulatorCrashError, SourceError
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.shifts import SHIFTS
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import (
    Demonstration,
    Observation,
    check_drawn,
    choose_cameras,
)
from robomme_interference_data.simulators.registry import (
    find_simulator_python,
    make_simulator,
    simulator_arguments,
    simulator_class,
    simulator_renderer,
    simulator_versions,
)

from .base import Frame, Recording, Robot, Source, SourceEpisode


class SimulatorSource(Source):
    """The episodes that a simulator's class lists, those with demonstrations.

    An episode is the demonstration, the first live observation, and what the oracle does until the
    episode ends. RoboMME does not return the actions of its demonstrations.

    Args:
        name: Registered name of the simulator.
        every: Draw every n-th frame only; all others have no images.
        shifted: Give the first live observation under each shift instead of the episode.
        simulator_python: Its own interpreter, if it needs one; None for the default.
        simulator_options: Its own arguments, `NAME=VALUE`.
    """

    def __init__(
        self,
        name: str,
        every: int = 1,
        shifted: bool = False,
        simulator_python: str | None = None,
        simulator_options: Sequence[str] = (),
    ):
        self.name, self._every, self._shifted = name, every, shifted
        self._class = simulator_class(name)
        self.time_limit_s = self._class.episode_s
        self.worker_gb = self._class.worker_gb
        self.python = find_simulator_python(name, simulator_python)
        self._settings = {"subgoals": False, "python": self.python}
        self._options = tuple(simulator_options)
        simulator_arguments(name, {"cameras": (), **self._settings}, self._options)  # raises
        self._simulator: Simulator | None = None
        self._cameras: tuple[str, ...] = ()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_simulator": None}

    @cached_property
    def provenance(self) -> dict[str, Any]:  # type: ignore[override]
        """Versions of the simulator, its renderer on the machine that plans, and its options."""
        found: dict[str, Any] = {
            "kind": self.name,
            "versions": simulator_versions(self.name, self.python),
            "renderer": simulator_renderer(self.name, self.python),
        }
        if self._options:
            found["options"] = sorted(self._options)
        return found

    @override
    def episodes(self) -> list[SourceEpisode]:
        usual, further = self._class.episodes(), self._class.extra_episodes()
        if not usual:
            raise SourceError(
                f"the simulator {self.name} lists no episodes",
                "Define the class method `episodes`, and name the class as MODULE:CLASS, or a "
                "function with it as return annotation: see docs/how-to/another-benchmark.md.",
            )
        listed = [SourceEpisode(episode) for episode in usual]
        listed += [SourceEpisode(episode, further=True) for episode in further]
        return sorted(listed, key=lambda episode: episode.id)

    @override
    def contradict(self, episode: SourceEpisode) -> SourceEpisode:
        other = self._class.other_answer(episode.id)
        if other is None:
            return super().contradict(episode)
        return SourceEpisode(replace(episode.id, answer=other), episode.key)

    @override
    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        chosen = self._chosen(cameras)
        simulator = self._open(chosen)
        # Another object with these methods may know nothing of every n-th frame.
        every = self._every if isinstance(simulator, Simulator) else 1
        drawn = every if chosen and not self._shifted else 0
        lesson, first, info = simulator.reset(str(episode.id), demonstration=drawn)
        known = info.goals, info.seed, info.difficulty, info.simulator
        robot = self._robot()
        if self._shifted:
            views = simulator.views(SHIFTS)
            frames = (Frame(seen.images, seen.state, None, False) for seen in views)
            return Recording(*known, True, frames, robot=robot)
        check_drawn(lesson, first, chosen, every)
        frames = _play(simulator, lesson, first, chosen, every)
        return Recording(*known, True, frames, lesson.evidence, robot=robot, scene=lesson.scene)

    @override
    def close(self) -> None:
        if self._simulator is not None:
            self._simulator.close()
            self._simulator = None

    def _chosen(self, cameras: tuple[str, ...] | None) -> tuple[str, ...]:
        return choose_cameras(cameras, self._class.cameras)

    def _robot(self) -> Robot:
        names = {STATE: self._class.state_names, ACTION: self._class.action_names}
        known = {feature: values for feature, values in names.items() if values is not None}
        return Robot(fps=self._class.fps, names=known)

    def _open(self, cameras: tuple[str, ...]) -> Simulator:
        """Return the simulator with these cameras, which is kept for the next episode."""
        if self._simulator is None or self._cameras != cameras:
            self.close()
            settings = {"cameras": cameras, **self._settings}
            arguments = simulator_arguments(self.name, settings, self._options)
            self._simulator = make_simulator(self.name, **arguments)
            self._cameras = cameras
        return self._simulator


def _play(
    simulator: Simulator,
    lesson: Demonstration,
    first: Observation,
    cameras: Sequence[str],
    every: int,
) -> Generator[Frame]:
    recorded = len(lesson.actions) == len(lesson)
    number, seen, status = len(lesson), first, Status.ONGOING
    for index in range(number):
        drawn = cameras if index % every == 0 else ()
        images = {camera: lesson.images[camera][index // every] for camera in drawn}
        action = lesson.actions[index] if recorded else None
        yield Frame(images, lesson.states[index], action, True)
    while status is Status.ONGOING:
        images = {camera: seen.images[camera] for camera in cameras if number % every == 0}
        try:
            chosen = simulator.act("oracle")
        except SimulatorCrashError:  # no plan; a demonstration ends with this frame in any case
            yield Frame(images, seen.state, None, False)
            raise
        yield Frame(images, seen.state, chosen, False)
        number += 1
        seen, status = simulator.step(chosen, observe=number % every == 0)
