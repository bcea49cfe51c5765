"""What video files declare is bounded before FFmpeg sees them; sound ones are let through."""

import io
import itertools
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from support.buffer_sets import GOLDEN

from robomme_interference_data.errors import FormatError, InterferenceError
from robomme_interference_data.storage.untrusted.video_boxes import _check_declared, find_container
from robomme_interference_data.storage.video import iter_frames

VIDEO = GOLDEN / "demonstrations/videos/observation.images.front/chunk-000/file-000.mp4"


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
        ([box(b"moov", table(b"stsz", 100, 1 << 23))], "declares 8388608 frames"),
        ([box(b"moov", table(b"stz2", 8, 1 << 23))], "declares 8388608 frames"),
        ([table(b"trun", 1 << 22), table(b"trun", 1 << 22)], "declares 8388608 frames"),
        ([box(b"free", table(b"stsz", 100, 1 << 23))], "declares 8388608 frames"),
        ([box(b"moov", table(b"stsz", 1, 1 << 20), table(b"elst", 9))], "9 edits"),
        ([table(b"stco", 1 << 16), table(b"stsc", 1, 1, 1 << 17, 1)], "chunks of up to 131072"),
        ([table(b"stsc", 1 << 23)], "too long"),
        ([box(b"moov", table(b"elst", 0) * (1 << 18))], "boxes"),
        ([box(b"moov", box(b"cmov"))], "compressed"),
    ],
)
def test_what_declares_too_much(tmp_path: Path, boxes: list[bytes], message: str) -> None:
    with pytest.raises(FormatError, match=message):
        find_container(video(tmp_path / "a.mp4", *boxes))


def test_what_hides_behind_a_wrong_size_is_looked_at(tmp_path: Path) -> None:
    hidden = table(b"stsz", 100, 1 << 23)
    for size in (0, 1 << 30):
        wrong = struct.pack(">I", size) + b"moov" + hidden
        with pytest.raises(FormatError, match="declares"):
            find_container(video(tmp_path / "a.mp4", wrong))


PLACES = (
    b"abcd dinf edts free hoov ilst iprp jp2h mdia meta minf moof mvex schi sinf skip stbl stsd "
    b"traf trak tref udta uuid wave"
)


def test_wherever_ffmpeg_finds_a_table_it_is_looked_at() -> None:
    """Where FFmpeg reads a count of durations, a count of sizes is checked, too."""
    data, found, count = VIDEO.read_bytes(), 0, 1 << 23
    moov, trak = data.rindex(b"moov") - 4, data.rindex(b"trak") - 4
    size = int.from_bytes(data[trak : trak + 4])
    before_it, track = data[moov + 8 : trak], data[trak + 8 : trak + size]
    after = data[trak + size :]
    fields = (b"", bytes(4), bytes(8), bytes(4) + box(b"hdlr", bytes(8), b"mdir", bytes(12)))
    for name, before, outer in itertools.product(PLACES.split(), fields, (b"udta", None)):

        def hidden(evil: bytes, name: bytes = name, parts: Any = (before, outer)) -> io.BytesIO:
            inner = box(name, parts[0], evil)
            inner = box(parts[1], inner) if parts[1] else inner
            return io.BytesIO(
                data[:moov] + box(b"moov", before_it, box(b"trak", track, inner), after)
            )

        with suppress(av.error.FFmpegError):
            with av.open(hidden(table(b"stts", 1, count, 1)), format="mp4") as container:
                counts = [stream.frames for stream in container.streams]
            if count in counts:
                found += 1
                with pytest.raises(ValueError, match="declares"):
                    _check_declared(hidden(table(b"stsz", 100, count)))
    assert found > 20


def test_an_index_of_segments_raises(tmp_path: Path) -> None:
    """FFmpeg would jump to fragments that it names, even inside of frames."""
    path = tmp_path / "a.mp4"
    with av.open(str(path), "w", options={"movflags": "empty_moov+global_sidx"}) as container:
        add_video(container, 1)
    assert b"sidx" in path.read_bytes()
    with pytest.raises(FormatError, match="segment index.* ffmpeg"):
        list(iter_frames(path, 0, None, 10))


def test_frames_themselves_are_not_looked_at(tmp_path: Path) -> None:
    looks_like = box(b"mdat", table(b"stsz", 100, 1 << 23))
    assert find_container(video(tmp_path / "a.mp4", looks_like)) == "mp4"
    large = struct.pack(">I4sQ", 1, b"mdat", 16 + 8) + b"stsz" + bytes(4)
    assert find_container(video(tmp_path / "a.mp4", large)) == "mp4"


@pytest.mark.parametrize(("sound", "kind"), [("pcm_u8", "u8"), ("aac", "fltp")])
def test_a_video_with_sound_is_read_whatever_its_texts_hold(
    tmp_path: Path, sound: str, kind: str
) -> None:
    names = b"stsz....elst....trun....stsc....stco....cmov"
    path = tmp_path / "a.mov"
    with av.open(str(path), "w") as container:
        container.metadata["comment"] = container.metadata["title"] = names.decode()
        heard = container.add_stream(sound, rate=8000, layout="mono")
        add_video(container)
        silence = np.zeros((1, 1024), np.uint8 if kind == "u8" else np.float32)
        frame = av.AudioFrame.from_ndarray(silence, format=kind, layout="mono")
        frame.sample_rate = 8000
        container.mux(heard.encode(frame))
        container.mux(heard.encode(None))
    assert names in path.read_bytes()
    assert len(list(iter_frames(path, 0, None, 10, (16, 32, 3)))) == 20
    path.write_bytes(path.read_bytes() + box(b"free", names * 9))
    assert find_container(path) == "mp4"


@pytest.mark.parametrize(
    "start", [b"#EXTM3U\n", b"ffconcat version 1.0\n", b"GIF89a", b"%!PS", b""]
)
def test_other_formats_of_ffmpeg_are_left_aside(tmp_path: Path, start: bytes) -> None:
    (tmp_path / "a.mp4").write_bytes(start + bytes(100))
    with pytest.raises(FormatError, match="no MP4, Matroska or AVI file"):
        find_container(tmp_path / "a.mp4")


def test_a_codec_that_is_not_used_is_not_decoded(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("mpeg2video", rate=25)
        stream.pix_fmt, stream.height, stream.width = "yuv420p", 16, 32
        container.mux(stream.encode(av.VideoFrame(32, 16, "yuv420p")))
        container.mux(stream.encode(None))
    with pytest.raises(InterferenceError, match="not a readable video"):
        list(iter_frames(tmp_path / "a.mkv", 0, None, 25))
