"""Made-up episodes: written in any layout, a source must read them as they are."""

import io
from collections.abc import Generator
from dataclasses import dataclass, replace
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.sources import Frame, Recording

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
    cameras: tuple[str, ...] = ("front", "wrist"),
) -> Episode:
    """Make frames that all differ: noise, whose first pixel counts."""
    rng = np.random.default_rng(seed)
    images = {
        camera: rng.integers(0, 256, (length, *SIZE, 3), dtype=np.uint8) for camera in cameras
    }
    for frames in images.values():
        frames[:, 0, 0, 0] = np.arange(length) % 256
    state, action = rng.normal(size=(2, length, 8)).astype(np.float32)
    return Episode(goal, images, state, action, lesson)


def without_actions(episode: Episode) -> Episode:
    return replace(episode, action=None)


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
        if expected.action is None:
            assert frame.action is None
        else:
            np.testing.assert_array_equal(frame.action, expected.action[step])
        assert frame.is_demonstration is (step < expected.lesson if marked else None)


def marks(lesson: int | None, length: int) -> Generator[Frame]:
    """Yield frames that only say their number, as state, and whether they are the lesson."""
    for step in range(length):
        shown = None if lesson is None else step < lesson
        yield Frame({}, np.array([step], np.float32), None, shown)


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
