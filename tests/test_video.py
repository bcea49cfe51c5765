"""Spans of videos: equal to a plain decode for every codec, and never wrong when damaged."""

import os
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.encode import CODECS, VideoEncoder
from robomme_interference_data.errors import (
    FormatError,
    MissingFileError,
    TruncatedVideoError,
)
from robomme_interference_data.video import decode_into, iter_frames

COUNT = 100
SIZE = (64, 80)
FPS = 10
pytestmark = pytest.mark.timeout(120)


@cache
def source() -> NDArray[np.uint8]:
    """Frames that all differ, with edges, noise and a number in their corner."""
    rng = np.random.default_rng(0)
    picture = np.repeat(np.repeat(rng.integers(0, 256, (8, 10, 3)), 8, 0), 8, 1).astype(np.uint8)
    frames = np.stack([np.roll(picture, 3 * step, 1) for step in range(COUNT)])
    frames[:, :16, :16] = (2 * np.arange(COUNT)).reshape(-1, 1, 1, 1)
    frames[:, 20:28, 20:28] = rng.integers(0, 256, (COUNT, 8, 8, 3))
    return frames


def write(
    path: Path,
    codec: str,
    pix_fmt: str,
    options: dict[str, str],
    times: list[int] | None = None,
    time_base: Fraction = Fraction(1, FPS),
    faststart: bool = False,
) -> Path:
    """Encode the source, or one frame for each of `times`, in units of `time_base`."""
    flags = {"movflags": "faststart"} if faststart else {}
    with av.open(str(path), "w", options=flags) as container:
        stream = container.add_stream(codec, rate=FPS, options=options)
        stream.pix_fmt = pix_fmt
        stream.height, stream.width = SIZE
        stream.time_base = stream.codec_context.time_base = time_base
        for image, time in zip(source(), times or range(COUNT), strict=False):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = time, time_base
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@dataclass(frozen=True)
class Video:
    path: Path
    frames: NDArray[np.uint8]


NAMES = {
    "lossless.mp4": ("libaom-av1", "gbrp", dict(CODECS["av1-lossless"].options), False),
    "lossless-header-first.mp4": (
        "libaom-av1",
        "gbrp",
        dict(CODECS["av1-lossless"].options),
        True,
    ),
    "ffv1.mkv": ("ffv1", "bgr0", {}, False),
    # Frames that refer to later ones, key frames far apart:
    "av1-reordered.mp4": (
        "libsvtav1",
        "yuv420p",
        {"g": "33", "crf": "30", "preset": "12", "svtav1-params": "pred-struct=2"},
        True,
    ),
    "h264-reordered.mp4": ("libx264", "yuv444p", {"g": "25", "bf": "3"}, True),
    "hevc-reordered.mp4": (
        "libx265",
        "gbrp",
        {"x265-params": "lossless=1:bframes=4:keyint=20:log-level=none"},
        False,
    ),
}
EXACT = ("lossless.mp4", "lossless-header-first.mp4", "ffv1.mkv", "hevc-reordered.mp4")


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Video]:
    """The source in every codec, with its plain sequential decode."""
    folder = tmp_path_factory.mktemp("videos")
    made = {}
    for name, (codec, pix_fmt, options, faststart) in NAMES.items():
        path = write(folder / name, codec, pix_fmt, options, faststart=faststart)
        with av.open(str(path)) as container:
            frames = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
        made[name] = Video(path, np.stack(frames))
        assert len(frames) == COUNT
    return made


def test_lossless_codecs_give_back_the_source(videos: dict[str, Video]) -> None:
    for name in EXACT:
        found = list(iter_frames(videos[name].path, 0, None, FPS))
        np.testing.assert_array_equal(np.stack(found), source())
    for name in set(NAMES) - set(EXACT):
        assert (videos[name].frames != source()).any()


@pytest.mark.parametrize("name", NAMES)
@given(data=st.data())
@settings(max_examples=30)
def test_spans_equal_a_plain_decode(
    videos: dict[str, Video], name: str, data: st.DataObject
) -> None:
    video = videos[name]
    start = data.draw(st.integers(0, COUNT))
    stop = data.draw(st.integers(start, min(COUNT, start + 40)))
    found = list(iter_frames(video.path, start, stop, FPS))
    assert len(found) == stop - start
    for frame, expected in zip(found, video.frames[start:stop], strict=True):
        assert frame.dtype == np.uint8
        np.testing.assert_array_equal(frame, expected)


@pytest.mark.parametrize("name", NAMES)
def test_every_single_frame(videos: dict[str, Video], name: str) -> None:
    """Just before, at and just after key frames: where seeking goes wrong if it does."""
    video = videos[name]
    for number in range(COUNT):
        (frame,) = iter_frames(video.path, number, number + 1, FPS)
        np.testing.assert_array_equal(frame, video.frames[number])


@pytest.mark.parametrize("name", NAMES)
def test_decode_into(videos: dict[str, Video], name: str) -> None:
    video = videos[name]
    room = np.zeros((60, *SIZE, 3), np.uint8)
    target = room[10:50]
    assert decode_into(target, video.path, 31, FPS) is target
    np.testing.assert_array_equal(target, video.frames[31:71])
    assert not room[:10].any()
    assert not room[50:].any()


def test_all_frames_from_a_start(videos: dict[str, Video]) -> None:
    video = videos["lossless.mp4"]
    found = np.stack(list(iter_frames(video.path, 77, None, FPS)))
    np.testing.assert_array_equal(found, video.frames[77:])


def test_empty_span_of_a_good_file(videos: dict[str, Video]) -> None:
    path = videos["lossless.mp4"].path
    assert list(iter_frames(path, 5, 5, FPS)) == []
    assert len(decode_into(np.empty((0, *SIZE, 3), np.uint8), path, 5, FPS)) == 0


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

    frames = iter_frames(path, 40, 90, FPS)
    next(frames)
    assert opened() == 1
    frames.close()
    assert opened() == 0


# --- what is not there, or not a video --------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(
    ("start", "stop"), [(99, 101), (0, 101), (100, 101), (101, 102), (5000, 5010)]
)
def test_frames_after_the_end(videos: dict[str, Video], name: str, start: int, stop: int) -> None:
    with pytest.raises(TruncatedVideoError, match=f"expected frames {start} to {stop - 1}"):
        list(iter_frames(videos[name].path, start, stop, FPS))


def test_truncation_names_file_and_frame(videos: dict[str, Video]) -> None:
    path = videos["lossless.mp4"].path
    with pytest.raises(TruncatedVideoError) as caught:
        list(iter_frames(path, 90, 120, FPS))
    assert caught.value.message == (
        f"{path}: the video ends before frame 100; expected frames 90 to 119"
    )
    assert "download or build it again" in str(caught.value.hint)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"nowhere\.mp4 does not exist"):
        next(iter_frames(tmp_path / "nowhere.mp4", 0, 1, FPS))


@pytest.mark.parametrize(
    "data", [b"", b"\0" * 5000, b"not a video " * 400, b"\x00\x00\x00\x20ftyp"]
)
def test_not_a_video(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "file.mp4"
    path.write_bytes(data)
    with pytest.raises(FormatError, match=r"file\.mp4 is not a readable video"):
        next(iter_frames(path, 0, 1, FPS))


def test_a_folder_is_not_a_video(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="is not a readable video"):
        next(iter_frames(tmp_path, 0, 1, FPS))


def test_sound_alone(tmp_path: Path) -> None:
    path = tmp_path / "sound.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), "s16", "mono")
        sound.rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    with pytest.raises(FormatError, match=r"sound\.wav holds no video stream"):
        next(iter_frames(path, 0, 1, FPS))


@pytest.mark.parametrize("fps", [5, 15, 9.5, 24])
def test_frames_between_the_steps_of_another_rate(videos: dict[str, Video], fps: float) -> None:
    with pytest.raises(FormatError, match=f"at {fps:g} frames per second"):
        list(iter_frames(videos["lossless.mp4"].path, 0, 20, fps))


@pytest.mark.parametrize("fps", [20, 30])
def test_a_multiple_of_the_rate_leaves_gaps(videos: dict[str, Video], fps: int) -> None:
    with pytest.raises(TruncatedVideoError, match="frame 1 is missing"):
        list(iter_frames(videos["lossless.mp4"].path, 0, 20, fps))


def test_a_frame_left_out(tmp_path: Path) -> None:
    path = write(tmp_path / "gap.mkv", "ffv1", "bgr0", {}, [0, 1, 2, 3, 6, 7, 8])
    assert len(list(iter_frames(path, 0, 4, FPS))) == 4
    assert len(list(iter_frames(path, 6, 9, FPS))) == 3
    with pytest.raises(TruncatedVideoError, match=r"frame 4 is missing \(the next one found is 6"):
        list(iter_frames(path, 2, 8, FPS))


def test_a_frame_off_the_grid(tmp_path: Path) -> None:
    times = [0, 100, 200, 340, 400]
    path = write(tmp_path / "uneven.mkv", "ffv1", "bgr0", {}, times, Fraction(1, 1000))
    with pytest.raises(FormatError, match=r"a frame lies at 0\.3400 s, between frames 3 and 4"):
        list(iter_frames(path, 0, 5, FPS))


def test_a_little_jitter_is_rounding(tmp_path: Path) -> None:
    """Time bases in milliseconds cannot hold every frame time exactly."""
    times = [0, 101, 199, 300, 408]
    path = write(tmp_path / "rounded.mkv", "ffv1", "bgr0", {}, times, Fraction(1, 1000))
    assert len(list(iter_frames(path, 0, 5, FPS))) == 5


def test_frames_of_another_size(videos: dict[str, Video]) -> None:
    path = videos["lossless.mp4"].path
    message = r"frames are 80×64 pixels; the dataset's info\.json says 32×64"
    with pytest.raises(FormatError, match=message):
        decode_into(np.empty((4, 64, 32, 3), np.uint8), path, 0, FPS)
    with pytest.raises(FormatError, match=message):
        next(iter_frames(path, 0, 4, FPS, (64, 32, 3)))


# --- damaged files --------------------------------------------------------------------------


def is_whole(path: Path, video: Video, start: int, stop: int) -> bool:
    """Whether a span of a damaged file comes whole; frames that come must be right ones."""
    found = []
    try:
        for frame in iter_frames(path, start, stop, FPS):
            found.append(frame)  # one by one: those before an error count
    except (TruncatedVideoError, FormatError) as error:
        assert str(path) in error.message
        whole = False
    else:
        assert len(found) == stop - start
        whole = True
    for frame, expected in zip(found, video.frames[start:stop], strict=False):
        np.testing.assert_array_equal(frame, expected)
    return whole


@pytest.mark.parametrize("name", NAMES)
def test_files_cut_anywhere(videos: dict[str, Video], name: str, tmp_path: Path) -> None:
    """Frames that still come are right ones, and the end is told: wherever the file is cut."""
    video = videos[name]
    data = video.path.read_bytes()
    path = tmp_path / f"cut{video.path.suffix}"
    cuts = set(range(0, len(data), len(data) // 40 + 1))
    # The header stands at one of the ends; it has a thousand bytes or two.
    cuts |= {1, 7, 8, *range(0, 2000, 83), *range(len(data) - 2000, len(data), 83)}
    whole = []
    for cut in sorted(cuts):
        path.write_bytes(data[:cut])
        whole += [cut for span in ((0, COUNT), (95, COUNT)) if is_whole(path, video, *span)]
        is_whole(path, video, 50, 60)
    # The last frames come only where what is missing stands after them.
    assert all(cut > len(data) - 300 for cut in whole)


def test_a_header_cut_inside_does_not_end_the_process(
    videos: dict[str, Video], tmp_path: Path
) -> None:
    """FFmpeg opens some such files, with a stream without a codec."""
    video = videos["lossless.mp4"]
    data = video.path.read_bytes()
    path = tmp_path / "cut.mp4"
    header = data.index(b"moov")
    whole = []
    for cut in range(header, len(data), 5):
        path.write_bytes(data[:cut])
        whole.append(is_whole(path, video, 0, 10))
    assert not any(whole[: len(whole) // 2])


def test_a_header_that_is_not_text(videos: dict[str, Video], tmp_path: Path) -> None:
    data = videos["lossless.mp4"].path.read_bytes()
    path = tmp_path / "damaged.mp4"
    assert b"VideoHandler" in data
    path.write_bytes(data.replace(b"VideoHandler", b"Video\xff\xfedler"))
    with pytest.raises(FormatError, match="is not a readable video"):
        next(iter_frames(path, 0, 1, FPS))


def test_the_projects_encoder_is_read_back(tmp_path: Path) -> None:
    for name, codec in CODECS.items():
        path = tmp_path / f"{name}.mp4"
        encoder = VideoEncoder(path, codec, FPS, *SIZE)
        for image in source()[:40]:
            encoder.add(image)
        encoder.close()
        found = np.stack(list(iter_frames(path, 0, 40, FPS, (*SIZE, 3))))
        assert np.array_equal(found, source()[:40]) == codec.exact
