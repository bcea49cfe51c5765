"""Small days of a simulator without physics, under the name of `tabletop-day`.

Everything else is real: the source, the plan of the days, and what is built of them.
"""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.buffer_sets import plan_again
from support.simulator_doubles import Double

from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.sources import open_source, simulator
from robomme_interference_data.constants import UNITS, Unit
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.schema.days import DayPlan
from robomme_interference_data.schema.evidence import EvidenceSpan
from robomme_interference_data.schema.records import DaySpan
from robomme_interference_data.simulators.episode import (
    Demonstration,
    EpisodeInfo,
    EpisodeStart,
    Observation,
)

DATASETS = ("demonstrations", "distractors", "days")
NUMBERS = (1, 6)
"""Of the days: one of them looks different at first, and shows a lesson in pieces."""

CONDITIONS = ("no-history", "day-k0", "day-k2", "day-cut-k0", "day-cut-k2", "day-alone")
LESSON, CUT, IDLE, SIZE = 6, 3, 4, 32
"""Frames of a lesson, of its first piece, of idle time; pixels."""

_PIECES = {"lesson": (0, LESSON), "first": (0, CUT), "second": (CUT, LESSON)}
_SHOWN = {0: (1, 2), 1: (4, 6)}
"""Frames of a lesson that show the parts of its answer."""


def lesson(episode: EpisodeId) -> NDArray[np.uint8]:
    """The images of a lesson, `(6, 32, 32, 3)`: blue is the frame."""
    known = zlib.crc32(str(episode).encode())
    colors = [(known % 251, known // 251 % 251, frame) for frame in range(LESSON)]
    return np.stack([np.full((SIZE, SIZE, 3), color, np.uint8) for color in colors])


class DayDouble(Double):
    """A simulator that plays days: every lesson has the same length, and two parts."""

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        images = {name: lesson(episode)[:: frame_step or 1] for name in self.cameras}
        states = np.arange(LESSON, dtype=np.float32)[:, None].repeat(8, 1)
        evidence = tuple(EvidenceSpan(part, f"part {part}", *span) for part, span in _SHOWN.items())
        shown = Demonstration(images, states, np.ones((LESSON, 8), np.float32), evidence)
        info = EpisodeInfo(("goal",), "easy", episode.index, self.name)
        return shown, Observation(self._images(episode), np.full(8, 10, np.float32)), info

    def play_day(self, plan: DayPlan) -> "PlayedDouble":
        return PlayedDouble(plan, self.cameras)

    def _images(self, episode: EpisodeId) -> dict[str, np.ndarray]:
        image = lesson(episode)[0] + np.uint8([0, 0, 99])
        return dict.fromkeys(self.cameras, image)


@dataclass
class PlayedDouble:
    plan: DayPlan
    cameras: tuple[str, ...]
    spans: list[DaySpan] = field(default_factory=list)

    def frames(self) -> Iterator[tuple[Observation, NDArray[np.float32]]]:
        number = 0
        for task in self.plan.tasks:
            start, stop = _PIECES.get(task.part, (0, IDLE))
            white = np.full((task.transition, SIZE, SIZE, 3), 255, np.uint8)
            played = [(self.plan.day, "transition", white, ())]
            if task.episode is None:
                empty = np.zeros((IDLE, SIZE, SIZE, 3), np.uint8)
                played.append((self.plan.day, task.part, empty, ()))
            else:
                images = lesson(task.episode)[start:stop]
                shown = tuple(
                    (part, first, last)
                    for part, (first, last) in _SHOWN.items()
                    if start <= first < stop
                )
                played.append((task.episode, task.part, images, shown))
            for source, part, images, shown in played:
                moved = number - start
                evidence = tuple(
                    EvidenceSpan(seen, f"part {seen}", moved + first, moved + last)
                    for seen, first, last in shown
                )
                end = number + len(images)
                self.spans.append(DaySpan(source, part, task.shift, number, end, "", evidence))
                for image in images:
                    state = np.full(8, number, np.float32)
                    yield Observation(dict.fromkeys(self.cameras, image), state), state
                    number += 1


@contextmanager
def playing_days() -> Iterator[None]:
    """Let sources play on the simulator above."""
    with pytest.MonkeyPatch.context() as patch:
        made: Any = lambda name, **rest: DayDouble(name=name, **rest)  # noqa: E731
        patch.setattr(simulator, "make_simulator", made)
        patch.setattr(simulator, "simulator_renderer", lambda *rest: "none")
        patch.setattr(simulator, "simulator_versions", lambda *rest: {"tabletop-day": "1"})
        yield


def plan_of(
    kind: str, numbers: tuple[int, ...] = NUMBERS, cameras: tuple[str, ...] = ("front",)
) -> DatasetPlan:
    """The plan of a dataset of days of eight tasks."""
    source = open_source("tabletop-day:8", kind=kind)
    split, chosen = ("train", (0,)) if kind in UNITS else ("test", numbers)
    episodes = choose_episodes((source,), split=split, numbers=chosen)
    return DatasetPlan(kind, (source,), episodes, cameras=cameras, unit=Unit(4, 2))


def build_days(root: Path, *further: str, **options: Any) -> None:
    """Build a buffer set of two days, with further datasets; options are those of `plan_of`."""
    with playing_days():
        for kind in (*DATASETS, *further):
            plan = plan_of(kind, **options)
            build_dataset(plan, root / kind, Serial(), WorkProgress(quiet=True))
    plan_again(root, CONDITIONS)
