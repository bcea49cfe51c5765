"""Measure what a Ray cluster costs, on one machine, and reckon how long the full grid takes.

    python benchmarks/cluster.py --rollouts 100000

- *driver*: rollouts that do nothing, their rows written as in a run; what they cost the driver.
- *overhead*: tasks that compute, by worker processes and by as many workers of a cluster, both
  started before the clock.
- *grid*: the paper's 25,200 rollouts on more and more workers, by a simulation of the queue: every
  worker takes the next one when it is done. How long each takes is given (`--reset`, `--steps-s`)
  or drawn from it.
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
from timing import interleave, machine, positive, table

from robomme_interference_data.cluster import RayWorkers
from robomme_interference_data.constants import FAMILIES, MAX_STEPS
from robomme_interference_data.evaluate.config import Run, RunConfig
from robomme_interference_data.evaluate.log import open_log
from robomme_interference_data.evaluate.plan import WorkItem, shuffle_work
from robomme_interference_data.execution import Executor, Processes, Worker
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.rollouts import Rollout

CONDITIONS = ("no-history", "k0", "k1", "k3", "k7")
CELLS = 56
"""Of systems and conditions: twelve systems, less those that a position limit excludes."""

EPISODES = 50
WORKERS = (8, 64, 512)
NEEDED = 1000 / 60
"""Rows a second of 1,000 workers with a rollout a minute each."""


class Nothing:
    """Ends a rollout at once."""

    def __init__(self, run: Run[RunConfig]):
        self._run = run

    def __call__(self, task: WorkItem, worker: Worker) -> Rollout:
        """Return its row."""
        return self._run.row(
            task,
            **{"seed": 0, "difficulty": "easy", "goal": "", "status": "fail", "success": False},
            **{"steps": 0, "history_frames": 0, "lesson_frames": 0, "lesson_share": None},
        )


class Compute:
    """Keeps a processor busy."""

    def __call__(self, task: float, worker: Worker) -> None:
        """Compute for so many seconds of processor time."""
        end = time.process_time() + task
        while time.process_time() < end:
            pass


def items(count: int) -> list[WorkItem]:
    """Return so many rollouts."""
    each = -(-count // (len(FAMILIES) * len(CONDITIONS)))
    episodes = [EpisodeId(family, "test", index) for index in range(each) for family in FAMILIES]
    return [WorkItem(name, episode) for episode in episodes for name in CONDITIONS][:count]


def drive(rollouts: int, workers: int) -> list[str]:
    """Write the rows of rollouts that do nothing; return a row of the table."""
    config = RunConfig(policy="hold", split=Path(), out=Path())
    this, todo = psutil.Process(), items(rollouts)
    with TemporaryDirectory() as folder, open_log(Path(folder), {}, "none") as log:
        task = Nothing(Run(config, "hold", "none", "none"))
        memory: list[int] = []
        with closing(RayWorkers(workers, "local").run(task, todo)) as outcomes:
            log.append(next(outcomes).value)
            began, used = time.perf_counter(), time.process_time()
            for number, outcome in enumerate(outcomes):
                log.append(outcome.value)
                if number in (rollouts // 10, rollouts - 2):
                    memory.append(this.memory_info().rss)
            seconds, used = time.perf_counter() - began, time.process_time() - used
    each = used / (rollouts - 1)
    grown = (memory[-1] - memory[0]) / 1e6
    return [
        *(f"{rollouts:,}", f"{(rollouts - 1) / seconds:,.0f}", f"{1000 * each:.2f}"),
        *(f"{100 * each * NEEDED:.1f}%", f"{grown:+,.1f}"),
    ]


def started(executor: Executor, seconds: float, tasks: int, workers: int) -> float:
    """Return the seconds that tasks took, from when all workers had done one."""
    ended: list[float] = []
    for _ in executor.run(Compute(), [seconds] * (tasks + workers)):
        ended.append(time.perf_counter())
    return ended[-1] - ended[workers - 1]


def durations(reset: tuple[float, float], steps_s: float) -> dict[WorkItem, float]:
    """Return how long each rollout of a system takes: reset and steps, drawn by a fixed seed."""
    drawn = random.Random(0)
    return {
        item: drawn.uniform(*reset) + drawn.uniform(100, MAX_STEPS) / steps_s
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
    parser.add_argument("--tasks", type=positive, default=48)
    parser.add_argument("--seconds", type=float, default=1.0, help="of a task that computes")
    parser.add_argument("--reset", type=float, nargs=2, default=(5.0, 27.0), help="s, least, most")
    parser.add_argument("--steps-s", type=float, default=10.0, help="steps a second")
    parser.add_argument("--rounds", type=positive, default=3)
    given: Any = parser.parse_args()
    print(machine("ray"))

    columns = ["<rollouts", ">rows/s", ">ms of the driver", ">of a core at 17 rows/s", ">MB grown"]
    title = f"Rollouts that do nothing, {given.workers} workers"
    print(f"\n{table(title, columns, [drive(given.rollouts, given.workers)])}")

    taken: dict[str, list[float]] = {"processes": [], "ray": []}
    made = {"processes": Processes(given.workers), "ray": RayWorkers(given.workers, "local")}
    ways = {
        name: lambda name=name, executor=executor: taken[name].append(
            started(executor, given.seconds, given.tasks, given.workers)
        )
        for name, executor in made.items()
    }
    interleave(ways, given.rounds)
    both = zip(taken["ray"], taken["processes"], strict=True)
    ratio = sorted(one / other for one, other in both)[len(taken["ray"]) // 2]
    rows = [[name, f"{min(seconds):.1f}"] for name, seconds in taken.items()]
    rows.append(["ratio, median", f"{ratio:.2f}"])
    title = f"{given.tasks} tasks of {given.seconds:g} s, {given.workers} workers, once started"
    print(f"\n{table(title, ['<executor', '>s'], rows)}")

    each = durations(tuple(given.reset), given.steps_s)
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
    print(f"\n{table(title, columns, rows)}")


if __name__ == "__main__":
    main()
