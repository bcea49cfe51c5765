"""Small recordings in RoboMME's own layout."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from robomme_interference_data.build_dataset.sources import open_source

GOALS = ["watch the video, then do it", "do it again"]


def image(number: int, step: int, camera: str) -> np.ndarray:
    """A view `(4, 6, 3) uint8`, unlike any other."""
    seed = 1000 * number + 10 * step + (camera == "wrist")
    return np.random.default_rng(seed).integers(0, 256, (4, 6, 3), dtype=np.uint8)


def add_step(group: h5py.Group, number: int, step: int, *, demo: bool, stick: bool) -> None:
    """Write one time step as RoboMME's recorder does."""
    position = np.arange(7, dtype=np.float32) + np.float32(0.1) * step
    gripper = np.zeros(2) if stick else np.full(2, 0.04, np.float32)
    waypoint = np.zeros(7) if step % 2 else np.full(7, np.nan, np.float32)
    for name, value in {
        "obs/front_rgb": image(number, step, "front"),
        "obs/wrist_rgb": image(number, step, "wrist"),
        "obs/front_depth": np.zeros((4, 6, 1), np.int16),
        "obs/joint_state": position,
        "obs/gripper_state": gripper,
        "action/joint_action": np.append(position.astype(np.float64) + 1 / 3, -1.0),
        "action/waypoint_action": waypoint,
        "info/is_video_demo": demo,
        "info/simple_subgoal": "pick it",
    }.items():
        group[f"timestep_{step}/{name}"] = value


def record(
    folder: Path,
    family: str = "MoveCube",
    *,
    numbers: tuple[int, ...] = (0,),
    seeds: dict[int, int] | None = None,
    steps: int = 12,
    first: int = 0,
    demo: int = 5,
    stick: bool = False,
) -> Path:
    """Write a small recording; its keys come in no order that can be trusted."""
    folder.mkdir(exist_ok=True)
    path = folder / f"record_dataset_{family}.h5"
    with h5py.File(path, "w") as file:
        for number in reversed(numbers):
            group = file.create_group(f"episode_{number}")
            group["setup/seed"] = 14_000 + 100 * number if seeds is None else seeds[number]
            group["setup/difficulty"] = "hard"
            group["setup/task_goal"] = GOALS
            for step in reversed(range(first, first + steps)):
                add_step(group, number, step, demo=step < first + demo, stick=stick)
    return path


def edit(path: Path, change: Callable[[Any], Any]) -> None:
    """Change the first episode of a recording."""
    with h5py.File(path, "r+") as file:
        change(file["episode_0"])


def listed(folder: Path) -> list[Any]:
    return open_source(f"robomme-h5:{folder}").episodes()
