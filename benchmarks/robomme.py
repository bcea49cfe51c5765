"""Measure the official simulator: a rollout whose every frame is drawn, and those of `evaluate`.

    ROBOMME_PYTHON=robomme/bin/python python benchmarks/robomme.py

Each line plays the same episodes, in turns, in a process of its own: the demonstration, which a
reset plays, and `--steps` steps along its states.
"""

import argparse
import os
import statistics
import time

import numpy as np
from common import positive, print_machine, print_table

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.robomme.simulator import RoboMMESimulator

FAMILIES = ("VideoUnmask", "PatternLock")
"""Families with a gripper and with a stick whose demonstrations are the shortest."""

KINDS = {
    "all, as RoboMME itself": (("front", "wrist"), True, 1),
    "both cameras, before each 16 steps": (("front", "wrist"), False, 16),
    "front camera, before each 16 steps": (("front",), False, 16),
    "nothing (`replay`)": ((), False, 0),
}
"""What is drawn: cameras, whether of the demonstration too, and every how many steps."""


def play(simulator: RoboMMESimulator, kind: str, episode: str, steps: int) -> tuple[float, float]:
    """Return the seconds of a reset, and of as many steps."""
    _, demonstration, often = KINDS[kind]
    began = time.perf_counter()
    lesson, first, _ = simulator.reset(episode, demonstration=demonstration)
    ready = time.perf_counter()
    path = [*lesson.states, first.state]
    for number in range(steps):
        action = np.append(path[min(number, len(path) - 1)][:7], 1).astype(np.float32)
        observe = often > 0 and number % often == often - 1
        if simulator.step(action, observe=observe)[1] is not Status.ONGOING:
            break
    return ready - began, (time.perf_counter() - ready) / (number + 1)


def main() -> None:
    """Play, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", default=os.environ.get("ROBOMME_PYTHON"))
    parser.add_argument("--families", nargs="+", default=list(FAMILIES))
    parser.add_argument("--steps", type=positive, default=64, help="steps of a rollout, at most")
    parser.add_argument("--rounds", type=positive, default=3)
    given = parser.parse_args()
    print_machine()
    rows = []
    for family in given.families:
        taken: dict[str, list[tuple[float, float]]] = {kind: [] for kind in KINDS}
        for _ in range(given.rounds):
            for kind, (cameras, drawn, _) in KINDS.items():
                with RoboMMESimulator(given.python, cameras=cameras, subgoals=drawn) as simulator:
                    simulator.reset(f"{family}/test/1", demonstration=False)  # to be warm
                    taken[kind].append(play(simulator, kind, f"{family}/test/0", given.steps))
        whole = {}
        for kind, seconds in taken.items():
            reset, step = (statistics.median(column) for column in zip(*seconds, strict=True))
            whole[kind] = reset + given.steps * step
            ratio = whole[next(iter(KINDS))] / whole[kind]
            numbers = [f"{reset:.1f}", f"{1 / step:.1f}", f"{whole[kind]:.1f}", f"{ratio:.1f}"]
            rows.append([family, kind, *numbers])
    columns = ["<family", "<drawn", ">reset, s", ">steps/s", ">s a rollout", ">times as fast"]
    print_table(f"A reset and {given.steps} steps", columns, rows)


if __name__ == "__main__":
    main()
