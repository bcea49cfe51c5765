"""Small LeRobot datasets with the exact layouts of large public ones: real robots' recordings.

The features are those of the sets' own `info.json`, as far as they are public; pictures and numbers
are made up. `v3.0` is written by lerobot, `v2.1` and `v2.0` by hand.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray


def vector(size: int, dtype: str = "float32", names: Any = None) -> dict[str, Any]:
    """Return a column of vectors, as `info.json` describes it."""
    return {"dtype": dtype, "shape": [size], "names": names}


def video(height: int, width: int) -> dict[str, Any]:
    """Return a column of color video."""
    return {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"]}


TEXT = {"dtype": "string", "shape": [1], "names": None}
FLAG = {"dtype": "bool", "shape": [1], "names": None}

_COUNTERS = {
    "timestamp": vector(1),
    "frame_index": vector(1, "int64"),
    "episode_index": vector(1, "int64"),
    "index": vector(1, "int64"),
    "task_index": vector(1, "int64"),
}
_HSR_JOINTS = [
    "arm_lift",
    "arm_flex",
    "arm_roll",
    "wrist_flex",
    "wrist_roll",
    "hand",
    "pan",
    "tilt",
]
_ARM = [f"joint_{number}" for number in range(7)]


@dataclass(frozen=True)
class PublicSet:
    """A public set's layout.

    Attributes:
        version: Version of the layout.
        fps: Frames per second.
        robot: Its `robot_type`.
        features: Its columns, without those that LeRobot adds.
        columns: The setting `columns` that reads it.
        state: Number of values of a state as it is read then.
        cameras: Cameras as they are named then.
    """

    version: str
    fps: int
    robot: str | None
    features: dict[str, dict[str, Any]]
    columns: dict[str, str]
    state: int
    cameras: tuple[str, ...]


HSR = PublicSet(
    version="v3.0",
    fps=10,
    robot="hsr",
    features={
        "observation.image.head": video(480, 640),
        "observation.image.hand": video(480, 640),
        "observation.state": vector(8, names=_HSR_JOINTS),
        "observation.wrist.wrench": vector(6, names=[f"{f}_{x}" for f in "ft" for x in "xyz"]),
        "action.absolute": vector(8, names=_HSR_JOINTS),
        "action.relative": vector(11),
    },
    columns={"action": "action.absolute"},
    state=8,
    cameras=("hand", "head"),
)
"""AIRoA's Toyota HSR."""

DROID = PublicSet(
    version="v3.0",
    fps=15,
    robot="Franka",
    features={
        "is_first": FLAG,
        "language_instruction": TEXT,
        "observation.state.gripper_position": vector(1, names={"axes": ["gripper"]}),
        "observation.state.cartesian_position": vector(6, names={"axes": [*"xyzrpw"]}),
        "observation.state.joint_position": vector(7, names={"axes": _ARM}),
        "observation.state": vector(8, names={"axes": [*_ARM, "gripper"]}),
        "observation.images.wrist_left": video(180, 320),
        "observation.images.exterior_1_left": video(180, 320),
        "observation.images.exterior_2_left": video(180, 320),
        "action.gripper_position": vector(1, names={"axes": ["gripper"]}),
        "action.joint_velocity": vector(7, names={"axes": _ARM}),
        "action.original": vector(7, names={"axes": [*"xyzrpw", "gripper"]}),
        "action": vector(8, names={"axes": [*_ARM, "gripper"]}),
        "discount": vector(1),
        "camera_extrinsics.wrist_left": vector(6, names={"axes": [*"xyzrpw"]}),
        "is_episode_successful": FLAG,
    },
    columns={},
    state=8,
    cameras=("exterior_1_left", "exterior_2_left", "wrist_left"),
)
"""DROID 1.0.1 as LeRobot's own script converts it."""

AGIBOT = PublicSet(
    version="v2.1",
    fps=30,
    robot="a2d",
    features={
        "observation.images.head": video(480, 640),
        "observation.images.hand_left": video(480, 640),
        "observation.images.hand_right": video(480, 640),
        "observation.images.head_depth": {"dtype": "image", "shape": [480, 640, 1]},
        "observation.states.effector.position": vector(2, names={"motors": ["left", "right"]}),
        "observation.states.end.position": vector(6),
        "observation.states.end.orientation": vector(8),
        "observation.states.joint.position": vector(14),
        "observation.states.joint.current_value": vector(14),
        "observation.states.head.position": vector(2),
        "observation.states.waist.position": vector(2),
        "actions.effector.position": vector(2),
        "actions.joint.position": vector(14),
        "actions.head.position": vector(2),
        "actions.robot.velocity": vector(2),
    },
    columns={
        "state": "observation.states.joint.position+observation.states.effector.position",
        "action": "actions.joint.position+actions.effector.position",
    },
    state=16,
    cameras=("hand_left", "hand_right", "head"),
)
"""AgiBot World as it is converted to LeRobot."""

BRIDGE = PublicSet(
    version="v2.0",
    fps=5,
    robot="widowx",
    features={
        "observation.images.image_0": {
            "dtype": "video",
            "shape": [3, 256, 256],
            "names": ["channel", "height", "width"],
        },
        "observation.state": vector(8, "float64", {"motors": [*"xyzrpw", "pad", "gripper"]}),
        "action": vector(7, "float64", {"motors": [*"xyzrpw", "gripper"]}),
    },
    columns={},
    state=8,
    cameras=("image_0",),
)
"""Bridge in the older layout, with 64-bit numbers and the channels first."""

ROBOMME = PublicSet(
    version="v2.1",
    fps=10,
    robot="franka",
    features={
        "image": video(256, 256),
        "wrist_image": video(256, 256),
        "state": vector(8),
        "actions": vector(8),
    },
    columns={},
    state=8,
    cameras=("front", "wrist"),
)
"""RoboMME's recordings of its real robot: cameras of 256 × 256 and a state of 8 values.

The set is gated; the names are those of its simulated recordings.
"""

STATELESS = PublicSet(
    version="v2.1",
    fps=10,
    robot=None,
    features={"observation.images.top": video(64, 96), "action": vector(3)},
    columns={},
    state=0,
    cameras=("top",),
)
"""Recordings of a camera and of actions alone."""

SETS = {"hsr": HSR, "droid": DROID, "agibot": AGIBOT, "bridge": BRIDGE, "robomme": ROBOMME}


def write_public_set(
    root: Path, layout: PublicSet, lengths: Sequence[int], tasks: Sequence[str]
) -> Path:
    """Write a dataset of a layout, with a length and a task for each episode."""
    episodes = [_values(layout, number, length) for number, length in enumerate(lengths)]
    if layout.version == "v3.0":
        _write_with_lerobot(root, layout, episodes, tasks)
    else:
        _write_by_hand(root, layout, episodes, tasks)
    return root


def picture(episode: int, frame: int, height: int, width: int) -> NDArray[np.uint8]:
    """Return a picture, `(height, width, 3) uint8`, that shows episode and frame."""
    image = np.full((height, width, 3), 60, np.uint8)
    image[: height // 2, :, 0] = 40 + 60 * episode
    column = 8 * frame % (width - 16)
    image[height // 2 :, column : column + 16] = 230
    return image


def _values(layout: PublicSet, number: int, length: int) -> dict[str, Any]:
    """Return the columns of an episode without its pictures."""
    rng = np.random.default_rng(number)
    values: dict[str, Any] = {}
    for name, feature in layout.features.items():
        kind, shape = feature["dtype"], feature["shape"]
        if kind == "string":
            values[name] = ["do it"] * length
        elif kind == "bool":
            values[name] = np.zeros((length, 1), bool)
        elif kind.startswith("float"):
            values[name] = rng.normal(size=(length, *shape)).astype(kind)
        else:
            values[name] = [picture(number, frame, *_size(feature)) for frame in range(length)]
    return values


def _size(feature: dict[str, Any]) -> tuple[int, int]:
    shape = feature["shape"]
    return (shape[1], shape[2]) if shape[0] == 3 else (shape[0], shape[1])


def _write_with_lerobot(
    root: Path, layout: PublicSet, episodes: Sequence[dict[str, Any]], tasks: Sequence[str]
) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {
        name: feature | {"shape": tuple(feature["shape"])}
        for name, feature in layout.features.items()
    }
    dataset = LeRobotDataset.create(
        "someone/recordings", layout.fps, features, root=root, robot_type=layout.robot
    )
    for values, task in zip(episodes, tasks, strict=True):
        for frame in range(len(next(iter(values.values())))):
            dataset.add_frame(
                {name: column[frame] for name, column in values.items()} | {"task": task}
            )
        dataset.save_episode()
    dataset.finalize()


def _write_by_hand(
    root: Path, layout: PublicSet, episodes: Sequence[dict[str, Any]], tasks: Sequence[str]
) -> None:
    (root / "meta").mkdir(parents=True)
    every = [*dict.fromkeys(tasks)]
    lines = []
    for number, (values, task) in enumerate(zip(episodes, tasks, strict=True)):
        length = len(next(iter(values.values())))
        lines.append({"episode_index": number, "tasks": [task], "length": length})
        table: dict[str, Any] = {
            "timestamp": pa.array(np.arange(length) / layout.fps, pa.float32()),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, number),
            "index": np.arange(length),
            "task_index": np.full(length, every.index(task)),
        }
        for name, column in values.items():
            feature = layout.features[name]
            if feature["dtype"].startswith("float"):
                flat = column[:, 0] if feature["shape"] == [1] else list(column)
                table[name] = pa.array(flat)
            elif feature["dtype"] == "video":
                file = f"videos/chunk-000/{name}/episode_{number:06d}.mp4"
                _write_video(root / file, column, layout.fps)
        path = root / f"data/chunk-000/episode_{number:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(pa.table(table), path)
    numbered = [{"task_index": number, "task": task} for number, task in enumerate(every)]
    for name, rows in (("episodes", lines), ("tasks", numbered)):
        text = "".join(json.dumps(row) + "\n" for row in rows)
        (root / f"meta/{name}.jsonl").write_text(text)
    statistics = "stats.json" if layout.version == "v2.0" else "episodes_stats.jsonl"
    (root / "meta" / statistics).write_text("{}\n")
    info = {
        "codebase_version": layout.version,
        "robot_type": layout.robot,
        "total_episodes": len(episodes),
        "total_frames": sum(line["length"] for line in lines),
        "total_tasks": len(every),
        "total_chunks": 1,
        "chunks_size": 1000,
        "fps": layout.fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/"
        "episode_{episode_index:06d}.mp4",
        "features": layout.features | _COUNTERS,
    }
    (root / "meta/info.json").write_text(json.dumps(info))


def _write_video(path: Path, pictures: Sequence[NDArray[np.uint8]], fps: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width = pictures[0].shape[:2]
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", fps, width=width, height=height, pix_fmt="yuv420p")
        for image in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
