"""Measure the embedded simulator: speed, start of episodes, leaks.

    python benchmarks/simulators.py            # some minutes
    python benchmarks/simulators.py --episodes 500 --only leaks

Every part runs in a process of its own, one after the other, and prints a Markdown table. The
comparison with ManiSkill's PickCube uses the same cameras, picture sizes and loop, in turns.
"""

import argparse
import gc
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from common import in_fresh_process, positive, print_machine, print_table

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.simulators import make_simulator

EPISODE = "MoveCube/test/0"


def _pick_cube() -> Callable[[], None]:
    """Make ManiSkill's own PickCube, its cameras like ours, and return its step."""
    import gymnasium
    import mani_skill.envs  # noqa: F401, registers the environment
    from mani_skill.utils.sapien_utils import look_at

    from robomme_interference_data.simulators.tabletop.camera import (
        FRONT_EYE,
        FRONT_TARGET,
        FRONT_VIEW,
    )

    size = {"width": 256, "height": 256}
    front = {"pose": look_at(FRONT_EYE, FRONT_TARGET), "fov": FRONT_VIEW}
    env = gymnasium.make(
        "PickCube-v1",
        robot_uids="panda_wristcam",
        obs_mode="rgb",
        control_mode="pd_joint_pos",
        sim_backend="physx_cpu",
        render_backend="cpu",
        sensor_configs={"base_camera": {**size, **front}, "hand_camera": size},
    )
    env.reset(seed=0)
    rest = env.unwrapped.agent.keyframes["rest"].qpos[:7]
    action = np.append(rest, 1).astype(np.float32)
    return lambda: env.step(action) and None


def _tabletop() -> Callable[[], None]:
    simulator = make_simulator("tabletop")
    _, first, _ = simulator.reset(EPISODE)
    action = np.append(first.state[:7], 1).astype(np.float32)
    return lambda: simulator.step(action) and None


def _rate(step: Callable[[], None], steps: int) -> float:
    started = time.perf_counter()
    for _ in range(steps):
        step()
    return steps / (time.perf_counter() - started)


def speed(rounds: int) -> None:
    """Steps per second with front and wrist camera at 256×256, against PickCube, in turns."""
    ours, theirs = _tabletop(), _pick_cube()
    _rate(ours, 5), _rate(theirs, 2)
    pairs = [(_rate(ours, 40), _rate(theirs, 6)) for _ in range(rounds)]
    mine, stock = (statistics.median(column) for column in zip(*pairs, strict=True))
    ratio = statistics.median(a / b for a, b in pairs)
    rows = [["tabletop", f"{mine:.1f}"], ["PickCube-v1, same cameras", f"{stock:.1f}"]]
    rows.append([f"ratio (median of {rounds} rounds)", f"{ratio:.1f}"])
    print_table(_title(speed), ["<scene", ">steps/s"], rows)


def resets() -> None:
    """Seconds from an episode id to the first live observation, demonstration included.

    In brackets: seconds of processor time, which other work on the machine does not lengthen much.
    """
    simulator = make_simulator("tabletop")
    simulator.reset(EPISODE)
    rows = []
    for family in FAMILIES:
        seconds, frames = [], []
        for index in range(3):
            started, used = time.perf_counter(), time.process_time()
            lesson, _, _ = simulator.reset(f"{family}/test/{index}")
            wall, work = time.perf_counter() - started, time.process_time() - used
            seconds.append(f"{wall:.1f} s ({work:.1f})")
            frames.append(str(len(lesson)))
        rows.append([family, *seconds, ", ".join(frames)])
    columns = ["<family", ">easy", ">medium", ">hard", ">frames"]
    print_table(_title(resets), columns, rows)


def leaks(episodes: int) -> None:
    """Memory and open files of a process over many episodes of all families.

    Demonstrations are played without drawing them, to be through in minutes; the first live
    observation and ten steps are drawn.
    """
    simulator = make_simulator("tabletop")
    rows = []
    for number in range(episodes + 1):
        episode = f"{FAMILIES[number % len(FAMILIES)]}/train/{number // 9 % 100}"
        simulator.reset(episode, demonstration=False)
        for _ in range(10):
            simulator.step(simulator.act("oracle"))
        if number % max(episodes // 10, 1) == 0:
            gc.collect()
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            resident = pages * resource.getpagesize() / 2**20
            opened = len(list(Path("/proc/self/fd").iterdir()))
            rows.append([str(number), f"{resident:.0f}", str(opened)])
    columns = [">episodes", ">resident MiB", ">open files"]
    print_table(_title(leaks), columns, rows)


def _title(part: Callable[..., None]) -> str:
    return (part.__doc__ or "").splitlines()[0]


def main() -> None:
    """Run the parts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=("speed", "resets", "leaks"), help="run one part")
    parser.add_argument("--rounds", type=positive, default=5, help="rounds of the speed")
    parser.add_argument("--episodes", type=positive, default=100, help="episodes of the leak check")
    given = parser.parse_args()
    print_machine("mani-skill", "torch")
    for part, *options in ((speed, given.rounds), (resets,), (leaks, given.episodes)):
        if given.only in (None, part.__name__):
            in_fresh_process(part, *options)


if __name__ == "__main__":
    main()
