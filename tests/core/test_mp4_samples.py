"""What MP4 files declare is bounded before FFmpeg sees them; what writers make is read."""

import os
import struct
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from support.messages import raises

from robomme_interference_data.errors import FormatError, InterferenceError
from robomme_interference_data.storage.video.file import check_samples, find_container
from robomme_interference_data.storage.video.frames import iter_frames


def box(kind: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I", 8 + len(body)) + kind + body


def table(kind: bytes, *numbers: int) -> bytes:
    """A table after its version and flags."""
    return box(kind, bytes(4), *(struct.pack(">I", number) for number in numbers))


def video(path: Path, *boxes: bytes) -> Path:
    path.write_bytes(box(b"ftyp", b"isom", bytes(4)) + b"".join(boxes))
    return path


def add_video(container: Any, frames: int = 20) -> None:
    stream = container.add_stream("mjpeg", rate=10)
    stream.pix_fmt, stream.height, stream.width = "yuvj444p", 16, 32
    for _ in range(frames):
        container.mux(stream.encode(av.VideoFrame(32, 16, "yuvj444p")))
    container.mux(stream.encode(None))


@pytest.mark.parametrize("name", ["a.mp4", "a.mov", "a.mkv", "a.avi"])
@pytest.mark.parametrize("fragmented", [False, True])
def test_what_writers_make_is_read(tmp_path: Path, name: str, fragmented: bool) -> None:
    flags = {"movflags": "frag_keyframe+empty_moov"} if fragmented and name[2] == "m" else {}
    with av.open(str(tmp_path / name), "w", options=flags) as container:
        add_video(container)
    containers = {".mp4": "mp4", ".mov": "mp4", ".mkv": "matroska", ".avi": "avi"}
    assert find_container(tmp_path / name) == containers[(tmp_path / name).suffix]
    assert len(list(iter_frames(tmp_path / name, 0, None, 10, (16, 32, 3)))) == 20


@pytest.mark.parametrize(
    ("boxes", "message"),
    [
        ([box(b"moov", table(b"stsz", 100, 1 << 24))], "declares 16777216 frames"),
        ([box(b"moov", table(b"stz2", 8, 1 << 24))], "declares 16777216 frames"),
        ([table(b"trun", 1 << 23), table(b"trun", 1 << 23)], "declares 16777216 frames"),
        ([box(b"free", table(b"stsz", 100, 1 << 24))], "declares 16777216 frames"),
        ([box(b"moov", table(b"stsz", 1, 1 << 20), table(b"elst", 9))], "9 edits"),
        ([table(b"stco", 1 << 16), table(b"stsc", 1, 1, 1 << 17, 1)], "chunks of up to 131072"),
        (
            [b"\0\0stco64" + bytes(4) + b"\0\1\0\0", table(b"stsc", 1, 1, 1 << 17, 1)],
            "65537 chunks",
        ),
        ([box(b"moov", box(b"cmov"))], "compressed"),
        ([struct.pack(">I", 1 << 30) + b"moov" + bytes(16)], None),
        ([struct.pack(">I", 0) + b"moov" + table(b"stsz", 100, 1 << 24)], "declares"),
        ([struct.pack(">I", 1 << 30) + b"moov" + table(b"stsz", 100, 1 << 24)], "declares"),
        ([box(b"mdat", table(b"stsz", 100, 1 << 24))], None),
        ([struct.pack(">I4sQ", 1, b"mdat", 16 + 8) + b"stsz" + bytes(4)], None),
    ],
)
def test_declared_samples(tmp_path: Path, boxes: list[bytes], message: str | None) -> None:
    """Tables count wherever they are, even behind a wrong size, except in frames."""
    path = video(tmp_path / "a.mp4", *boxes)
    if message is None:
        check_samples(path)
    else:
        with raises(FormatError):
            check_samples(path)


def test_a_box_too_long_to_be_read(tmp_path: Path) -> None:
    path = video(tmp_path / "a.mp4", struct.pack(">I", 1 << 27) + b"moov")
    os.truncate(path, 1 << 28)
    with raises(FormatError):
        check_samples(path)


def test_an_index_of_segments_raises(tmp_path: Path) -> None:
    """FFmpeg would jump to fragments that it names, even inside of frames."""
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w", options={"movflags": "empty_moov+global_sidx"}) as container:
        add_video(container, 1)
    assert b"sidx" in path.read_bytes()
    with raises(FormatError):
        list(iter_frames(path, 0, None, 10))


def test_a_video_with_sound_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mov"
    with av.open(str(path), "w") as container:
        sound = container.add_stream("aac", rate=8000, layout="mono")
        add_video(container)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 8000
        container.mux(sound.encode(frame))
        container.mux(sound.encode(None))
    assert len(list(iter_frames(path, 0, None, 10, (16, 32, 3)))) == 20


@pytest.mark.parametrize(
    "start", [b"#EXTM3U\n", b"ffconcat version 1.0\n", b"GIF89a", b"%!PS", b""]
)
def test_other_formats_of_ffmpeg_are_left_aside(tmp_path: Path, start: bytes) -> None:
    (tmp_path / "a.mp4").write_bytes(start + bytes(100))
    with raises(FormatError):
        find_container(tmp_path / "a.mp4")


def test_a_codec_that_is_not_used_is_not_decoded(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("mpeg2video", rate=25)
        stream.pix_fmt, stream.height, stream.width = "yuv420p", 16, 32
        container.mux(stream.encode(av.VideoFrame(32, 16, "yuv420p")))
        container.mux(stream.encode(None))
    with raises(InterferenceError):
        list(iter_frames(tmp_path / "a.mkv", 0, None, 25))
