"""Measure the embedded simulator: speed, start of episodes, workers, leaks.

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
from common import in_fresh_process, machine, positive, table

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Processes, Worker
from robomme_interference_data.simulators import Simulator, Status, make_simulator

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
    print(table(_title(speed), ["<scene", ">steps/s"], rows))


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
    print(table(_title(resets), columns, rows))


class _Play:
    """Plays 100 steps of episodes, each worker on a simulator of its own."""

    simulator: Simulator | None = None

    def __call__(self, episode: EpisodeId | None, worker: Worker) -> None:
        self.simulator = self.simulator or make_simulator("tabletop")
        if episode is None:  # only start up
            return
        self.simulator.reset(str(episode))
        for _ in range(100):
            if self.simulator.step(self.simulator.act("oracle"))[1] is not Status.ONGOING:
                break


def workers(episodes: int = 24) -> None:
    """Wall seconds of the same episodes with one worker and with two, their start-up left out."""
    todo = [EpisodeId("MoveCube", "train", index) for index in range(episodes)]
    taken = {1: 0.0, 2: 0.0}
    for count in (1, 2, 2, 1):  # so that neither has the better half of the time
        started = 0.0
        outcomes = Processes(count).run(_Play(), [*[None] * count, *todo])
        for number, _ in enumerate(outcomes):
            if number == 0:  # the others are up at about the same time; if later, it counts
                started = time.perf_counter()
        taken[count] += (time.perf_counter() - started) / (2 * episodes)
    rows = [[str(count), f"{seconds:.2f}"] for count, seconds in taken.items()]
    rows.append(["ratio", f"{taken[1] / taken[2]:.2f}"])
    print(table(_title(workers), ["<workers", ">seconds per episode"], rows))


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
    print(table(_title(leaks), columns, rows))


def _title(part: Callable[..., None]) -> str:
    return (part.__doc__ or "").splitlines()[0]


PARTS: dict[str, Callable[..., None]] = {
    part.__name__: part for part in (speed, resets, workers, leaks)
}


def main() -> None:
    """Run the parts."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=PARTS, help="run one part")
    parser.add_argument("--rounds", type=positive, default=5, help="rounds of the speed")
    parser.add_argument("--episodes", type=positive, default=100, help="episodes of the leak check")
    given = parser.parse_args()
    print(machine("mani-skill", "torch"))
    for name, part in PARTS.items():
        if given.only not in (None, name):
            continue
        print(flush=True)
        if part is workers:  # starts processes of its own
            part()
        else:
            options = {speed: [given.rounds], leaks: [given.episodes]}.get(part, [])
            in_fresh_process(part, *options)


if __name__ == "__main__":
    main()
