"""Measure the official simulator against RoboMME's own loop, in one run.

    ROBOMME_PYTHON=robomme/bin/python python benchmarks/robomme.py

Each line plays the same episode with the same actions, in turns, in a process of its own: the
demonstration, which a reset plays, and `--steps` steps along its states. Processor seconds are
those of RoboMME's interpreter and, for the simulator, of this process too.
"""

import argparse
import hashlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import positive, print_machine, print_table

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.robomme import maniskill_patches
from robomme_interference_data.simulators.robomme.simulator import RoboMMESimulator

FAMILIES = ("VideoUnmask", "PatternLock")
"""Families with a gripper and with a stick whose demonstrations are the shortest."""

OWN_LOOP, EVERY_IMAGE = "RoboMME's own loop", "every image"

KINDS = {
    EVERY_IMAGE: (("front", "wrist"), True, 1),
    "both cameras, before each 16 steps": (("front", "wrist"), False, 16),
    "front camera, before each 16 steps": (("front",), False, 16),
    "no image (`replay`)": ((), False, 0),
}
"""What is drawn: cameras, whether of the demonstration too, and every how many steps."""


@dataclass(frozen=True)
class Played:
    """What an episode took, in seconds; `images` is a digest of all images."""

    reset_s: float
    step_s: float
    processor_s: float
    images: str


def play_own_loop(python: str, family: str, steps: int) -> Played:
    """Play an episode with RoboMME alone, in its interpreter."""
    program = Path(__file__).with_name("robomme_loop.py")
    with tempfile.TemporaryDirectory() as folder:
        # -P: this file must not hide the package of the same name.
        arguments = [maniskill_patches.__file__, folder, family, str(steps)]
        command = [python, "-P", str(program), *arguments]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        sys.exit(done.stderr)
    return Played(**json.loads(done.stdout))


def play(python: str, kind: str, family: str, steps: int) -> Played:
    """Play it with the simulator of this package."""
    cameras, demonstration, often = KINDS[kind]
    with RoboMMESimulator(python, cameras=cameras, subgoals=kind == EVERY_IMAGE) as simulator:
        simulator.reset(f"{family}/test/1", demonstration=False)  # to be warm
        worked, began = processor_seconds(simulator.pid), time.perf_counter()
        lesson, first, _ = simulator.reset(f"{family}/test/0", demonstration=demonstration)
        ready = time.perf_counter()
        path, seen = [*lesson.states, first.state], [first]
        for number in range(steps):
            action = np.append(path[min(number, len(path) - 1)][:7], 1).astype(np.float32)
            observe = often > 0 and number % often == often - 1
            observation, status = simulator.step(action, observe=observe)
            seen.append(observation)
            if status is not Status.ONGOING:
                break
        ended, processor = time.perf_counter(), processor_seconds(simulator.pid) - worked
    digest = hashlib.sha256()
    if kind == EVERY_IMAGE:  # in the order of RoboMME's own loop
        for camera in cameras:
            for frame in (*lesson.images[camera], first.images[camera]):
                digest.update(frame)
        for observation in seen[1:]:
            for camera in cameras:
                digest.update(observation.images[camera])
    step_s = (ended - ready) / (number + 1)
    return Played(ready - began, step_s, processor, digest.hexdigest())


def processor_seconds(pid: int | None) -> float:
    """Return the processor seconds of this process and of another one (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    other = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return time.process_time() + other


def main() -> None:
    """Play, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", default=os.environ.get("ROBOMME_PYTHON"))
    parser.add_argument("--families", nargs="+", default=list(FAMILIES))
    parser.add_argument("--steps", type=positive, default=64, help="steps of a rollout, at most")
    parser.add_argument("--rounds", type=positive, default=3)
    given = parser.parse_args()
    python = RoboMMESimulator.interpreter(given.python).path
    print_machine()
    rows = []
    for family in given.families:
        taken: dict[str, list[Played]] = {name: [] for name in (OWN_LOOP, *KINDS)}
        for _ in range(given.rounds):
            taken[OWN_LOOP].append(play_own_loop(python, family, given.steps))
            for kind in KINDS:
                taken[kind].append(play(python, kind, family, given.steps))
        own = statistics.median(played.processor_s for played in taken[OWN_LOOP])
        for name, all_played in taken.items():
            reset, step, processor = (
                statistics.median(getattr(played, field) for played in all_played)
                for field in ("reset_s", "step_s", "processor_s")
            )
            numbers = [f"{reset:.1f}", f"{1 / step:.1f}", f"{processor:.1f}"]
            rows.append([family, name, *numbers, f"{processor / own:.2f}"])
        images = {played.images for name in (OWN_LOOP, EVERY_IMAGE) for played in taken[name]}
        rows.append([family, f"images {'equal' if len(images) == 1 else 'DIFFER'}", *[""] * 4])
    columns = ["<family", "<way", ">reset, s", ">steps/s", ">processor s", ">× own loop"]
    print_table(f"A reset and {given.steps} steps", columns, rows)


if __name__ == "__main__":
    main()
