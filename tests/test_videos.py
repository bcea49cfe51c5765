"""Clips of rollouts: what they show is what was given, and what fails in them harms no rollout."""

import dataclasses
from pathlib import Path
from typing import Any

import av
import factories
import numpy as np
import pytest
import rollout_doubles
from rollout_doubles import Cheat, World

from robomme_interference_data import load_split
from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.evaluate import videos
from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.rollout import run_rollout
from robomme_interference_data.evaluate.rows import Rollout
from robomme_interference_data.evaluate.videos import ClipWatcher, history_picture
from robomme_interference_data.evaluate.worker import RolloutWorker
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.base import EpisodeInfo, Observation, Status
from robomme_interference_data.strip import session_colors

EPISODE = EpisodeId("PatternLock", "test", 1)
CLIP = "videos/PatternLock_test_1_{}.mp4"
INFO = EpisodeInfo("do as shown", ("do as shown",), "easy", 1, "world")
VIEW = Observation({"front": np.full((256, 256, 3), 90, np.uint8)}, np.zeros(8, np.float32))


@pytest.fixture(autouse=True)
def _world(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(rollout_doubles.SPLIT, str(factories.split()))
    monkeypatch.setenv(rollout_doubles.TROUBLE, str(tmp_path))


def worker(out: Path) -> RolloutWorker:
    split = load_split(factories.split())
    config = RunConfig(
        *("my-memory", "hold", None, "rollout_doubles:World"),
        *(str(split.root), split.name, split.revision),
        videos=True,
    )
    return RolloutWorker(config, out)


def roll(out: Path, condition: str = "k1") -> tuple[Rollout, str | None]:
    working = worker(out)
    try:
        return working(WorkItem(condition, EPISODE))
    finally:
        working.close()


def frames(path: Path) -> list[np.ndarray]:
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def near(picture: np.ndarray, colour: str) -> bool:
    wanted = [int(colour[at : at + 2], 16) for at in (1, 3, 5)]
    return bool(np.abs(picture.reshape(-1, 3).mean(axis=0) - wanted).max() < 12)


def banner(picture: np.ndarray) -> np.ndarray:
    """The right part of the coloured line that names the status."""
    rows = [y for y in range(30, 275) if (picture[y, 990:1010].mean(axis=0) < 240).any()]
    return picture[rows[4] : rows[-4], 990:1010]


def test_a_rollout_leaves_a_clip(tmp_path: Path) -> None:
    row, trace = roll(tmp_path)
    assert (row.status, row.steps, row.video, trace) == ("fail", 40, CLIP.format("k1"), None)
    shown = frames(tmp_path / CLIP.format("k1"))
    assert len(shown) == 1 + 40 + 10  # the first view, one a step, the end held
    assert shown[0].shape == (280, 1024, 3)
    assert near(banner(shown[0]), "#555555") and near(banner(shown[-1]), "#D55E00")
    # A lesson of 36 frames and a unit of 32: 64 of these 68 are shown.
    buffer = load_split(factories.split()).load(EPISODE, 1)
    picture = history_picture(buffer, 0, 68)
    assert np.abs(shown[0][24:, :256].astype(int) - picture).mean() < 10
    assert [path.name for path in (tmp_path / "videos").iterdir()] == [Path(CLIP.format("k1")).name]


@pytest.mark.parametrize(("start", "stop"), [(0, 36), (36, 68), (40, 47)])
def test_the_history_is_what_was_given(start: int, stop: int) -> None:
    """In the colours of the sessions under each frame, and nowhere else."""
    buffer = load_split(factories.split()).load(EPISODE, 1)
    picture = history_picture(buffer, start, stop)
    colours = session_colors(buffer.sessions)
    lesson, unit = ([int(c[at : at + 2], 16) for at in (1, 3, 5)] for c in colours)
    found = []
    for place in range(64):
        y, x = (32 * part for part in divmod(place, 8))
        line = picture[y + 28, x].tolist()
        found.append({tuple(lesson): "lesson", tuple(unit): "unit"}.get(tuple(line)))
        if line != [255] * 3:
            index = start + place  # fewer than 64 frames: each is shown, in order
            # Of 64 × 64 pixels every second one, from the second on, 28 of them.
            small = buffer.frame(index)[1::2, 1::2][:28, :28]
            np.testing.assert_array_equal(picture[y : y + 28, x : x + 28], small)
    names = ["lesson"] * 36 + ["unit"] * 32
    assert found == names[start:stop] + [None] * (64 - (stop - start))


class Notes:
    """A watcher that keeps what it is told."""

    def __init__(self) -> None:
        self.begun: list[Any] = []

    def begin(self, buffer: Any, start: int, stop: int, first: Any, info: Any) -> None:
        self.begun.append((None if buffer is None else len(buffer), start, stop, info.goal))

    def step(self, observation: Any, status: Any, subgoal: Any) -> None:
        pass


class Chooses:
    """A retrieval step that takes frames 36 to 67: the first unit."""

    camera = "front"
    name = "chooses"

    def select(self, buffer: Any, image: Any) -> Any:
        from types import SimpleNamespace

        shares = {"lesson_fraction": 0.0, "filler_fraction": 1.0, "query_fraction": 0.0}
        return SimpleNamespace(start=36, stop=68, **shares)


@pytest.mark.parametrize(
    ("condition", "selector", "begun"),
    [
        ("no-history", None, (None, 0, 0)),
        ("k1", None, (68, 0, 68)),
        ("k3", Chooses(), (132, 36, 68)),
    ],
)
def test_a_watcher_is_told_what_the_policy_is_given(
    condition: str, selector: Any, begun: tuple[int | None, int, int], tmp_path: Path
) -> None:
    notes, policy = Notes(), Cheat()
    config = worker(tmp_path).config
    split = load_split(config.split)
    run_rollout(
        config,
        WorkItem(condition, EPISODE),
        simulator=World(),
        policy=policy,
        split=split,
        selector=selector,
        watcher=notes,
    )
    _, start, stop = begun
    assert notes.begun == [(*begun, split.manifest(EPISODE, 0).goal)]
    assert len(policy.states) == stop - start


def test_system_condition_and_length_of_the_history_are_on_the_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[tuple[list[str], list[str]]] = []
    letter = videos._lettered

    def note(canvas: Any, heads: Any, lines: Any, colour: str) -> Any:
        said.append((list(heads), list(lines)))
        return letter(canvas, heads, lines, colour)

    monkeypatch.setattr(videos, "_lettered", note)
    roll(tmp_path, "k1")
    heads, lines = said[0]
    assert heads == ["history given: 68 frames", "front", "wrist", ""]
    assert lines[:3] == ["my-memory", "PatternLock/test/1", "condition k1"]
    assert lines[-2:] == ["step 0 of 1300", "ongoing"]
    assert said[-1][1][-2:] == ["step 40 of 1300", "fail"]
    said.clear()
    roll(tmp_path, "no-history")
    assert said[0][0][0] == "no history"


def test_a_rollout_that_breaks_leaves_its_clip_too(tmp_path: Path) -> None:
    (tmp_path / "PatternLock-1").write_text("raise")
    row, trace = roll(tmp_path)
    assert row.status == "error"
    assert row.error == "SimulatorCrashError: the world fell apart (Pick it up.)"
    assert row.video == CLIP.format("k1")
    assert trace is not None and "the world fell apart" in trace
    shown = frames(tmp_path / CLIP.format("k1"))
    assert len(shown) == 1 + 4 + 10  # it broke in its fifth step
    assert near(banner(shown[-1]), "#000000")


def test_a_rollout_that_breaks_before_it_begins_has_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fall(*_: Any, **__: Any) -> Any:
        raise OSError("no world")

    monkeypatch.setattr(World, "reset", fall)
    row, _ = roll(tmp_path)
    assert (row.status, row.error, row.video) == ("error", "OSError: no world", None)
    assert not list(tmp_path.rglob("*.mp4*"))


@pytest.mark.parametrize("when", [0, 7, 45])
def test_a_clip_that_fails_leaves_the_row_as_it_is(
    when: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a full disk: at the first picture, in the middle, while the end is held."""
    encode, count = ClipWatcher._encode, iter(range(100))

    def fail(self: ClipWatcher, picture: Any) -> None:
        if next(count) == when:
            raise OSError(28, "No space left on device")
        encode(self, picture)

    monkeypatch.setattr(ClipWatcher, "_encode", fail)
    row, trace = roll(tmp_path)
    assert (row.status, row.steps, row.video) == ("fail", 40, None)
    assert trace is not None and trace.startswith("the clip failed:\n")
    assert trace.rstrip().endswith("No space left on device")
    assert not list((tmp_path / "videos").iterdir())


def test_what_a_killed_process_left_goes_with_the_next_clip(tmp_path: Path) -> None:
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / ".PatternLock_test_1_k1.mp4.abc.partial").write_bytes(b"x")
    other = tmp_path / "videos" / ".PatternLock_test_1_k3.mp4.abc.partial"
    other.write_bytes(b"x")
    roll(tmp_path)
    assert sorted((tmp_path / "videos").iterdir()) == [other, tmp_path / CLIP.format("k1")]


def test_pictures_are_not_kept(tmp_path: Path) -> None:
    """150 steps of a new picture each hold no more memory than the first 100 of them."""
    import tracemalloc

    with ClipWatcher(tmp_path / "clip.mp4", WorkItem("no-history", EPISODE), "mine") as clip:
        clip.begin(None, 0, 0, VIEW, INFO)
        tracemalloc.start()
        held = []
        for number in range(150):
            images = {"front": np.full((256, 256, 3), number, np.uint8)}
            clip.step(dataclasses.replace(VIEW, images=images), Status.ONGOING, None)
            held.append(tracemalloc.get_traced_memory()[0])
        tracemalloc.stop()
        assert clip.close(Status.TIMEOUT)
    assert max(held[100:]) < min(held[:100]) + 1_000_000  # five pictures of 256 × 256 × 3 bytes
    assert len(frames(tmp_path / "clip.mp4")) == 161


def test_pillow_is_named_before_anything_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "PIL", None)
    with pytest.raises(MissingExtraError, match="needs pillow") as raised:
        videos.check_videos()
    assert raised.value.hint == "pip install pillow"
