"""Measure what the harness adds to a simulator loop, and what a second worker brings.

    python benchmarks/evaluate.py                    # on the demo's buffer set: some minutes
    python benchmarks/evaluate.py --buffer-set my-buffers --episodes MoveCube/test/0 --rounds 3

The bare loop takes the same actions in the same simulator and draws the same pictures, and does
nothing else: no history, no policy, no rows.
"""

import argparse
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import add_buffer_set, demo_buffers, interleave, positive, print_machine, print_table
from numpy.typing import NDArray

from robomme_interference_data import BufferSet, DecodedCache, load_buffer_set
from robomme_interference_data.evaluate import RunConfig, run_evaluation
from robomme_interference_data.evaluate.policies.policy import Policy, RolloutInfo
from robomme_interference_data.evaluate.rollout.rollout import run_rollout
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Executor
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.episode import Observation
from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator

CAMERAS = ("front", "wrist")
BARE, WITHOUT, K0, CACHED = "bare loop", NO_HISTORY, "k0", "k0 cached"


class Recorded(Policy):
    """Takes the oracle's actions of an episode again, and wants every frame, as servers do."""

    cameras = CAMERAS
    history_cameras = ("front",)
    every_frame = True

    def __init__(self, actions: NDArray[np.float32]):
        self._actions = actions
        self._next = 0

    def reset(self, info: RolloutInfo) -> None:
        """Begin again."""
        self._next = 0

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the next 16 actions at most, `(n, 8) float32`."""
        start, self._next = self._next, self._next + 16
        return self._actions[start : start + 16]

    def metadata(self) -> dict[str, Any]:
        """Return its name."""
        return {"policy": "recorded"}


class Clock:
    """Notes when each row comes."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def note(self, text: str) -> None:
        """Take what is said of the probe."""

    def start(self, items: Sequence[WorkItem], done: Sequence[Rollout]) -> None:
        """Take the plan."""

    def row(self, row: Rollout, node: str | None) -> None:
        """Note the time."""
        self.times.append(time.perf_counter())


def main() -> None:
    """Measure and print."""
    options = parse_options()
    folder = options.buffer_set or demo_buffers()
    buffer_set = load_buffer_set(folder, threads=1)
    print_machine("mani-skill", "av")
    rows = []
    with tempfile.TemporaryDirectory() as kept, TabletopSimulator(cameras=CAMERAS) as simulator:
        cached = load_buffer_set(folder, cache=DecodedCache(Path(kept)), threads=1)
        for name in options.episodes:
            episode = EpisodeId.parse(name)
            rows.append(overhead(episode, simulator, buffer_set, cached, options.rounds))
    print_table(
        "A rollout of the oracle's actions, front and wrist drawn at every step, one process; "
        f"medians of {options.rounds} rounds; ratios are against the bare loop, aim at k0 ≤ 1.05.",
        ("<episode", ">steps", ">bare s", ">no-history", ">k0", ">k0 cached", ">frames"),
        rows,
    )
    print_table(
        f"`replay`, {options.rollouts} rollouts; the first of each worker, which starts its "
        "simulator, is left out. Aim ≥ 1.8.",
        ("<workers", ">s a rollout", ">ratio"),
        workers(folder, options.rollouts),
    )


def parse_options() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    add_buffer_set(parser)
    parser.add_argument(
        "--episodes", nargs="+", default=["MoveCube/test/0", "PatternLock/test/0"], metavar="ID"
    )
    parser.add_argument("--rounds", type=positive, default=5)
    parser.add_argument("--rollouts", type=positive, default=24)
    return parser.parse_args()


def overhead(
    episode: EpisodeId,
    simulator: TabletopSimulator,
    buffer_set: BufferSet,
    cached: BufferSet,
    rounds: int,
) -> list[str]:
    """Time an episode's rollout bare and in the harness; return the cells of its line."""
    actions = oracle_actions(episode, simulator)
    policy = Recorded(actions)
    config = RunConfig("python:recorded", Path(buffer_set.location), Path("nowhere"))
    run = RunContext(config, "recorded", SystemFacts(), buffer_set.name, buffer_set.revision)

    def bare() -> None:
        simulator.reset(str(episode), demonstration=False)
        for action in actions:
            _, status = simulator.step(action)
        assert status is Status.SUCCESS

    def harness(condition: str, data: BufferSet) -> None:
        item = WorkItem(condition, episode)
        row = run_rollout(run, item, simulator=simulator, policy=policy, buffer_set=data)
        assert row.success and row.steps == len(actions)

    ways = {
        BARE: bare,
        WITHOUT: lambda: harness(WITHOUT, buffer_set),
        K0: lambda: harness(K0, buffer_set),
        CACHED: lambda: harness(K0, cached),
    }
    times = interleave(ways, rounds)
    return [
        str(episode),
        str(len(actions)),
        f"{times.median(BARE):.2f}",
        f"{times.ratio(WITHOUT, BARE):.3f}",
        f"{times.ratio(K0, BARE):.3f}",
        f"{times.ratio(CACHED, BARE):.3f}",
        str(len(buffer_set.load(episode, K0))),
    ]


def oracle_actions(episode: EpisodeId, simulator: TabletopSimulator) -> NDArray[np.float32]:
    """Return the actions with which the oracle solves an episode, `(n, 8) float32`."""
    simulator.reset(str(episode), demonstration=False)
    actions, status = [], Status.ONGOING
    while status is Status.ONGOING:
        actions.append(simulator.act("oracle"))
        _, status = simulator.step(actions[-1], observe=False)
    return np.stack(actions)


def seconds_a_rollout(
    buffer_set: Path, rollouts: int, workers: int, executor: Executor | None = None
) -> float:
    """Return what a rollout of `replay` takes, from the row by which all workers have started."""
    opened = load_buffer_set(buffer_set)
    conditions = tuple(name for name in opened.conditions if name != NO_HISTORY)
    families = opened.families[: max(1, rollouts // len(conditions))]
    clock = Clock()
    with tempfile.TemporaryDirectory() as folder:
        config = RunConfig(
            "replay",
            buffer_set,
            Path(folder),
            conditions=conditions,
            families=families,
            episodes="0",
            workers=workers,
            no_probe=True,
        )
        run_evaluation(config, progress=clock, executor=executor)
    counted = clock.times[workers - 1 :]  # most likely
    return (counted[-1] - counted[0]) / (len(counted) - 1)


def workers(buffer_set: Path, rollouts: int) -> list[list[str]]:
    """Time a run with one worker and with two; return the lines."""
    one, two = (seconds_a_rollout(buffer_set, rollouts, count) for count in (1, 2))
    return [["1", f"{one:.2f}", "1.00"], ["2", f"{two:.2f}", f"{one / two:.2f}"]]


if __name__ == "__main__":
    main()
