"""Simulators as users write them, for `--simulator support.own_simulators:…`; most have a slip."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from support.simulator_doubles import Double
from support.worlds import World

from robomme_interference_data.errors import NoRendererError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import (
    Demonstration,
    EpisodeInfo,
    EpisodeStart,
    Observation,
)


class Played(Simulator):
    """Plays the episodes of `World` by the rules of a `Simulator`."""

    settings = ("cameras",)
    policies = ("oracle",)

    def __init__(self, cameras: tuple[str, ...] = ("front", "wrist")) -> None:
        self.world, self.drawn = World(), cameras

    def _act(self, policy: str, known: Mapping[int, str], answer: int | None) -> Any:
        return self.world.act(policy)

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        lesson, first, info = self.world.reset(str(episode), bool(frame_step))
        images = {name: image for name, image in first.images.items() if name in self.drawn}
        return lesson, Observation(images, first.state), info

    def _execute(
        self, episode: EpisodeId, action: Any, observe: bool
    ) -> tuple[Observation, Status]:
        return self.world.step(action, observe)


def slip(change: Callable[[Demonstration, Observation, EpisodeInfo], Any], **declared: Any) -> Any:
    """Return a simulator with a slip: something else begins than what `Played` returns."""

    def begin(self: Played, episode: EpisodeId, frame_step: int) -> Any:
        return change(*Played._begin(self, episode, frame_step))

    return type("Slip", (Played,), {"_begin": begin, **declared})


def image_slip(change: Callable[[Any], Any]) -> Any:
    """Return a simulator that changes its first images."""

    def changed(first: Observation) -> Observation:
        return replace(first, images={name: change(one) for name, one in first.images.items()})

    return slip(lambda lesson, first, info: (lesson, changed(first), info))


def shorter(first: Observation) -> Observation:
    return replace(first, state=first.state[:7])


Narrow = slip(lambda o, f, i: (replace(o, states=o.states[:, :7]), shorter(f), i))
Uneven = slip(lambda o, f, i: (o, shorter(f), i))
Doubled = slip(lambda o, f, i: (o, replace(f, state=f.state.astype(float)), i))
Unnamed = slip(
    lambda o, f, i: (o, replace(f, images={"top": f.images["front"]}), i),
    cameras=("front", "wrist"),
)
Blindfolded = slip(lambda o, f, i: (o, replace(f, images={}), i))
TwoArms = slip(lambda *given: given, action_size=14)  # and a lesson with actions of 8 values
Pair = slip(lambda o, f, i: (o, f))
Small = image_slip(lambda image: image[::2, ::2])
Floating = image_slip(lambda image: image / 255)


class Elsewhere(Played):
    """Plays another family only."""

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        return [EpisodeId("OpenDrawer", "test", 0)]


class Abstract(Simulator):
    """Forgets `_begin` and `_execute`."""


class Breaks(Played):
    """Breaks in every episode."""

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        raise RuntimeError("the arm fell off")


class Dark(Played):
    """Cannot draw on this machine."""

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        raise NoRendererError.without_vulkan("no driver")


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
