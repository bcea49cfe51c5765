"""Write robomme/ceilings.csv: how much of the evidence memories hold, from robomme/lessons.parquet.

It is what `ceiling` prints for the official buffers, without building them: a history is a lesson
and then units, of which the frames show nothing of the answer.
"""

import csv
import io
from collections import Counter, defaultdict
from functools import cache
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.simulators.robomme.recorded_scene import read_scene

FOLDER = Path(__file__).parent / "robomme"
MEMORIES = ("framesamp:32", "window:120@1", "window:60@2", "window:6@1")
UNITS = {"k0": 0, "k7": 7 * 32, "k15": 15 * 32, "k31": 31 * 32, "raw-k3": 3 * 256}
"""Condition to its frames after the lesson."""

MOMENTS = [*((condition, 0) for condition in UNITS), ("k7", 800)]
"""Conditions, each with the number of live frames seen so far."""

COLUMNS = ("memory", "condition", "live_frames", "family", "queries", "all_parts", "success")
ALL = "all"


def ceilings() -> str:
    """Return the table as CSV.

    `all_parts` counts the queries with a kept frame of every part of the answer; `success` is the
    mean chance of the ideal observer.
    """
    lessons = pq.read_table(FOLDER / "lessons.parquet").to_pylist()
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for spelled in MEMORIES:
        memory = Memory.parse(spelled)
        for condition, live in MOMENTS:
            later = UNITS[condition] + live
            queries = Counter[str]()
            held = Counter[str]()
            chances = defaultdict[str, float](float)
            for lesson in lessons:
                known, parts = _known(lesson, memory, later)
                for family in (_family(lesson), ALL):
                    queries[family] += 1
                    held[family] += len(known) == parts
                    chances[family] += _chance(lesson["episode_id"], tuple(known.items()))
            for family in (*FAMILIES, ALL):
                success = f"{chances[family] / queries[family]:.6f}"
                row = queries[family], held[family], success
                writer.writerow((spelled, condition, live, family, *row))
    return text.getvalue()


def _family(lesson: dict[str, Any]) -> str:
    return str(lesson["episode_id"]).partition("/")[0]


def _known(lesson: dict[str, Any], memory: Memory, later: int) -> tuple[dict[int, str], int]:
    """Return the parts of the answer that a memory shows, and how many there are.

    `later` is the number of frames between the lesson and the live observation.
    """
    kept = memory.earlier(lesson["lesson_frames"] + later)
    parts = {span["part"] for span in lesson["evidence"]}
    known = {
        span["part"]: span["text"]
        for span in lesson["evidence"]
        if any(span["start"] <= frame < span["stop"] for frame in kept)
    }
    return known, len(parts)


@cache
def _scenes() -> dict[str, Any]:
    lessons = pq.read_table(FOLDER / "lessons.parquet").to_pylist()
    return {
        lesson["episode_id"]: read_scene(_family(lesson), lesson["scene"], lesson["difficulty"])
        for lesson in lessons
    }


@cache
def _chance(episode: str, known: tuple[tuple[int, str], ...]) -> float:
    """Return the chance of a draw among the answers that agree with what is known."""
    return 1 / len(_scenes()[episode].agreeing(dict(known)))


if __name__ == "__main__":
    (FOLDER / "ceilings.csv").write_text(ceilings(), encoding="utf-8")
