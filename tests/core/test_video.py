"""Spans of videos: equal to a plain decode for every codec, and never wrong when damaged."""

import os
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from robomme_interference_data.encode import CODECS
from robomme_interference_data.errors import (
    FormatError,
    InterferenceError,
    MissingFileError,
    TruncatedVideoError,
)
from robomme_interference_data.video import decode_into, iter_frames

COUNT, SIZE, FPS = 60, (64, 80), 10
pytestmark = pytest.mark.timeout(120)

RNG = np.random.default_rng(0)
PICTURE = np.repeat(np.repeat(RNG.integers(0, 256, (8, 10, 3)), 8, 0), 8, 1).astype(np.uint8)
SOURCE = np.stack([np.roll(PICTURE, 3 * step, 1) for step in range(COUNT)])
"""Frames that all differ, with edges, noise and a number in their corner."""
SOURCE[:, :16, :16] = (4 * np.arange(COUNT)).reshape(-1, 1, 1, 1)
SOURCE[:, 20:28, 20:28] = RNG.integers(0, 256, (COUNT, 8, 8, 3))

LOSSLESS = ("libaom-av1", "gbrp", dict(CODECS["av1-lossless"].options))
SVT = {"g": "33", "crf": "30", "preset": "12", "svtav1-params": "pred-struct=2"}
CODEC_CASES: dict[str, tuple[str, str, dict[str, str]]] = {
    "lossless.mp4": LOSSLESS,
    "ffv1.mkv": ("ffv1", "bgr0", {}),
    # Frames that refer to later ones, key frames far apart:
    "av1-reordered.mp4": ("libsvtav1", "yuv420p", SVT),
    "h264-reordered.mp4": ("libx264", "yuv444p", {"g": "25", "bf": "3"}),
    "hevc-reordered.mp4": (
        "libx265",
        "gbrp",
        {"x265-params": "lossless=1:bframes=4:keyint=20:log-level=none"},
    ),
}
EXACT = ("lossless.mp4", "ffv1.mkv", "hevc-reordered.mp4")


def write(
    path: Path,
    codec: str = "ffv1",
    pix_fmt: str = "bgr0",
    options: dict[str, str] | None = None,
    *,
    times: list[int] | None = None,
    time_base: Fraction = Fraction(1, FPS),
    **flags: str,
) -> Path:
    """Encode the source, or one frame for each of `times`, in units of `time_base`."""
    with av.open(str(path), "w", options=flags) as container:
        stream = container.add_stream(codec, rate=FPS, options=options or {})
        stream.pix_fmt = pix_fmt
        stream.height, stream.width = SIZE
        stream.time_base = stream.codec_context.time_base = time_base
        for image, time in zip(SOURCE, times or range(COUNT), strict=False):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = time, time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@dataclass(frozen=True)
class Video:
    path: Path
    frames: NDArray[np.uint8]


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Video]:
    """The source in every codec, with its plain sequential decode."""
    folder = tmp_path_factory.mktemp("videos")
    made = {}
    for name, case in CODEC_CASES.items():
        flags = {} if name == "lossless.mp4" else {"movflags": "faststart"}
        path = write(folder / name, *case, **flags)
        with av.open(str(path)) as container:
            frames = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
        made[name] = Video(path, np.stack(frames))
        assert len(frames) == COUNT
        assert np.array_equal(made[name].frames, SOURCE) == (name in EXACT)
    return made


# --- spans ---------------------------------------------------------------------------------------


@given(data=st.data())
@settings(max_examples=60)
def test_spans_equal_a_plain_decode(videos: dict[str, Video], data: st.DataObject) -> None:
    video = videos[data.draw(st.sampled_from(sorted(CODEC_CASES)))]
    start = data.draw(st.integers(0, COUNT))
    stop = data.draw(st.integers(start, COUNT))
    found = list(iter_frames(video.path, start, stop, FPS))
    assert len(found) == stop - start
    for frame, expected in zip(found, video.frames[start:stop], strict=True):
        assert frame.dtype == np.uint8
        np.testing.assert_array_equal(frame, expected)


@pytest.mark.parametrize("name", CODEC_CASES)
def test_every_single_frame(videos: dict[str, Video], name: str) -> None:
    """Just before, at and just after key frames: where seeking goes wrong if it does."""
    video = videos[name]
    for number in range(COUNT):
        (frame,) = iter_frames(video.path, number, number + 1, FPS)
        np.testing.assert_array_equal(frame, video.frames[number])


def test_decode_into(videos: dict[str, Video]) -> None:
    for video in videos.values():
        room = np.zeros((50, *SIZE, 3), np.uint8)
        target = room[10:40]
        assert decode_into(target, video.path, 21, FPS) is target
        np.testing.assert_array_equal(target, video.frames[21:51])
        assert not room[:10].any()
        assert not room[40:].any()


def test_all_frames_from_a_start_and_none(videos: dict[str, Video]) -> None:
    video = videos["lossless.mp4"]
    found = np.stack(list(iter_frames(video.path, 37, None, FPS)))
    np.testing.assert_array_equal(found, video.frames[37:])
    assert list(iter_frames(video.path, 5, 5, FPS)) == []


def test_frames_are_the_callers(videos: dict[str, Video]) -> None:
    video = videos["lossless.mp4"]
    found = []
    for frame in iter_frames(video.path, 0, 20, FPS):
        found.append(frame.copy())
        frame[:] = 0  # does not reach the decoder's pictures, which later frames refer to
    np.testing.assert_array_equal(np.stack(found), video.frames[:20])


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="counts open files in /proc")
def test_stopping_early_closes_the_file(videos: dict[str, Video]) -> None:
    path = videos["lossless.mp4"].path

    def opened() -> int:
        links = [Path("/proc/self/fd") / name for name in os.listdir("/proc/self/fd")]  # noqa: PTH208
        return sum(link.exists() and link.resolve() == path.resolve() for link in links)

    frames = iter_frames(path, 40, 50, FPS)
    next(frames)
    assert opened() == 1
    frames.close()
    assert opened() == 0


# --- what is not there, or not a video -----------------------------------------------------------


@pytest.mark.parametrize("span", [(COUNT - 1, COUNT + 1), (0, COUNT + 1), (COUNT, COUNT + 1)])
def test_frames_after_the_end(videos: dict[str, Video], span: tuple[int, int]) -> None:
    for video in videos.values():
        with pytest.raises(TruncatedVideoError, match=f"expected frames {span[0]} to") as caught:
            list(iter_frames(video.path, *span, FPS))
        assert str(video.path) in caught.value.message
    with pytest.raises(TruncatedVideoError):
        list(iter_frames(videos["ffv1.mkv"].path, 5000, 5010, FPS))


@pytest.mark.parametrize(
    "data", [b"", b"\0" * 5000, b"not a video " * 400, b"\x00\x00\x00\x20ftyp"]
)
def test_not_a_video(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "file.mp4"
    path.write_bytes(data)
    for place in (path, tmp_path):  # a folder is none either
        with pytest.raises(FormatError, match="is not a readable video"):
            next(iter_frames(place, 0, 1, FPS))
    with pytest.raises(MissingFileError, match=r"nowhere\.mp4 does not exist"):
        next(iter_frames(tmp_path / "nowhere.mp4", 0, 1, FPS))


def test_sound_alone(tmp_path: Path) -> None:
    path = tmp_path / "sound.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        sound.rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    with pytest.raises(FormatError, match="holds no video stream"):
        next(iter_frames(path, 0, 1, FPS))


@pytest.mark.parametrize(
    ("fps", "error"),
    [
        (5, FormatError),
        (9.5, FormatError),
        (24, FormatError),
        (20, TruncatedVideoError),  # a multiple of the rate leaves gaps
        (30, TruncatedVideoError),
    ],
)
def test_another_rate(videos: dict[str, Video], fps: float, error: type[Exception]) -> None:
    with pytest.raises(error, match="frames per second|frame 1 is missing"):
        list(iter_frames(videos["lossless.mp4"].path, 0, 20, fps))


def test_a_frame_left_out(tmp_path: Path) -> None:
    path = write(tmp_path / "gap.mkv", times=[0, 1, 2, 3, 6, 7, 8])
    assert len(list(iter_frames(path, 0, 4, FPS))) == 4
    assert len(list(iter_frames(path, 6, 9, FPS))) == 3
    with pytest.raises(TruncatedVideoError, match=r"frame 4 is missing \(the next one found is 6"):
        list(iter_frames(path, 2, 8, FPS))


def test_times_off_the_grid(tmp_path: Path) -> None:
    """Time bases in milliseconds cannot hold every frame time exactly."""
    base = Fraction(1, 1000)
    path = write(tmp_path / "rounded.mkv", times=[0, 101, 199, 300, 408], time_base=base)
    assert len(list(iter_frames(path, 0, 5, FPS))) == 5
    path = write(tmp_path / "uneven.mkv", times=[0, 100, 200, 340, 400], time_base=base)
    with pytest.raises(FormatError, match=r"lies at 0\.3400 s, between frames 3 and 4"):
        list(iter_frames(path, 0, 5, FPS))


def test_frames_of_another_size(videos: dict[str, Video]) -> None:
    path = videos["lossless.mp4"].path
    for read in (
        lambda: decode_into(np.empty((4, 64, 32, 3), np.uint8), path, 0, FPS),
        lambda: next(iter_frames(path, 0, 4, FPS, (64, 32, 3))),
    ):
        with pytest.raises(FormatError, match="80×64 pixels; .*says 32×64"):
            read()


# --- damaged files -------------------------------------------------------------------------------


def is_whole(path: Path, video: Video, start: int, stop: int) -> bool:
    """Whether a span of a damaged file comes whole; frames that come must be right ones."""
    found: list[Any] = []
    whole = False
    try:
        for frame in iter_frames(path, start, stop, FPS):
            found.append(frame)  # one by one: those before an error count
        whole = True
    except InterferenceError as error:
        assert str(path) in error.message
    assert len(found) == stop - start or not whole
    for frame, expected in zip(found, video.frames[start:stop], strict=False):
        np.testing.assert_array_equal(frame, expected)
    return whole


@pytest.mark.parametrize("name", ["lossless.mp4", "ffv1.mkv", "h264-reordered.mp4"])
def test_files_cut_anywhere(videos: dict[str, Video], name: str, tmp_path: Path) -> None:
    """Frames that still come are right ones, and the end is told: wherever the file is cut."""
    video = videos[name]
    data = video.path.read_bytes()
    path = tmp_path / f"cut{video.path.suffix}"
    # The header stands at one of the ends; it has a thousand bytes or two.
    cuts = {1, 7, 8, *range(0, 2000, 173), *range(len(data) - 2000, len(data), 173)}
    cuts |= set(range(0, len(data), len(data) // 12))
    whole = []
    for cut in sorted(cuts):
        path.write_bytes(data[:cut])
        whole += [cut for span in ((0, COUNT), (COUNT - 5, COUNT)) if is_whole(path, video, *span)]
    # The last frames come only where what is missing stands after them.
    assert all(cut > len(data) - 300 for cut in whole)


def test_a_header_cut_inside_does_not_end_the_process(
    videos: dict[str, Video], tmp_path: Path
) -> None:
    """FFmpeg opens some such files, with a stream without a codec."""
    video = videos["lossless.mp4"]
    data = video.path.read_bytes()
    path = tmp_path / "cut.mp4"
    whole = []
    for cut in range(data.index(b"moov"), len(data), 7):
        path.write_bytes(data[:cut])
        whole.append(is_whole(path, video, 0, 3))
    assert not any(whole[: len(whole) // 2])
    path.write_bytes(data.replace(b"VideoHandler", b"Video\xff\xfedler"))
    with pytest.raises(FormatError, match="is not a readable video"):
        next(iter_frames(path, 0, 1, FPS))
