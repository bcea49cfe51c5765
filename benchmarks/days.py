"""What a day costs to build, and how fast a query of it loads, against an ordinary buffer.

The embedded simulator plays one day, which is built as `build` does, in this process. Then the
front frames of a query's buffer are loaded and streamed, and those of its lesson with seven units
(k7) in turn. All numbers are processor time, so that other work on the machine weighs little.
"""

import argparse
import tempfile
import time
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

from common import Times, interleave, positive, print_machine, print_table, run

from robomme_interference_data import Buffer, BufferSet, load_buffer_set
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.lerobot_writer import (
    load_lerobot,
    require_lerobot,
)
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.sources import Frame, Recording, SourceEpisode
from robomme_interference_data.build_dataset.sources.day import DaySource
from robomme_interference_data.constants import DAYS, DEMONSTRATIONS, DISTRACTORS
from robomme_interference_data.data.query_sessions import SessionSource
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.days import DEFAULT_TASKS, ability_of, day_id, queries_of
from robomme_interference_data.storage.files import LocalFiles

MINUTES = 3
"""Aim for a day of 30 tasks."""

STREAM = "day-k2"
ORDINARY = "k7"


class Timed(DaySource):
    """Days, with the processor time that playing them takes.

    Attributes:
        seconds: Processor seconds until now.
        count: Frames until now.
    """

    seconds = 0.0
    count = 0

    def read(self, episode: SourceEpisode, cameras: tuple[str, ...] | None) -> Recording:
        """Open an episode."""
        began = time.process_time()
        recording = super().read(episode, cameras)
        self.seconds += time.process_time() - began
        return replace(recording, frames=self._each(recording.frames))

    def _each(self, frames: Generator[Frame]) -> Generator[Frame]:
        while True:
            began = time.process_time()
            frame = next(frames, None)
            self.seconds += time.process_time() - began
            if frame is None:
                return
            self.count += 1
            yield frame


def main() -> None:
    """Measure and print."""
    options = parse_options()
    require_lerobot()
    print_machine("av", "lerobot", "mani-skill")
    load_lerobot()  # takes seconds, once a build
    with tempfile.TemporaryDirectory(prefix="interference-days-") as folder:
        day = day_id(options.tasks, "test", options.day)
        query = asked(day)
        build(Path(folder), day, query)
        time_loading(load_buffer_set(folder, threads=1), query, options.rounds)


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", type=positive, default=DEFAULT_TASKS, help="tasks of the day")
    parser.add_argument("--day", type=int, default=0, help="number of the day")
    parser.add_argument("--rounds", type=positive, default=5, help="timed repetitions of loading")
    return parser.parse_args()


def asked(day: EpisodeId) -> EpisodeId:
    """Return the first query of a day that has one lesson."""
    return next(query for query in queries_of(day) if ability_of(query) == "recall")


def build(folder: Path, day: EpisodeId, query: EpisodeId) -> None:
    """Build a day, one of its queries, and units; print what the day took."""
    tasks = day.family.removeprefix("Day")
    made = {}
    for kind, chosen in (
        (DEMONSTRATIONS, {"queries": {query}}),
        (DISTRACTORS, {"split": "train", "numbers": (0,)}),
        (DAYS, {"queries": {day}}),
    ):
        filters: dict[str, Any] = chosen  # type: ignore[assignment]
        source = made[kind] = Timed("tabletop-day", kind, tasks)
        plan = DatasetPlan(kind, (source,), choose_episodes((source,), **filters), ("front",))
        began = time.process_time()
        build_dataset(plan, folder / kind, Serial(), WorkProgress(quiet=True))
        whole = time.process_time() - began
    played, frames = made[DAYS].seconds, made[DAYS].count
    rows = [
        [text, f"{seconds:.0f}", f"{1000 * seconds / frames:.1f}", aim]
        for text, seconds, aim in (
            ("playing", played, ""),
            ("encoding, decoding again, LeRobot's files", whole - played, ""),
            ("whole build", whole, f"≤ {60 * MINUTES}" if tasks == str(DEFAULT_TASKS) else ""),
        )
    ]
    title = f"A day of {tasks} tasks, {frames:,} frames of front, one process."
    print_table(title, ("<step", ">processor s", ">ms a frame", ">aim"), rows)
    files = {kind: LocalFiles(folder / kind) for kind in made}
    for _ in write_manifests(plan_manifests(files, (STREAM,), position_limit=None), folder):
        pass


def time_loading(buffer_set: BufferSet, query: EpisodeId, rounds: int) -> None:
    """Time loading and streaming both buffers; print the table."""
    planned = SessionSource(buffer_set.datasets).planned(query, parse_condition(ORDINARY))
    buffers = {
        STREAM: buffer_set.load(query, STREAM),
        ORDINARY: Buffer(planned, buffer_set.query(query), buffer_set.datasets),
    }

    def stream(name: str) -> None:
        for _part in buffers[name].stream(64, ("front",)):
            pass

    ways = {f"load {name}": lambda name=name: buffers[name].frames("front") for name in buffers}
    ways |= {f"stream {name}": lambda name=name: stream(name) for name in buffers}
    times = interleave(ways, rounds, time.process_time)
    rows = [row(times, way, buffers) for way in ("load", "stream")]
    frames = " and ".join(f"{len(buffer):,} of {name}" for name, buffer in buffers.items())
    title = f"Front frames of {query}, {frames}, one thread; medians of {rounds} rounds."
    columns = ("<way", f">{STREAM} ms a frame", f">{ORDINARY} ms a frame", ">ratio", ">aim")
    print_table(title, columns, rows)


def row(times: Times, way: str, buffers: dict[str, Buffer]) -> list[str]:
    """Return the cells of a way to load both buffers."""
    day, ordinary = f"{way} {STREAM}", f"{way} {ORDINARY}"
    per_frame = times.ratio(day, ordinary) * len(buffers[ORDINARY]) / len(buffers[STREAM])
    each = [1000 * times.median(f"{way} {name}") / len(buffers[name]) for name in buffers]
    return [way, f"{each[0]:.2f}", f"{each[1]:.2f}", f"{per_frame:.2f}", "≤ 1.1"]


if __name__ == "__main__":
    run(main)
