"""Spans of videos: equal to a plain decode for every codec, and never wrong when damaged."""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from support.messages import raises

from robomme_interference_data.errors import FormatError, InterferenceError, MissingFileError
from robomme_interference_data.storage.video.encode import CODECS
from robomme_interference_data.storage.video.frames import iter_frames, read_times

COUNT, SIZE, FPS = 60, (64, 80), 10
pytestmark = pytest.mark.timeout(120)

RNG = np.random.default_rng(0)
PICTURE = np.repeat(np.repeat(RNG.integers(0, 256, (8, 10, 3)), 8, 0), 8, 1).astype(np.uint8)
SOURCE = np.stack([np.roll(PICTURE, 3 * step, 1) for step in range(COUNT)])
"""Frames that all differ, with edges, noise and a number in their corner."""
SOURCE[:, :16, :16] = (4 * np.arange(COUNT)).reshape(-1, 1, 1, 1)
SOURCE[:, 20:28, 20:28] = RNG.integers(0, 256, (COUNT, 8, 8, 3))

SVT = {"g": "33", "crf": "30", "preset": "12", "svtav1-params": "pred-struct=2"}
X265 = {"x265-params": "lossless=1:bframes=4:keyint=20:log-level=none"}
CASES: dict[str, tuple[str, str, dict[str, str]]] = {
    "lossless.mp4": ("libaom-av1", "gbrp", dict(CODECS["av1-lossless"].options)),
    "ffv1.mkv": ("ffv1", "bgr0", {}),
    # Frames that refer to later ones, key frames far apart:
    "av1-reordered.mp4": ("libsvtav1", "yuv420p", SVT),
    "h264-reordered.mp4": ("libx264", "yuv444p", {"g": "25", "bf": "3"}),
    "hevc-reordered.mp4": ("libx265", "gbrp", X265),
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
    for name, case in CASES.items():
        flags = {} if name == "lossless.mp4" else {"movflags": "faststart"}
        path = write(folder / name, *case, **flags)
        with av.open(str(path)) as container:
            frames = [f.to_ndarray(format="rgb24") for f in container.decode(video=0)]
        made[name] = Video(path, np.stack(frames))
        assert np.array_equal(made[name].frames, SOURCE) == (name in EXACT)
    return made


# --- spans ---------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_every_start_and_the_whole(videos: dict[str, Video], name: str) -> None:
    """Just before, at and just after key frames: where seeking goes wrong if it does."""
    video = videos[name]
    for start in range(COUNT):
        stop = min(COUNT, start + 3)
        found = np.stack(list(iter_frames(video.path, start, stop, FPS)))
        np.testing.assert_array_equal(found, video.frames[start:stop])
    for start in (0, 37):
        found = np.stack(list(iter_frames(video.path, start, None, FPS)))
        np.testing.assert_array_equal(found, video.frames[start:])
    assert list(iter_frames(video.path, 5, 5, FPS)) == []


def test_frames_are_the_callers(videos: dict[str, Video]) -> None:
    video = videos["lossless.mp4"]
    found = []
    for frame in iter_frames(video.path, 0, 20, FPS):
        found.append(frame.copy())
        frame[:] = 0  # does not reach the decoder's pictures, which later frames refer to
    np.testing.assert_array_equal(np.stack(found), video.frames[:20])


# --- missing frames and files that are no videos -------------------------------------------------


@pytest.mark.parametrize("start", [0, COUNT - 1, COUNT, 5000])
def test_frames_after_the_end(videos: dict[str, Video], start: int) -> None:
    for video in videos.values():
        with raises(FormatError):
            list(iter_frames(video.path, start, max(start, COUNT) + 1, FPS))


@pytest.mark.parametrize("data", [b"", b"\0" * 5000, b"\x00\x00\x00\x20ftyp"])
def test_not_a_video(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "file.mp4").write_bytes(data)
    for name in ("file.mp4", "."):  # a folder is none either
        with raises(FormatError):
            next(iter_frames(tmp_path / name, 0, 1, FPS))
    with raises(MissingFileError):
        next(iter_frames(tmp_path / "nowhere.mp4", 0, 1, FPS))


@pytest.mark.parametrize("fps", [5, 9.5, 24, 20, 30])  # a multiple of the rate leaves gaps
def test_another_rate(videos: dict[str, Video], fps: float) -> None:
    with raises(FormatError):
        list(iter_frames(videos["lossless.mp4"].path, 0, 20, fps))


def test_a_gap(tmp_path: Path) -> None:
    path = write(tmp_path / "gap.mkv", times=[0, 1, 2, 3, 6, 7, 8])
    assert len(list(iter_frames(path, 6, 9, FPS))) == 3
    with raises(FormatError):
        list(iter_frames(path, 2, 8, FPS))
    assert len(read_times(path)) == 7
    with raises(FormatError):
        read_times(path).first_number(FPS)


MILLISECONDS = Fraction(1, 1000)


@pytest.mark.parametrize(
    ("times", "even"),
    [
        ([0, 101, 199, 300, 408], True),  # rounded
        ([0, 100, 249, 251, 400], True),  # each within half a frame of its number
        ([40, 140, 200, 340, 440], True),
        ([0, 100, 260, 300, 400], False),  # no frame 2, and two frames 3
        ([0, 100, 200, 200 + 51, 400], True),
        ([0, 40, 200, 300, 400], False),  # two frames 0
        ([60, 160, 260, 360, 460], False),  # begins with frame 1
    ],
)
def test_the_nearest_number_must_have_one_frame(
    tmp_path: Path, times: list[int], even: bool
) -> None:
    path = write(tmp_path / "uneven.mkv", times=times, time_base=MILLISECONDS)
    if even:
        assert read_times(path).first_number(FPS) == 0
        np.testing.assert_array_equal(list(iter_frames(path, 0, 5, FPS)), SOURCE[:5])
        return
    with raises(FormatError):
        list(iter_frames(path, 0, 5, FPS))


@pytest.mark.parametrize("fps", [Fraction(25, 2), Fraction(1, 2), Fraction(30000, 1001), 30, 60])
@pytest.mark.parametrize("name", ["a.mkv", "a.mp4"])
def test_fractional_rates_in_milliseconds(tmp_path: Path, name: str, fps: Fraction) -> None:
    """Containers round times; 100 s later a rate rounded to whole frames would be far off."""
    times = [round(1000 * number / fps) for number in (*range(10), 3000)]
    codec = ("ffv1", "bgr0") if name == "a.mkv" else ("libx264rgb", "rgb24", {"qp": "0"})
    path = write(tmp_path / name, *codec, times=times, time_base=MILLISECONDS)
    np.testing.assert_array_equal(list(iter_frames(path, 0, 10, float(fps))), SOURCE[:10])
    [last] = iter_frames(path, 3000, 3001, float(fps))
    np.testing.assert_array_equal(last, SOURCE[10])


def test_avi_is_counted(tmp_path: Path) -> None:
    """It has no times: FFmpeg invents them, and for frames in another order than decoded, wrongly.

    What it has is a number of each piece of data, which shows frames that were dropped.
    """
    path = write(tmp_path / "a.avi", "libx264", "yuv444p", {"bf": "3", "qp": "0"})
    times = read_times(path)
    assert (len(times), times.first_number(FPS)) == (COUNT, 0)
    found = np.stack(list(iter_frames(path, 0, None, FPS))).astype(int)
    assert np.abs(found - SOURCE).max() <= 4  # of the colors
    np.testing.assert_array_equal(list(iter_frames(path, 41, 44, FPS)), found[41:44])
    dropped = write(tmp_path / "b.avi", "ffv1", "bgr0", times=[0, 1, 2, 5, 6])
    with raises(FormatError):
        read_times(dropped).first_number(FPS)


def test_a_video_that_begins_later(tmp_path: Path) -> None:
    """Its frames have the numbers of their times, unless the time of the first one is given."""
    times = [number + 15 for number in range(10)]
    for name in ("a.mkv", "a.mp4"):
        path = write(tmp_path / name, "libx264rgb", "rgb24", {"qp": "0"}, times=times)
        found = read_times(path)
        assert (found.first_s, found.last_s, found.first_number(FPS)) == (1.5, 2.4, 15)
        for start, first_s in ((15, 0), (0, 1.5)):
            frames = iter_frames(path, start, start + 10, FPS, first_s=first_s)
            np.testing.assert_array_equal(list(frames), SOURCE[:10])
        [ninth] = iter_frames(path, 9, 10, FPS, first_s=1.5)
        np.testing.assert_array_equal(ninth, SOURCE[9])
        with raises(FormatError):
            list(iter_frames(path, 0, 10, FPS))


@pytest.mark.parametrize("name", ["at 12:30.mkv", "-i.mkv", "%d.mkv", "a?b#c&d.mkv", "é日本.mkv"])
def test_any_name_of_a_file(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also as a relative path, in which FFmpeg sees a protocol before a colon."""
    write(tmp_path / "a.mkv", times=[0, 1]).rename(tmp_path / name)
    monkeypatch.chdir(tmp_path)
    for path in (Path(name), tmp_path / name):
        assert len(list(iter_frames(path, 0, None, FPS))) == len(read_times(path)) == 2
    with raises(MissingFileError):
        next(iter_frames(Path("http://a.mkv"), 0, 1, FPS))


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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lossless.mp4", "ffv1.mkv", "h264-reordered.mp4"])
def test_files_cut_anywhere(videos: dict[str, Video], name: str, tmp_path: Path) -> None:
    """Wherever the file is cut, frames that still decode are right, and the end raises."""
    video = videos[name]
    data = video.path.read_bytes()
    path = tmp_path / f"cut{video.path.suffix}"
    # The header stands at one of the ends; it has a thousand bytes or two. FFmpeg opens some
    # files that are cut inside it, with a stream without a codec.
    cuts = {1, 7, 8, *range(0, 2000, 83), *range(len(data) - 2000, len(data), 83)}
    whole = []
    for cut in sorted(cuts | set(range(0, len(data), len(data) // 12))):
        path.write_bytes(data[:cut])
        whole += [cut for span in ((0, COUNT), (COUNT - 5, COUNT)) if is_whole(path, video, *span)]
    # The last frames come only where what is missing stands after them.
    assert all(cut > len(data) - 300 for cut in whole)


def test_a_header_that_is_not_text_and_frames_of_another_size(
    videos: dict[str, Video], tmp_path: Path
) -> None:
    data = videos["lossless.mp4"].path.read_bytes()
    path = tmp_path / "damaged.mp4"
    path.write_bytes(data.replace(b"VideoHandler", b"Video\xff\xfedler"))
    with raises(FormatError):
        next(iter_frames(path, 0, 1, FPS))
    with raises(FormatError):
        next(iter_frames(videos["ffv1.mkv"].path, 0, 1, FPS, (64, 32, 3)))
