"""Simulators as users write them, for `--simulator support.own_simulators:…`; most have a slip."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from support.simulator_doubles import Double
from support.worlds import World

from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.base import Begun, Observation, Simulator


class Played(Simulator):
    """Plays the episodes of `World` by the rules of a `Simulator`."""

    settings = ("cameras",)
    policies = ("oracle",)

    def __init__(self, cameras: tuple[str, ...] = ("front", "wrist")) -> None:
        self.world, self.drawn = World(), cameras

    def _act(self, policy: str, known: Mapping[int, str], answer: int | None) -> Any:
        return self.world.act(policy)

    def _begin(self, episode: EpisodeId, every: int) -> Begun:
        lesson, first, info = self.world.reset(str(episode), bool(every))
        images = {name: image for name, image in first.images.items() if name in self.drawn}
        return lesson, self.shown(Observation(images, first.state)), info

    def shown(self, first: Observation) -> Observation:
        """Return the first live observation as the simulator shows it."""
        return first

    def _execute(
        self, episode: EpisodeId, action: Any, observe: bool
    ) -> tuple[Observation, Status]:
        return self.world.step(action, observe)


class Uneven(Played):
    """Has live states of 7 values after a lesson of 8."""

    def shown(self, first: Observation) -> Observation:
        return Observation(first.images, first.state[:7])


class Narrow(Uneven):
    """Has states of 7 values, consistently."""

    def _begin(self, episode: EpisodeId, every: int) -> Begun:
        lesson, first, info = super()._begin(episode, every)
        return replace(lesson, states=lesson.states[:, :7]), first, info


class Doubled(Played):
    """Has states of float64, as many environments do."""

    def shown(self, first: Observation) -> Observation:
        return Observation(first.images, first.state.astype(float))


class Blindfolded(Played):
    """Draws nothing that it is asked for."""

    def __init__(self, cameras: tuple[str, ...] = ()) -> None:
        super().__init__(())


class Small(Played):
    """Draws images of another size than the recorded ones."""

    def shown(self, first: Observation) -> Observation:
        return replace(first, images={name: one[::2, ::2] for name, one in first.images.items()})


class Floating(Played):
    """Draws images of floats."""

    def shown(self, first: Observation) -> Observation:
        return replace(first, images={name: one / 255 for name, one in first.images.items()})


class Unnamed(Played):
    """Draws a camera that it does not declare."""

    cameras = ("front", "wrist")

    def shown(self, first: Observation) -> Observation:
        return Observation({"top": first.images["front"]}, first.state)


class TwoArms(Played):
    """Declares actions of 14 values, and gives a lesson of 8."""

    action_size = 14


class Pair(Played):
    """Returns no facts about the episode."""

    def _begin(self, episode: EpisodeId, every: int) -> Any:
        return super()._begin(episode, every)[:2]


class Elsewhere(Played):
    """Plays another family only."""

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        return [EpisodeId("OpenDrawer", "test", 0)]


class Abstract(Simulator):
    """Forgets `_begin` and `_execute`."""


class Breaks(Played):
    """Breaks in every episode."""

    def _begin(self, episode: EpisodeId, every: int) -> Begun:
        raise RuntimeError("the arm fell off")


class Resetless:
    """Has no method `reset`, and no `act`."""

    step = close = print


def raising() -> Simulator:
    raise OSError("no licence for the physics engine")


class Listed(Double):
    """A simulator that gives whole episodes, with one camera of another name, at 20 Hz."""

    cameras = ("top",)
    fps = 20
    suite_version = 4
    settings = ("cameras",)

    def __init__(self, cameras: tuple[str, ...] = cameras) -> None:
        super().__init__(cameras, "listed")

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        return [EpisodeId("Press", split, n) for split in ("train", "test") for n in range(2)]


def make_listed(cameras: tuple[str, ...] = ("top",), speed: float = 1.0) -> Listed:
    return Listed(cameras)


def make_any():  # type: ignore[no-untyped-def]
    return Listed()


class Blind(Listed):
    """Draws nothing that it is asked for."""

    def __init__(self, cameras: tuple[str, ...] = ()) -> None:
        super().__init__(())
