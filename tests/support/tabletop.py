"""A buffer set with the scenes, answers and evidence of `tabletop`, but synthetic frames.

The color of a frame encodes its content: red is the frame's number in the lesson, green the number
of the query, blue the part of the answer that the frame shows, from 1, or 0.
"""

import shutil
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from support.buffer_sets import build, plan_again

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.questions import make_questions, write_questions
from robomme_interference_data.build_dataset.sources import (
    Frame,
    Recording,
    Robot,
    Source,
    SourceEpisode,
)
from robomme_interference_data.constants import FAMILIES, FPS, STATE, VALUE_NAMES
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.evidence import spans_of_parts
from robomme_interference_data.simulators.tabletop import SUITE_VERSION
from robomme_interference_data.simulators.tabletop.camera import SIZE
from robomme_interference_data.simulators.tabletop.episodes import difficulty_of, seed_of, turn_of
from robomme_interference_data.simulators.tabletop.families import draw_episode
from robomme_interference_data.simulators.tabletop.family import Family

TABLETOP = Path(__file__).parents[1] / "golden" / "tabletop"
"""Two queries and a unit of each family, the queries with their questions; made by
`support/make_golden.py`."""

PROVENANCE = {
    "kind": "tabletop",
    "versions": {"tabletop": str(SUITE_VERSION), "mani-skill": "3.0.1", "sapien": "3.0.3"},
    "renderer": "llvmpipe (LLVM 15.0.6, 256 bits), driver llvmpipe Mesa 25.0.7, CPU",
}
"""What its sources record, the same on every machine."""

NUMBERS = (0, 2)
"""Of each family's queries: an easy one and a hard one."""

QUERIES = tuple(EpisodeId(family, "test", number) for family in FAMILIES for number in NUMBERS)
CONDITIONS = ("no-history", "k0", "k1")

LESSON, UNIT = 40, 249
"""Frames of a lesson, and of an episode that yields a unit."""

LIVE, NOBODY = 255, 254
"""Red of a first live observation; green of a frame of no query."""


def copy_tabletop(folder: Path) -> Path:
    """Copy the buffer set, to be changed."""
    return Path(shutil.copytree(TABLETOP, folder))


def scene_of(episode: EpisodeId) -> tuple[Family, Any]:
    """The scene of an episode, and its answer."""
    seed = seed_of(episode)
    scene = draw_episode(episode.family, seed, difficulty_of(seed))
    return scene, scene.answers[turn_of(seed, len(scene.answers))]


def shown(parts: int) -> list[tuple[int, ...]]:
    """Which part of the answer each frame shows: each part on two frames of three, then none."""
    return [(n // 3,) if n % 3 < 2 and n // 3 < parts else () for n in range(LESSON)]


@dataclass
class Drawn(Source):
    """The queries, and a train episode of each family."""

    provenance: dict[str, Any] = field(default_factory=lambda: PROVENANCE)

    def episodes(self) -> list[SourceEpisode]:
        train = [SourceEpisode(EpisodeId(family, "train", 0), NOBODY) for family in FAMILIES]
        test = [SourceEpisode(one, number) for number, one in enumerate(QUERIES)]
        return sorted([*train, *test], key=lambda one: one.id)

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        scene, answer = scene_of(episode.id)
        parts, seed = scene.parts(answer), seed_of(episode.id)
        seen = shown(len(parts))
        evidence = spans_of_parts(seen, parts)
        header = (scene.goal,), seed, difficulty_of(seed), "tabletop", True
        robot = Robot(FPS, names={STATE: VALUE_NAMES})
        return Recording(*header, self._frames(episode.key, seen), evidence, robot)

    def _frames(self, number: int, seen: Sequence[Sequence[int]]) -> Generator[Frame]:
        for place in range(UNIT):
            lesson = place < LESSON
            part = 1 + seen[place][0] if lesson and seen[place] else 0
            color = (place if lesson else LIVE, number, part)
            image = np.full((SIZE, SIZE, 3), color, np.uint8)
            yield Frame({"front": image}, np.zeros(8, np.float32), None, lesson)


def make_tabletop(root: Path) -> None:
    """Build the buffer set, and its questions."""
    build(root, "demonstrations", Drawn(), split="test")
    build(root, "distractors", Drawn(), split="train")
    plan_again(root, CONDITIONS)
    write_questions([*make_questions(load_buffer_set(root))], root)
