"""Videos of rollouts: they show what the policy got, and their failures harm no rollout."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from support.runs import EPISODE, run_one
from support.worlds import World

from robomme_interference_data import Buffer, load_buffer
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.evaluate.rollout.clips import history_picture
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.storage.video.encode import VideoEncoder
from robomme_interference_data.viz.filmstrip import session_colors

pytestmark = pytest.mark.usefixtures("trouble")

K1 = WorkItem("k1", EPISODE)


@pytest.fixture
def buffer(tiny_buffers: Path) -> Buffer:
    return load_buffer(EPISODE, "k1", buffer_set=tiny_buffers)


def frames(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def banner(picture: np.ndarray) -> list[float]:
    """Mean color of the right part of the line that names the status."""
    rows = [y for y in range(30, 275) if (picture[y, 1246:1266].mean(axis=0) < 240).any()]
    return picture[rows[4] : rows[-4], 1246:1266].reshape(-1, 3).mean(axis=0).tolist()


def test_a_rollout_writes_a_video(tmp_path: Path, buffer: Buffer) -> None:
    [row] = run_one(tmp_path / "run", conditions=("k1",), policy="noop", videos=True).rows
    assert (row.status, row.steps, row.video) == ("fail", 40, "videos/MoveCube_test_0_k1.mp4")
    assert not (tmp_path / "run" / "errors.log").exists()
    shown = frames(tmp_path / "run" / row.video)
    assert len(shown) == 1 + 40 + 10  # the first view, one a step, the end held
    assert shown[0].shape == (280, 1280, 3)
    assert banner(shown[0]) == pytest.approx([0x55] * 3, abs=12)
    assert banner(shown[-1]) == pytest.approx([0xD5, 0x5E, 0x00], abs=12)
    picture = history_picture(buffer, range(80))
    assert np.abs(shown[0][24:, 256:512].astype(int) - picture).mean() < 10
    # The lesson goes along, a frame a step: 48 frames, of which the clip has time for 41.
    for step, image in enumerate(shown[:41]):
        taught = buffer.frame(step)
        seen = image[24 : 24 + len(taught), : taught.shape[1]]
        assert np.abs(seen.astype(int) - taught).mean() < 10


def test_the_page_of_the_buffer_lies_beside_the_video(tmp_path: Path, buffer: Buffer) -> None:
    conditions = ("no-history", "k1")
    run_one(tmp_path / "run", conditions=conditions, policy="noop", videos=True)
    videos = {path.name for path in (tmp_path / "run" / "videos").iterdir()}
    assert videos == {
        "MoveCube_test_0_k1.html",
        "MoveCube_test_0_k1.mp4",
        "MoveCube_test_0_no-history.mp4",
    }
    page = (tmp_path / "run" / K1.page).read_text(encoding="utf-8")
    assert all(str(session.source) in page for session in buffer.sessions)


def test_a_video_has_the_pace_of_the_recordings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Dataset, "fps", 4.8)
    run_one(tmp_path / "run", conditions=("k0",), policy="noop", videos=True)
    with av.open(str(tmp_path / "run/videos/MoveCube_test_0_k0.mp4")) as container:
        [stream] = container.streams.video
        assert (stream.average_rate, stream.frames) == (Fraction("4.8"), 1 + 40 + 5)


@pytest.mark.parametrize(("start", "stop"), [(40, 57), (3, 3)])
def test_the_video_shows_the_history_that_the_policy_got(
    start: int, stop: int, buffer: Buffer
) -> None:
    """In the colors of the sessions under each frame, and nowhere else."""
    picture = history_picture(buffer, range(start, stop))
    colors = [bytes.fromhex(color[1:]) for color in session_colors(buffer.sessions)]
    found = []
    for place in range(64):
        y, x = (32 * part for part in divmod(place, 8))
        line = bytes(picture[y + 28, x])
        found.append(colors.index(line) if line in colors else None)
        if found[-1] is not None:
            # Fewer than 64 frames: each is shown, in order; 28 × 28 of its 32 × 32 pixels.
            small = buffer.frame(start + place)[:28, :28]
            np.testing.assert_array_equal(picture[y : y + 28, x : x + 28], small)
    sessions = [0] * 48 + [1] * 32
    assert found == sessions[start:stop] + [None] * (64 - (stop - start))


@pytest.mark.slow
def test_a_rollout_that_breaks_writes_its_video_if_it_had_begun(
    tmp_path: Path, trouble: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def roll() -> Rollout:
        [row] = run_one(tmp_path / "run", conditions=("k1",), policy="noop", videos=True).rows
        return row

    (trouble / "MoveCube-0").write_text("raise")
    row = roll()
    assert "the world fell apart" in str(row.error) and row.video == K1.clip
    shown = frames(tmp_path / "run" / row.video)
    assert len(shown) == 1 + 4 + 10  # it broke in its fifth step
    assert banner(shown[-1]) == pytest.approx([0, 0, 0], abs=12)

    def fall(*_: Any, **__: Any) -> Any:
        raise OSError("no world")

    monkeypatch.setattr(World, "reset", fall)
    row = roll()
    assert (row.error, row.video) == ("OSError: no world", None)
    assert not list((tmp_path / "run" / "videos").iterdir())  # the old one is gone


@pytest.mark.slow
def test_a_video_that_cannot_be_written_leaves_the_row_unchanged(tmp_path: Path) -> None:
    run_one(tmp_path / "run", conditions=("k0",), policy="noop")
    (tmp_path / "run" / "videos").symlink_to(tmp_path / "gone" / "videos")  # a disk taken out
    result = run_one(tmp_path / "run", conditions=("k1",), policy="noop", videos=True)
    assert [(row.status, row.video) for row in result.rows] == [("fail", None)]
    log = (tmp_path / "run" / "errors.log").read_text()
    assert "videos/MoveCube_test_0_k1.mp4 could not be written" in log


@pytest.mark.slow
@pytest.mark.parametrize("when", [0, 7, 45])
def test_a_video_that_fails_leaves_the_row_unchanged(
    when: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A full disk at the first frame, in the middle, or in the still at the end."""
    add, count = VideoEncoder.add, iter(range(100))

    def fail(self: VideoEncoder, picture: Any) -> None:
        if next(count) == when:
            raise OSError(28, "No space left on device")
        add(self, picture)

    monkeypatch.setattr(VideoEncoder, "add", fail)
    [row] = run_one(tmp_path / "run", conditions=("k1",), policy="noop", videos=True).rows
    assert (row.status, row.steps, row.video) == ("fail", 40, None)
    log = (tmp_path / "run" / "errors.log").read_text()
    assert "the clip failed:\n" in log
    assert log.rstrip().endswith("No space left on device")
    assert not (tmp_path / "run" / "videos").exists()
