"""Made-up episodes, written as a source wants them: it must read them as they are."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.sources import Recording

SIZE = (16, 24)
MOVE = "see the video and move the cube in the same manner"
PEG = "see the video and insert the same peg at the same end"


@dataclass(frozen=True)
class Episode:
    """What was recorded.

    Attributes:
        goal: The goal in words.
        images: Camera name to frames, `(T, H, W, 3) uint8`.
        state: `(T, 8) float32`.
        action: `(T, 8) float32`, or None.
        lesson: Number of demonstration frames.
    """

    goal: str
    images: dict[str, NDArray[np.uint8]]
    state: NDArray[np.float32]
    action: NDArray[np.float32] | None
    lesson: int

    def __len__(self) -> int:
        return len(self.state)


def make_episode(
    seed: int,
    length: int,
    goal: str = MOVE,
    lesson: int = 0,
    *,
    cameras: tuple[str, ...] = ("front", "wrist"),
    size: tuple[int, int] = SIZE,
    actions: bool = True,
) -> Episode:
    """Make an episode of noise."""
    rng = np.random.default_rng(seed)
    images = {one: rng.integers(0, 256, (length, *size, 3), dtype=np.uint8) for one in cameras}
    state, action = rng.normal(size=(2, length, 8)).astype(np.float32)
    return Episode(goal, images, state, action if actions else None, lesson)


EPISODES = {
    "MoveCube/train/0": make_episode(1, 12, MOVE, 5),
    "MoveCube/train/1": make_episode(3, 7, MOVE, 0),
    "InsertPeg/train/0": make_episode(2, 9, PEG, 9),
}
"""In canonical order."""

SEEDS = {"MoveCube/train/0": 14_000, "MoveCube/train/1": 14_100, "InsertPeg/train/0": 13_000}
"""Their seeds, as RoboMME counts them."""


def check_recording(recording: Recording, expected: Episode, *, marked: bool = True) -> None:
    """Hold what a source reads against what was recorded, bit for bit."""
    frames = list(recording.frames)
    assert recording.goals == (expected.goal,)
    assert len(frames) == len(expected)
    for step, frame in enumerate(frames):
        assert sorted(frame.images) == sorted(expected.images)
        for camera, image in frame.images.items():
            assert image.dtype == np.uint8
            np.testing.assert_array_equal(image, expected.images[camera][step])
        assert frame.state.dtype == np.float32
        np.testing.assert_array_equal(frame.state, expected.state[step])
        assert (frame.action is None) == (expected.action is None)
        if frame.action is not None and expected.action is not None:
            assert frame.action.dtype == np.float32
            np.testing.assert_array_equal(frame.action, expected.action[step])
        assert frame.is_demonstration is (step < expected.lesson if marked else None)


# --- images --------------------------------------------------------------------------------------


def encode_image(image: NDArray[np.uint8], kind: str = "png") -> bytes:
    """Encode an image as `png` or `jpg`."""
    from PIL import Image

    out = io.BytesIO()
    Image.fromarray(image).save(out, {"png": "PNG", "jpg": "JPEG"}[kind])
    return out.getvalue()


def write_video(
    path: Path, frames: NDArray[np.uint8], codec: str = "ffv1", pix_fmt: str = "bgr0"
) -> Path:
    """Write frames `(T, H, W, 3) uint8` as a video of 10 frames a second."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        height, width = frames.shape[1:3]
        stream = container.add_stream(codec, 10, width=width, height=height, pix_fmt=pix_fmt)
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode(None))
    return path


def write_images(folder: Path, frames: NDArray[np.uint8]) -> Path:
    """Write frames as PNG images, numbered from 0; returns their folder."""
    folder.mkdir(parents=True)
    for number, frame in enumerate(frames):
        (folder / f"{number:06d}.png").write_bytes(encode_image(frame))
    return folder


# --- frames folders ------------------------------------------------------------------------------

Rows = list[dict[str, Any]]


def rows_of(name: str, episode: Episode, **values: Any) -> Rows:
    """Rows of an episode; a value may be a list with one value for each row."""
    vectors = {"state": episode.state}
    if episode.action is not None:
        vectors["action"] = episode.action
    return [
        {
            "episode_id": name,
            "frame_index": step,
            **{key: list(vector[step]) for key, vector in vectors.items()},
            "goal": episode.goal,
            **{key: v[step] if isinstance(v, list) else v for key, v in values.items()},
        }
        for step in range(len(episode))
    ]


def write_table(folder: Path, rows: Rows) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.Table.from_pylist(rows), folder / "frames.parquet")


def write_frames(folder: Path, episodes: dict[str, Episode]) -> None:
    """Write a frames folder: front as video, wrist as images."""
    rows: Rows = []
    for name, episode in episodes.items():
        write_video(folder / f"videos/front/{name}.mkv", episode.images["front"])
        write_images(folder / f"images/wrist/{name}", episode.images["wrist"])
        (folder / f"images/wrist/{name}/.DS_Store").write_bytes(b"hidden: passed over")
        shown = [step < episode.lesson for step in range(len(episode))]
        rows += rows_of(name, episode, is_demo=shown, seed=SEEDS[name], difficulty="hard")
    write_table(folder, rows)


# --- RoboMME's recordings ------------------------------------------------------------------------


def write_h5(
    folder: Path, episodes: dict[str, Episode], *, first: int = 0, fingers: int = 2
) -> None:
    """Write recordings as RoboMME does; keys come in no order that can be trusted.

    Args:
        folder: Where `record_dataset_<Family>.h5` goes.
        episodes: By id; the index counts from 0, whatever the file does.
        first: Number of the first episode and of the first step.
        fingers: Values of the gripper.
    """
    import h5py

    folder.mkdir(exist_ok=True)
    for name, episode in reversed(episodes.items()):
        family, _, index = name.split("/")
        with h5py.File(folder / f"record_dataset_{family}.h5", "a") as file:
            group = file.create_group(f"episode_{int(index) + first}")
            group["setup/seed"] = SEEDS[name]
            group["setup/difficulty"] = "hard"
            group["setup/task_goal"] = [episode.goal]
            for step in reversed(range(len(episode))):
                state = episode.state[step]
                values: dict[str, Any] = {
                    "obs/front_depth": np.zeros((4, 6, 1), np.int16),
                    "obs/joint_state": state[:7],
                    "obs/gripper_state": np.full(fingers, state[7]),
                    "info/is_video_demo": step < episode.lesson,
                }
                for camera, images in episode.images.items():
                    values[f"obs/{camera}_rgb"] = images[step]
                if episode.action is not None:
                    values["action/joint_action"] = episode.action[step].astype(np.float64)
                for place, value in values.items():
                    group[f"timestep_{step + first}/{place}"] = value
