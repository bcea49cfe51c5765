"""Videos in frames folders: times and number of their frames."""

from fractions import Fraction
from pathlib import Path

import av
import pytest
from support.frames_folders import FOUR, FRONT, four, place, read_one, replace_by_video, write
from support.messages import raises
from support.recordings import check_recording, write_table, write_video

from robomme_interference_data.build_dataset.sources.frames import FramesSource
from robomme_interference_data.errors import FormatError, SourceError


def write_timed(path: Path, milliseconds: list[int], rate: Fraction | int = 10) -> None:
    """Write the four frames at given times, in a container that states a rate."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", Fraction(rate), width=24, height=16, pix_fmt="bgr0")
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for image, time in zip(FRONT, milliseconds, strict=False):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


@pytest.mark.parametrize(
    ("times", "stated", "column", "expected"),
    [
        ([0, 100, 200, 300], 10, None, 10),
        ([1500, 1600, 1700, 1800], 10, None, 10),  # from its first frame on
        ([0, 33, 67, 100], 30, None, 30),
        ([0, 80, 160, 240], Fraction(25, 2), None, 12.5),
        ([0, 2000, 4000, 6000], Fraction(1, 2), None, 0.5),
        ([0, 130, 180, 340], 10, None, 10),  # each nearest to its own number
        ([0, 33, 67, 100], 24, 30, 30),  # the container states another rate
        ([0, 33, 67, 100], 24, None, None),
        ([0, 100, 160, 300], 10, None, 10),
        ([0, 100, 300, 400], 10, None, None),
        ([0, 40, 200, 300], 10, None, None),
        ([0, 100, 200, 300], 10, 30, None),
        ([0, 0, 0, 0], 10, None, None),
    ],
)
def test_times_of_frames(
    tmp_path: Path,
    times: list[int],
    stated: Fraction | int,
    column: int | None,
    expected: float | None,
) -> None:
    write_timed(place(tmp_path, kind="videos"), times, stated)
    write_table(tmp_path, four() if column is None else four(fps=column))
    if expected is None:
        with raises(SourceError) as caught:
            read_one(tmp_path)
        assert "variable frame rate" in str(caught.value.hint)
        assert "ffmpeg -i OLD" in str(caught.value.hint)
        return
    recording = read_one(tmp_path)
    assert recording.robot.fps == expected
    check_recording(recording, FOUR, marked=False)


@pytest.mark.parametrize("frames", [3, 5])
def test_a_video_of_another_length_is_an_error_before_it_is_decoded(
    tmp_path: Path, frames: int
) -> None:
    """Distractor units do not decode the end of an episode."""
    write_table(tmp_path, four())
    replace_by_video(tmp_path, frames)
    with raises(SourceError):
        read_one(tmp_path)


def test_a_camera_that_is_not_used_may_be_broken(tmp_path: Path) -> None:
    write(tmp_path)
    place(tmp_path, kind="videos", camera="wrist").parent.mkdir(parents=True)
    place(tmp_path, kind="videos", camera="wrist").write_bytes(b"none")
    source = FramesSource(tmp_path)
    [episode] = source.episodes()
    assert len(list(source.read(episode, ("front",)).frames)) == 4
    for cameras in (("wrist",), None):
        with raises(FormatError):
            source.read(episode, cameras)


def test_a_folder_named_after_a_time_of_day(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As a relative path, FFmpeg takes what precedes the colon for a protocol."""
    folder = Path("run 12:30?#%d é")
    write_table(tmp_path / folder, four())
    write_video(place(tmp_path, kind="videos"), FRONT)
    (tmp_path / "videos").rename(tmp_path / folder / "videos")
    monkeypatch.chdir(tmp_path)
    check_recording(read_one(folder), FOUR, marked=False)
