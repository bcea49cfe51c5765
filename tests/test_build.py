"""Whole builds: the output is absent or complete, the same every time, and made only once."""

import dataclasses
import fcntl
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from recordings import EPISODES, MemorySource, build, contents, listed, opened

from robomme_interference_data.build_dataset import build as build_module
from robomme_interference_data.errors import BuildError, MissingFileError, SourceError


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of units, built by one worker process; treat it as read-only."""
    out = tmp_path_factory.mktemp("build") / "units"
    result = build("distractors", MemorySource(EPISODES), out)
    assert (result.out, result.episodes, result.frames) == (out, 4, 128)
    assert (result.skipped, result.existed) == ((), False)
    return out


def staged(out: Path) -> dict[Path, int]:
    """The files of staged episodes with their times."""
    folder = out.parent / f".{out.name}.building" / "episodes"
    return {path: path.stat().st_mtime_ns for path in folder.glob("*/*")}


# --- the same every time -------------------------------------------------------------------------


def test_workers_and_sources_do_not_change_a_byte(built: Path, tmp_path: Path) -> None:
    sources = [
        MemorySource(EPISODES[3:] + EPISODES[1:2]),
        MemorySource(EPISODES[2:3] + EPISODES[:1]),
    ]
    build("distractors", sources, tmp_path / "units", workers=3)
    first, second = contents(built), contents(tmp_path / "units")
    identities = [json.loads(files.pop("meta/interference.json")) for files in (first, second)]
    assert [len(identity.pop("sources")) for identity in identities] == [1, 2]
    assert identities[0] == identities[1]
    assert first == second
    assert any(name.endswith(".mp4") for name in first)


def test_the_order_of_sources_does_not_change_a_byte(tmp_path: Path, here: None) -> None:
    sources = [
        MemorySource(EPISODES[:2], provenance={"kind": "memory", "name": "one"}),
        MemorySource(EPISODES[2:], provenance={"kind": "memory", "name": "two"}),
    ]
    build("demonstrations", sources, tmp_path / "one")
    build("demonstrations", sources[::-1], tmp_path / "two")
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


def test_nothing_is_left_beside_the_output(built: Path) -> None:
    assert [path.name for path in built.parent.iterdir()] == ["units"]


# --- an output that is there already -------------------------------------------------------------


def test_a_finished_dataset_is_not_built_again(built: Path) -> None:
    before = {path: path.stat().st_mtime_ns for path in built.rglob("*")}
    leftover = built.parent / ".units.building" / "episodes"
    leftover.mkdir(parents=True)
    source = MemorySource(EPISODES[::-1])
    result = build("distractors", source, built)
    assert (result.existed, result.episodes, result.frames) == (True, 4, 128)
    assert source.reads == []
    assert {path: path.stat().st_mtime_ns for path in built.rglob("*")} == before
    assert [path.name for path in built.parent.iterdir()] == ["units"]


@pytest.mark.parametrize(
    ("kind", "episodes", "options", "message"),
    [
        ("demonstrations", EPISODES, {}, "was built otherwise: .*distractors.*not.*demonstrations"),
        ("distractors", EPISODES, {"version": "1.0.1"}, "was built otherwise: .*1.0.0.*1.0.1"),
        ("distractors", EPISODES, {"codec": "lerobot-default"}, "was built otherwise"),
        ("distractors", EPISODES, {"cameras": ("front",)}, "was built otherwise"),
        ("distractors", EPISODES[:3], {}, "other episodes: 4 stored, 3 planned"),
        ("distractors", [*EPISODES, listed("MoveCube/train/2")], {}, "4 stored, 5 planned"),
        (
            "distractors",
            [*EPISODES[:3], listed("Drawer/train/1", length=261)],
            {},
            "other episodes: 4 stored, 4 planned",
        ),
    ],
)
def test_another_dataset_is_refused(
    built: Path, kind: str, episodes: list, options: dict, message: str
) -> None:
    before = contents(built)
    source = MemorySource(episodes)
    with pytest.raises(BuildError, match=message) as raised:
        build(kind, source, built, **options)
    assert "Choose another --out, or remove the folder first." in str(raised.value)
    assert source.reads == []
    assert contents(built.parent) == {f"units/{name}": data for name, data in before.items()}


def test_a_foreign_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with pytest.raises(BuildError, match="is not a dataset of this package"):
        build("distractors", MemorySource(EPISODES), tmp_path / "out")
    assert contents(tmp_path) == {"out/notes.txt": b"mine"}


def test_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(BuildError, match="is not a dataset of this package"):
        build("distractors", MemorySource(EPISODES), tmp_path / "out")
    assert contents(tmp_path) == {"out": b"mine"}


def test_a_damaged_dataset_is_refused(tmp_path: Path, here: None) -> None:
    build("distractors", MemorySource(EPISODES[:1]), tmp_path / "out")
    (tmp_path / "out/meta/info.json").unlink()
    with pytest.raises(MissingFileError, match=r"meta/info.json is missing"):
        build("distractors", MemorySource(EPISODES[:1]), tmp_path / "out")


@pytest.mark.parametrize("place", ["empty folder", "link", "dots", "current folder"])
def test_any_way_to_name_an_empty_place(
    tmp_path: Path, here: None, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:
    target = tmp_path / "target"
    target.mkdir()
    if place == "link":
        out = tmp_path / "link"
        out.symlink_to(target)
    elif place == "dots":
        out = tmp_path / "target" / ".." / "target"
    elif place == "current folder":
        monkeypatch.chdir(target)
        out = Path()
    else:
        out = target
    build("distractors", MemorySource(EPISODES[:1]), out, cameras=("front",))
    assert len(opened(target)) == 1
    assert {path.name for path in tmp_path.iterdir()} <= {"target", "link"}


# --- two builds at once --------------------------------------------------------------------------


def test_another_build_is_running(tmp_path: Path, here: None) -> None:
    work = tmp_path / ".out.building"
    work.mkdir()
    source = MemorySource(EPISODES)
    with (work / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(BuildError, match=r"another build of .*/out is running") as raised:
            build("distractors", source, tmp_path / "out")
    assert "Wait for it to end, or stop it." in str(raised.value)
    assert source.reads == []
    assert not (tmp_path / "out").exists()
    build("distractors", source, tmp_path / "out")  # the lock of a build that is gone holds nobody
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_another_build_ends_just_before_this_one_begins(
    tmp_path: Path, here: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = MemorySource(EPISODES[:1])
    real = build_module.locked

    @contextmanager
    def late(out: Path) -> Iterator[Path]:
        monkeypatch.setattr(build_module, "locked", real)
        build("distractors", MemorySource(EPISODES[:1]), out)
        with real(out) as work:
            yield work

    monkeypatch.setattr(build_module, "locked", late)
    assert build("distractors", source, tmp_path / "out").existed
    assert source.reads == []
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


# --- episodes that fail --------------------------------------------------------------------------


def test_good_episodes_are_kept_and_not_redone(built: Path, tmp_path: Path, here: None) -> None:
    out = tmp_path / "units"
    broken = MemorySource(EPISODES, breaks={"MoveCube/train/1": 9, "Drawer/train/0": 200})
    with pytest.raises(BuildError) as raised:
        build("distractors", broken, out)
    assert str(raised.value) == (
        "2 of 4 episodes failed:\n"
        "  MoveCube/train/1: cannot read frame 9\n"
        "  Drawer/train/0: cannot read frame 200\n"
        "The others are kept. Mend these or leave them out (--families, --episodes), then run the "
        "same command again."
    )
    assert not out.exists()
    kept = staged(out)
    assert len(kept) == 2 * 5
    # Still broken: nothing changes.
    with pytest.raises(BuildError, match="2 of 4 episodes failed"):
        build("distractors", broken, out)
    assert staged(out) == kept
    # One mended: it is kept, too.
    broken = MemorySource(EPISODES, breaks={"Drawer/train/0": 200})
    with pytest.raises(SourceError, match="Drawer/train/0: cannot read frame 200"):
        build("distractors", broken, out)
    assert broken.reads == ["MoveCube/train/1", "Drawer/train/0"]
    assert kept.items() <= staged(out).items()
    # All mended: only the last is read, and the result is that of an undisturbed build.
    mended = MemorySource(EPISODES)
    build("distractors", mended, out)
    assert mended.reads == ["Drawer/train/0"]
    assert contents(out) == contents(built)
    assert [path.name for path in tmp_path.iterdir()] == ["units"]


def test_many_failures_are_counted(tmp_path: Path, here: None) -> None:
    episodes = [listed(f"Drawer/train/{i}", cameras=("front",)) for i in range(13)]
    broken = MemorySource(episodes, breaks={str(episode.id): 0 for episode in episodes})
    with pytest.raises(BuildError, match="13 of 13 episodes failed") as raised:
        build("distractors", broken, tmp_path / "out")
    assert "  Drawer/train/9: " in str(raised.value)
    assert "  … and 3 more" in str(raised.value)
    assert "Drawer/train/10" not in str(raised.value)


def test_errors_and_deaths_in_worker_processes(tmp_path: Path) -> None:
    source = MemorySource(EPISODES, breaks={"Drawer/train/1": 9}, dies="MoveCube/train/0")
    with pytest.raises(BuildError, match="2 of 4 episodes failed") as raised:
        build("distractors", source, tmp_path / "out", workers=2)
    assert "  MoveCube/train/0: the worker process died (exit code 7)" in str(raised.value)
    assert "  Drawer/train/1: cannot read frame 9" in str(raised.value)
    assert len(staged(tmp_path / "out")) == 2 * 5


def test_one_failure_keeps_its_own_hint(tmp_path: Path) -> None:
    source = MemorySource(EPISODES[:1], breaks={"MoveCube/train/0": 9})
    with pytest.raises(SourceError) as raised:
        build("distractors", source, tmp_path / "out")
    assert str(raised.value) == "MoveCube/train/0: cannot read frame 9\nRecord it again."


def test_failure_while_writing_leaves_no_output(
    built: Path, tmp_path: Path, here: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "units"

    def fail(*args: object) -> None:
        raise BuildError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(build_module, "finish_dataset", fail)
        with pytest.raises(BuildError, match="the disk is full"):
            build("distractors", MemorySource(EPISODES), out)
    assert not out.exists()
    source = MemorySource(EPISODES)
    build("distractors", source, out)
    assert source.reads == []
    assert contents(out) == contents(built)


def test_a_changed_recording_is_staged_again(tmp_path: Path, here: None) -> None:
    out = tmp_path / "out"
    with pytest.raises(SourceError):
        broken = MemorySource(EPISODES[:2], breaks={"MoveCube/train/1": 9})
        build("distractors", broken, out)
    changed = [dataclasses.replace(EPISODES[0], key="recorded again"), EPISODES[1]]
    source = MemorySource(changed)
    build("distractors", source, out)
    assert source.reads == ["MoveCube/train/0", "MoveCube/train/1"]
    assert len(opened(out)) == 2
