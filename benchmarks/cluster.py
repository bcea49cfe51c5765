"""Measure what a Ray cluster costs, on one machine, and reckon how long the full grid takes.

    python benchmarks/cluster.py --rollouts 100000

- *driver*: rollouts that do nothing, their rows written and shown as in a run; what they cost the
  driver.
- *overhead*: rollouts of `replay` on the embedded simulator, by worker processes and by as many
  workers of a cluster, from when all of them have started.
- *grid*: the paper's 25,200 rollouts on more and more workers, by a simulation of the queue: every
  worker takes the next one when it is done. How long each takes is drawn from `--reset` and
  `--steps-s`.
"""

import argparse
import heapq
import random
import time
from collections.abc import Sequence
from contextlib import closing
from itertools import cycle, islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import psutil
from common import Times, add_buffer_set, demo_buffers, positive, print_machine, print_table
from nothing import Nothing

from evaluate import seconds_a_rollout
from robomme_interference_data.constants import FAMILIES, MAX_STEPS
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.log import open_log
from robomme_interference_data.evaluate.run.plan import WorkItem, shuffle_work
from robomme_interference_data.evaluate.run.progress import RunProgress
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.process import Processes
from robomme_interference_data.runtime.ray_cluster import RayWorkers

CONDITIONS = ("no-history", "k0", "k1", "k3", "k7")
CELLS = 56
"""Of systems and conditions: twelve systems, less those that a position limit excludes."""

EPISODES = 50
WORKERS = (8, 64, 512)
NEEDED = 1000 / 60
"""Rows a second of 1,000 workers with a rollout a minute each."""


def items(count: int) -> list[WorkItem]:
    """Return so many rollouts."""
    each = -(-count // (len(FAMILIES) * len(CONDITIONS)))
    episodes = [EpisodeId(family, "test", index) for index in range(each) for family in FAMILIES]
    return [WorkItem(name, episode) for episode in episodes for name in CONDITIONS][:count]


def drive(rollouts: int, workers: int) -> list[str]:
    """Write the rows of rollouts that do nothing; return a row of the table."""
    config = RunConfig(policy="noop", buffer_set=Path(), out=Path())
    this, todo = psutil.Process(), items(rollouts)
    with (
        TemporaryDirectory() as folder,
        open_log(Path(folder), {}, "none") as log,
        RunProgress() as shown,
    ):
        shown.start(todo, [])
        task = Nothing(RunContext(config, "noop", SystemFacts(), "none", "none"))
        memory: list[int] = []
        with closing(RayWorkers(workers, "local").run(task, todo)) as outcomes:
            next(outcomes)
            began, used = time.perf_counter(), time.process_time()
            for number, outcome in enumerate(outcomes):
                log.append(outcome.value)
                shown.row(outcome.value, outcome.node)
                if number in (rollouts // 10, rollouts - 2):
                    memory.append(this.memory_info().rss)
            seconds, used = time.perf_counter() - began, time.process_time() - used
    each = used / (rollouts - 1)
    grown = (memory[-1] - memory[0]) / 1e6
    return [
        *(f"{rollouts:,}", f"{(rollouts - 1) / seconds:,.0f}", f"{1000 * each:.2f}"),
        *(f"{100 * each * NEEDED:.1f}%", f"{grown:+,.1f}"),
    ]


def durations(reset: tuple[float, float], steps_s: tuple[float, float]) -> dict[WorkItem, float]:
    """Return how long each rollout of a system takes: reset and steps, drawn by a fixed seed."""
    drawn = random.Random(0)
    return {
        item: drawn.uniform(*reset) + drawn.uniform(100, MAX_STEPS) / drawn.uniform(*steps_s)
        for item in items(len(FAMILIES) * EPISODES * len(CONDITIONS))
    }


def makespan(order: Sequence[float], workers: int) -> float:
    """Return when the last of tasks ends that idle workers take in order, in their seconds."""
    busy = [0.0] * workers
    for seconds in order:
        heapq.heapreplace(busy, busy[0] + seconds)
    return max(busy)


def main() -> None:
    """Measure, reckon, and print the tables."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rollouts", type=positive, default=100_000)
    parser.add_argument("--workers", type=positive, default=2)
    add_buffer_set(parser)
    parser.add_argument("--replayed", type=positive, default=48, help="rollouts of replay")
    parser.add_argument("--reset", type=float, nargs=2, default=(5.0, 27.0), help="s, least, most")
    parser.add_argument("--steps-s", type=float, nargs=2, default=(9.0, 13.0), help="the same")
    parser.add_argument("--rounds", type=positive, default=3)
    given: Any = parser.parse_args()
    given.buffer_set = given.buffer_set or demo_buffers()
    print_machine("ray")

    columns = ["<rollouts", ">rows/s", ">ms of the driver", ">of a core at 17 rows/s", ">MB grown"]
    title = f"Rollouts that do nothing, {given.workers} workers"
    print_table(title, columns, [drive(given.rollouts, given.workers)])

    ways = {"processes": Processes(given.workers), "ray": RayWorkers(given.workers, "local")}
    taken: dict[str, list[float]] = {name: [] for name in ways}
    for number in range(given.rounds):
        for name, executor in list(ways.items())[:: 1 if number % 2 else -1]:
            seconds = seconds_a_rollout(given.buffer_set, given.replayed, given.workers, executor)
            taken[name].append(seconds)
    times = Times(taken)
    rows = [
        [name, f"{times.median(name):.2f}", f"{times.ratio(name, 'processes'):.2f}"]
        for name in ways
    ]
    title = (
        f"`replay`, {given.replayed} rollouts, {given.workers} workers, once started; "
        f"medians of {given.rounds} rounds, aim ≤ 1.1"
    )
    print_table(title, ["<executor", ">s a rollout", ">ratio"], rows)

    each = durations(tuple(given.reset), tuple(given.steps_s))
    rollouts = CELLS * len(FAMILIES) * EPISODES
    plan = list(islice(cycle(each[item] for item in shuffle_work(each)), rollouts))
    rows = []
    for workers in WORKERS:
        ideal = sum(plan) / workers
        ours, longest = makespan(plan, workers), makespan(sorted(plan, reverse=True), workers)
        hours = [f"{one / 3600:,.2f}" for one in (ideal, ours, longest)]
        rows.append([f"{workers}", *hours, f"{ours / ideal:.3f}", f"{longest / ideal:.3f}"])
    columns = ["<workers", ">ideal, h", ">plan's order, h", ">longest first, h"]
    columns += [">plan's order / ideal", ">longest first / ideal"]
    title = f"The full grid, {len(plan):,} rollouts of {sum(plan) / len(plan):.0f} s on average"
    print_table(title, columns, rows)


if __name__ == "__main__":
    main()
