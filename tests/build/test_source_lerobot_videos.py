"""Videos of LeRobot datasets as sources: their frames must be those of the episode table."""

from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from support.lerobot_layouts import TABLE, edit_columns, write_lerobot
from support.messages import raises
from support.recordings import EPISODES, write_video

from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.errors import FormatError
from robomme_interference_data.storage.lerobot import dataset
from robomme_interference_data.storage.video.frames import read_times

FRONT = "observation.images.front"
FILE = f"videos/{FRONT}/chunk-000/file-000.mkv"
STARTS = f"videos/{FRONT}/from_timestamp"
IDS = list(EPISODES)


@pytest.fixture
def filmed(tmp_path: Path) -> Path:
    """Three episodes of 12, 7 and 9 frames in one video file per camera, at 10 Hz."""
    return write_lerobot(tmp_path / "filmed", stored="video")


def film(root: Path, frames: NDArray[np.uint8], file: str = FILE) -> None:
    write_video(root / file, frames)


def outcomes(root: Path, cameras: tuple[str, ...] | None = ("front",)) -> dict[str, bool]:
    """Read all episodes; return which have the recorded frames, and which are an error."""
    source = open_source(f"lerobot:{root}")
    found = {}
    for episode in source.episodes():
        name = str(episode.id)
        try:
            frames = [frame.images for frame in source.read(episode, cameras).frames]
        except FormatError as error:
            assert str(root) in error.message and error.hint
            assert f"episode {IDS.index(name)}" in error.message
            found[name] = False
            continue
        for camera in cameras or ("front", "wrist"):
            read_frames = np.stack([images[camera] for images in frames])
            np.testing.assert_array_equal(read_frames, EPISODES[name].images[camera])
        found[name] = True
    return found


ALL_FRAMES = np.concatenate([episode.images["front"] for episode in EPISODES.values()])
WITH_SURPLUS = np.concatenate(
    [np.append(e.images["front"], e.images["front"][-1:], 0) for e in EPISODES.values()]
)
EVERY, NONE = [True] * 3, [False] * 3


@pytest.mark.parametrize(
    ("frames", "starts", "readable"),
    [
        (ALL_FRAMES, [0, 1.2, 1.9], EVERY),
        (WITH_SURPLUS, [0, 1.2, 1.9], NONE),  # would show frames of the episode before
        (WITH_SURPLUS, [0, 1.3, 2.1], EVERY),
        (np.append(ALL_FRAMES, ALL_FRAMES[:1], 0), [0, 1.2, 1.9], NONE),
        (ALL_FRAMES[1:], [0, 1.2, 1.9], NONE),
        # Drifting start times: by a third of a frame, by nearly a frame, by far.
        (ALL_FRAMES, [0, 1.233, 1.933], EVERY),
        (ALL_FRAMES, [-0.033, 1.167, 1.867], EVERY),
        (ALL_FRAMES, list(map(Decimal, ("0.0", "1.2", "1.9"))), EVERY),
        (ALL_FRAMES, [0, 1.249, 1.99], [True, True, False]),
        (ALL_FRAMES, [0, 1.2, 101.9], [True, True, False]),
    ],
)
def test_table_and_video_must_agree(
    filmed: Path, frames: NDArray[np.uint8], starts: list[Any], readable: list[bool]
) -> None:
    film(filmed, frames)
    edit_columns(filmed / TABLE, **{STARTS: pa.array(starts)})
    assert outcomes(filmed) == dict(zip(IDS, readable, strict=True))


def test_the_video_of_one_episode_must_have_its_frames(tmp_path: Path) -> None:
    root = write_lerobot(tmp_path, version="v2.1", stored="video")
    file = "videos/image/chunk-000/episode_000001.mkv"
    film(root, EPISODES[IDS[1]].images["front"][:6], file)
    assert outcomes(root) == dict(zip(IDS, [True, False, True], strict=True))


def test_a_video_that_begins_late_shifts_all_episodes_but_the_first(filmed: Path) -> None:
    with av.open(str(filmed / FILE), "w") as container:
        stream = container.add_stream("ffv1", 10, width=24, height=16, pix_fmt="bgr0")
        for number, image in enumerate(ALL_FRAMES, 1):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, 10)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    assert not any(outcomes(filmed).values())
    # That is where LeRobot looks for them.
    edit_columns(filmed / TABLE, **{STARTS: [0.1, 1.3, 2.0]})
    assert all(outcomes(filmed).values())


@pytest.mark.parametrize(
    "harm",
    [
        {STARTS.replace("front", "wrist"): [None] * 3},
        {STARTS.replace("front", "wrist"): [0.05, 1.25, 1.95]},
        {STARTS.replace("front", "wrist").replace("from_timestamp", "file_index"): [None] * 3},
        None,
    ],
)
def test_a_camera_that_is_not_used_may_be_broken(
    filmed: Path, harm: dict[str, list[Any]] | None
) -> None:
    if harm is None:
        (filmed / FILE.replace("front", "wrist")).write_bytes(b"none")
    else:
        edit_columns(filmed / TABLE, **harm)
    assert all(outcomes(filmed).values())
    source = open_source(f"lerobot:{filmed}")
    with raises(FormatError):
        source.read(source.episodes()[0], ("wrist",))


def test_the_times_of_a_file_are_read_once(filmed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read_files = []
    monkeypatch.setattr(dataset, "read_times", lambda path: read_files.append(path) or times(path))
    times = read_times
    assert all(outcomes(filmed, None).values())
    assert sorted(path.parent.parent.name for path in read_files) == [
        FRONT,
        FRONT.replace("front", "wrist"),
    ]
