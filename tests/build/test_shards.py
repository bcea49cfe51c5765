"""Builds in shards: merged they are the bytes of one build, and wrong merges are errors."""

import json
from pathlib import Path

import pytest
import typer
from click import Command
from support.buffer_sets import contents
from support.made_up import MadeUpSource
from support.messages import raises

from robomme_interference_data.build_dataset import commands
from robomme_interference_data.build_dataset.plan import datasets
from robomme_interference_data.cli.main import app
from robomme_interference_data.errors import BuildError, BusyError, InvalidOptionError, SourceError
from robomme_interference_data.runtime import memory
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.storage.staging import file_lock

# Of each family a query of 12 frames, two train episodes, and one that is too short for a unit.
EPISODES: dict[str, tuple[int, int | None]] = {
    f"{family}/{split}/{index}": (12 if index < 2 else 3, 2)
    for family in ("A", "B", "C")
    for split, count in (("test", 1), ("train", 3))
    for index in range(count)
}
COMMAND: Command = typer.main.get_command(app)


@pytest.fixture(autouse=True)
def source(monkeypatch: pytest.MonkeyPatch) -> MadeUpSource:
    """The only source, and workers in this process."""
    made = MadeUpSource(dict(EPISODES))
    monkeypatch.setattr(datasets, "open_source", lambda text, **_: made)
    monkeypatch.setattr(commands, "make_executor", lambda config: Serial())
    return made


def run(*words: str | Path) -> None:
    """Run a command; errors of the package are raised."""
    COMMAND.main([*map(str, words)], standalone_mode=False)


def build(folder: Path, *options: str) -> None:
    settings = ["--source", "made-up", "--split", "test", "--unit", "4x2"]
    run("build", folder, *settings, "--conditions", "no-history,k0,k2", *options)


def build_units(folder: Path, *options: str) -> None:
    settings = ["--source", "made-up", "--only", "distractors", "--unit", "4x2"]
    run("build", folder, *settings, *options)


def build_shards(tmp_path: Path, count: int) -> list[Path]:
    folders = [tmp_path / f"shard-{number}" for number in range(1, count + 1)]
    for number, folder in enumerate(folders, 1):
        build(folder, "--shard", f"{number}/{count}")
    return folders


def test_merged_shards_are_the_bytes_of_one_build(tmp_path: Path, source: MadeUpSource) -> None:
    build(tmp_path / "whole")
    folders = build_shards(tmp_path, 3)
    # Three queries and nine train episodes: each shard records one and three of them.
    for folder in folders:
        names = ("demonstrations", "distractors")
        assert [len([*(folder / "staged" / name).iterdir()]) for name in names] == [1, 3]
    source.wrong = {name: {0: SourceError("must not be read")} for name in EPISODES}
    before = [contents(folder) for folder in folders]
    run("merge", *reversed(folders), "--out", tmp_path / "merged")
    whole, merged = contents(tmp_path / "whole"), contents(tmp_path / "merged")
    assert [n for n in whole.keys() | merged.keys() if whole.get(n) != merged.get(n)] == []
    assert [contents(folder) for folder in folders] == before
    with raises(BuildError):
        run("merge", *folders, "--out", tmp_path / "merged")


def test_one_dataset_in_more_shards_than_episodes(tmp_path: Path) -> None:
    """Some shards are empty; units are merged beside nothing else."""
    folders = [tmp_path / f"shard-{number}" for number in range(1, 12)]
    for number, folder in enumerate(folders, 1):
        build_units(folder, "--shard", f"{number}/11")
    run("merge", *folders, "--out", tmp_path / "merged")
    build_units(tmp_path / "whole")
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")


def test_an_interrupted_shard_and_merge_resume(
    tmp_path: Path, source: MadeUpSource, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = tmp_path / "shard-1", tmp_path / "shard-2"
    build(one, "--shard", "1/2")
    source.wrong = {f"{family}/train/1": {5: SourceError("broke off")} for family in "ABC"}
    with pytest.raises(BuildError):
        build(two, "--shard", "2/2")
    with raises(BuildError):
        run("merge", one, two, "--out", tmp_path / "merged")
    assert not (tmp_path / "merged").exists()
    source.wrong = {name: {0: SourceError("must not be read")} for name in EPISODES}
    source.wrong |= {f"{family}/train/1": {} for family in "ABC"}
    build(two, "--shard", "2/2")

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(commands, "_plan_buffers", killed)
        run("merge", one, two, "--out", tmp_path / "merged")
    # Nobody takes what is there for a buffer set, and no other merge goes on there.
    with raises(BuildError):
        build(tmp_path / "merged")
    run("merge", one, two, "--out", tmp_path / "merged")
    source.wrong = {}
    build(tmp_path / "whole")
    assert contents(tmp_path / "merged") == contents(tmp_path / "whole")


def test_shards_that_do_not_belong_together(tmp_path: Path, source: MadeUpSource) -> None:
    one, two = build_shards(tmp_path, 2)
    out = tmp_path / "merged"

    def merge(*folders: Path) -> None:
        with raises((BuildError, InvalidOptionError)):
            run("merge", *folders, "--out", out)
        assert not out.exists()

    merge(one)  # one is missing
    merge(one, two, two)
    merge(one, tmp_path)  # no shard
    for name, options in (
        ("other-unit", ("--shard", "2/2", "--unit", "4x1")),
        ("of-three", ("--shard", "2/3")),
    ):
        build(tmp_path / name, *options)
        merge(one, tmp_path / name)
    source.provenance = {"kind": "made-up", "versions": {"made-up": "2"}}
    build(tmp_path / "newer", "--shard", "2/2")
    merge(one, tmp_path / "newer")


def test_the_source_of_a_merge_has_the_episodes_of_the_shards(
    tmp_path: Path, source: MadeUpSource
) -> None:
    folders = build_shards(tmp_path, 2)
    source.lengths |= {"A/train/3": (12, 2)}
    with raises(BuildError):
        run("merge", *folders, "--out", tmp_path / "merged")


def test_a_folder_is_of_one_shard(tmp_path: Path) -> None:
    folder = tmp_path / "shard-1"
    build(folder, "--shard", "1/2")
    for options in (("--shard", "2/2"), ("--shard", "1/2", "--unit", "4x1"), ()):
        with raises(BuildError):
            build(folder, *options)
    build(folder, "--shard", "1/2")  # nothing to add
    with file_lock(folder / ".lock", BusyError("")), raises(BusyError):
        build(folder, "--shard", "1/2")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with raises(BuildError):
        build(tmp_path / "other", "--shard", "1/2")
    with raises(InvalidOptionError):
        run("build", tmp_path / "new", "--only", "manifests", "--shard", "1/2")
    with raises(InvalidOptionError):
        build(tmp_path / "new", "--shard", "3/2")


def test_what_a_shard_records(tmp_path: Path) -> None:
    build(tmp_path / "shard", "--shard", "2/2", "--workers", "7")
    assert json.loads((tmp_path / "shard" / "shard.json").read_text()) == {
        "format_version": 1,
        "shard": "2/2",
        "build": {"source": ["made-up"], "split": "test", "unit": "4x2"},
        "buffers": {"conditions": ["no-history", "k0", "k2"]},
        "sources": [{"kind": "made-up"}],
        "finished": True,
    }


@pytest.mark.parametrize(
    ("cores", "memory_gb", "worker_gb", "workers"),
    [(8, 16, 2.5, 6), (4, 64, 2.5, 4), (2, 1, 2.5, 1), (8, 1, 0, 8)],
)
def test_no_more_workers_than_cores_and_memory_allow(
    cores: int, memory_gb: int, worker_gb: float, workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory.os, "cpu_count", lambda: cores)
    sizes = {"SC_PAGE_SIZE": 1000, "SC_PHYS_PAGES": memory_gb * 10**6}
    monkeypatch.setattr(memory.os, "sysconf", sizes.__getitem__)
    assert memory.fitting_workers(worker_gb) == workers
