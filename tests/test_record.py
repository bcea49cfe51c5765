"""Episodes of a simulator become recordings, whatever its workers do."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulator_doubles import Double
from typer.testing import CliRunner

from robomme_interference_data import Dataset
from robomme_interference_data.build_dataset.record import (
    RecordedSource,
    cameras_to_draw,
    check_playable,
    check_unbuilt,
    list_episodes,
    record_episodes,
)
from robomme_interference_data.cli import app
from robomme_interference_data.errors import BuildError, InvalidOptionError, UnknownNameError
from robomme_interference_data.files import LocalFiles
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.tabletop import SUITE_VERSION

DOUBLE = "simulator_doubles:make"  # a lesson of 5 frames, then success after 3 steps
ONCE = "simulator_doubles:make_once"


def episode(index: int) -> EpisodeId:
    return EpisodeId("MoveCube", "train", index)


def contents(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


def test_lesson_and_live_part(tmp_path: Path) -> None:
    done = list(record_episodes(DOUBLE, [episode(9), episode(0)], tmp_path, live=True, workers=2))
    assert sorted(done) == [episode(0), episode(9)]
    source = RecordedSource(tmp_path, "tabletop")
    assert source.provenance == {"kind": "tabletop", "suite_version": SUITE_VERSION}
    assert RecordedSource(tmp_path, "robomme").provenance == {"kind": "robomme"}
    first, second = source.episodes()
    assert (first.id, second.id) == (episode(0), episode(9))
    # 5 frames of the lesson, then one before each of the 3 steps; none after the end
    assert (second.raw_length, second.demonstration_length) == (8, 5)
    assert (second.goals, second.seed, second.simulator) == (("goal",), 9, "double")
    assert second.exact
    frames = list(source.read(second))
    assert [frame.is_demonstration for frame in frames] == [True] * 5 + [False] * 3
    assert all((frame.images["front"] == 9).all() for frame in frames)
    assert [float(frame.state[0]) for frame in frames] == [0, 0, 0, 0, 0, 3, 2, 1]
    actions = np.stack([frame.action for frame in frames])
    assert actions[:, 0].tolist() == [1, 1, 1, 1, 1, 0, 0, 0]


def test_a_demonstration_ends_with_the_first_live_observation(tmp_path: Path) -> None:
    list(record_episodes(DOUBLE, [episode(0)], tmp_path, live=False))
    (only,) = RecordedSource(tmp_path, "tabletop").episodes()
    assert (only.raw_length, only.demonstration_length) == (6, 5)


def test_a_simulator_that_tells_no_actions(tmp_path: Path) -> None:
    """The official one: its demonstrations have none, and it has no oracle."""
    list(record_episodes(DOUBLE, [episode(0)], tmp_path, live=False, options={"actions": False}))
    source = RecordedSource(tmp_path, "robomme")
    (only,) = source.episodes()
    assert (only.raw_length, only.demonstration_length, only.action_size) == (6, 5, None)
    frames = list(source.read(only))
    assert [frame.action for frame in frames] == [None] * 6
    assert [float(frame.state[0]) for frame in frames] == [0, 0, 0, 0, 0, 3]


def test_only_the_cameras_that_are_asked_for(tmp_path: Path) -> None:
    for cameras in (("front",), ("front", "wrist")):
        folder = tmp_path / "-".join(cameras)
        list(record_episodes(DOUBLE, [episode(9)], folder, live=True, options={"cameras": cameras}))
        (only,) = RecordedSource(folder, "tabletop").episodes()
        assert tuple(only.cameras) == cameras
    both, front = contents(tmp_path / "front-wrist"), contents(tmp_path / "front")
    assert both.pop("videos/wrist/MoveCube/train/9.mkv")
    assert both == front


def test_cameras_to_draw() -> None:
    assert cameras_to_draw(None) == ("front", "wrist")
    assert cameras_to_draw(("front",)) == ("front",)
    # A recording has the front camera whatever is stored of it.
    assert cameras_to_draw(("wrist",)) == ("front", "wrist")
    with pytest.raises(UnknownNameError, match=r"(?s)--cameras wirst.*'wrist'"):
        cameras_to_draw(("front", "wirst"))


def test_list_episodes() -> None:
    assert list_episodes("robomme", ("MoveCube",), "test", {0, 49, 50}) == [
        EpisodeId("MoveCube", "test", 0),
        EpisodeId("MoveCube", "test", 49),
    ]
    assert len(list_episodes("robomme", None, "train", None)) == 9 * 100
    assert len(list_episodes("tabletop", None, None, None)) == 9 * (100 + 50 + 50)
    # One of RoboMME's, but without a demonstration.
    with pytest.raises(UnknownNameError, match="robomme has no demonstrations of a family 'BinF"):
        list_episodes("robomme", ("MoveCube", "BinFill"), None, None)
    with pytest.raises(InvalidOptionError, match="tabletop has no episode of these numbers"):
        list_episodes("tabletop", None, "test", {50})


def test_check_playable() -> None:
    check_playable("robomme", "demonstrations")
    check_playable("tabletop", "distractors")
    with pytest.raises(InvalidOptionError, match="--source robomme-h5:DIR"):
        check_playable("robomme", "distractors")


def test_what_is_recorded_is_not_played_again(tmp_path: Path) -> None:
    list(record_episodes(DOUBLE, [episode(0)], tmp_path, live=False))
    video = tmp_path / "videos" / "front" / "MoveCube" / "train" / "0.mkv"
    before = video.stat().st_mtime_ns
    assert list(record_episodes(DOUBLE, [episode(0), episode(5)], tmp_path, live=False))
    assert video.stat().st_mtime_ns == before
    assert len(RecordedSource(tmp_path, "tabletop").episodes()) == 2


def test_the_same_bytes_in_any_order_and_with_any_workers(tmp_path: Path) -> None:
    ids = [episode(0), episode(4), episode(5)]
    list(record_episodes(DOUBLE, ids, tmp_path / "a", live=True, workers=1))
    list(record_episodes(DOUBLE, ids[::-1], tmp_path / "b", live=True, workers=2))
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_a_worker_that_dies_or_hangs_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "marks").mkdir()
    monkeypatch.setenv("DOUBLE_MARKS", str(tmp_path / "marks"))
    ids = [episode(index) for index in (0, 1, 2, 5)]  # 1 dies and 2 hangs, once each
    done = list(record_episodes(ONCE, ids, tmp_path / "r", live=False, workers=2, time_limit=20))
    assert sorted(done) == ids


def test_failures_are_listed_and_the_others_kept(tmp_path: Path) -> None:
    ids = [episode(0), episode(1), episode(3)]
    with pytest.raises(BuildError) as caught:
        list(record_episodes(DOUBLE, ids, tmp_path, live=False))
    assert "2 of 3 episodes" in caught.value.message
    assert "MoveCube/train/1: the worker process died (exit code 7) (started 2 times)" in str(
        caught.value
    )
    assert "MoveCube/train/3: no such episode (started 1 times)" in str(caught.value)
    assert not (tmp_path / "frames.parquet").exists()
    assert list(record_episodes(DOUBLE, [episode(0)], tmp_path, live=False)) == [episode(0)]
    assert len(RecordedSource(tmp_path, "tabletop").episodes()) == 1


def test_check_unbuilt(tmp_path: Path) -> None:
    import factories

    units = factories.split() / "distractors"
    ids = [record.id for record in Dataset(LocalFiles(units)).records()]
    skipped = EpisodeId("VideoRepick", "train", 1)  # too short, in the build report
    assert check_unbuilt(tmp_path / "new", "distractors", ids, "frames")
    # The sample is of the source "frames", which has a kind and no version, as RoboMME has.
    assert not check_unbuilt(units, "distractors", [*ids, skipped], "frames")
    with pytest.raises(BuildError, match=r"'frames'.*not from .*'suite_version'"):
        check_unbuilt(units, "distractors", [*ids, skipped], "tabletop")
    for kind, wanted in (("distractors", ids), ("demonstrations", [*ids, skipped])):
        with pytest.raises(BuildError, match="holds something else"):
            check_unbuilt(units, kind, wanted, "frames")
    (tmp_path / "other").write_text("not a dataset")
    with pytest.raises(BuildError, match="Choose another --out"):
        check_unbuilt(tmp_path / "other", "distractors", ids, "frames")


def test_fewer_cameras_of_the_tabletop_simulator_are_the_same_bits(tmp_path: Path) -> None:
    """Both parts of an episode, the demonstration and the oracle's, in a process each."""
    pytest.importorskip("mani_skill", reason="needs the extra sim")
    short = [EpisodeId("VideoUnmask", "train", 0)]
    for cameras in (("front",), ("front", "wrist")):
        options = {"cameras": cameras}
        try:
            list(
                record_episodes(
                    "tabletop", short, tmp_path / cameras[-1], live=True, options=options
                )
            )
        except BuildError as error:
            if "no Vulkan device" in str(error):
                pytest.skip(str(error))
            raise
    front, both = contents(tmp_path / "front"), contents(tmp_path / "wrist")
    assert both.pop("videos/wrist/VideoUnmask/train/0.mkv")
    assert both == front


@pytest.mark.slow
def test_the_tabletop_simulator_through_the_command_line(tmp_path: Path) -> None:
    import subprocess
    import sys

    command = Path(sys.executable).parent / "robomme-interference"
    words = ["build", "demonstrations", "--source", "tabletop", "--families", "PatternLock"]
    words += ["--split", "test", "--episodes", "0", "--out", str(tmp_path / "d")]
    for expected in ("built, 1 episodes", "was built before"):
        done = subprocess.run(
            [str(command), *words], capture_output=True, text=True, timeout=280, check=False
        )
        assert done.returncode == 0, done.stderr
        assert expected in " ".join(done.stderr.split())
    (record,) = Dataset(LocalFiles(tmp_path / "d")).records()
    assert record.simulator == "tabletop"
    assert record.exact
    assert [path.name for path in tmp_path.iterdir()] == ["d"]


@pytest.mark.parametrize(
    ("simulator", "given", "expected"),
    [("tabletop", [], 120.0), ("robomme", [], 1800.0), ("tabletop", ["--time-limit", "7"], 7.0)],
)
def test_the_time_limit_is_the_simulators(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    simulator: str,
    given: list[str],
    expected: float,
) -> None:
    taken = []

    def stand_in(*_: Any, time_limit: float, **__: Any) -> Iterator[EpisodeId]:
        taken.append(time_limit)
        raise BuildError("enough")

    steps = "robomme_interference_data.build_dataset.steps"
    monkeypatch.setattr(f"{steps}.record_episodes", stand_in)
    monkeypatch.setattr(f"{steps}.make_simulator", lambda *_, **__: Double())
    words = ["build", "demonstrations", "--source", simulator, "--out", str(tmp_path / "out")]
    done = CliRunner().invoke(app, [*words, *given])
    assert isinstance(done.exception, BuildError)
    assert taken == [expected]
