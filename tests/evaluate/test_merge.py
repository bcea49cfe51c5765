"""Shards of a run and the run that they make together."""

import json
from pathlib import Path

import pytest
from support.messages import raises
from support.runs import header, run, run_one, untimed

from robomme_interference_data.errors import FormatError, RunError
from robomme_interference_data.evaluate import merge_runs
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.row import read_record
from robomme_interference_data.ids import EpisodeId

pytestmark = pytest.mark.usefixtures("trouble")


def shards(tmp_path: Path, count: int = 2) -> list[Path]:
    folders = [tmp_path / f"shard-{number}" for number in range(1, count + 1)]
    for number, folder in enumerate(folders, 1):
        run(folder, shard=f"{number}/{count}")
    return folders


def test_merged_shards_equal_the_whole_run(tmp_path: Path) -> None:
    whole = run(tmp_path / "whole")
    folders = shards(tmp_path, 3)
    # Two episodes under two conditions: the third shard has nothing to do.
    assert sorted(len(read_record(folder)) for folder in folders) == [0, 2, 2]
    assert [header(folder)["status"] for folder in folders] == ["complete"] * 3
    merged = merge_runs(folders, tmp_path / "merged")
    assert untimed(merged.rows) == untimed(whole.rows)
    assert (merged.planned, merged.missing, merged.broken, merged.duplicates) == (4, (), (), ())
    found, one = header(tmp_path / "merged"), header(tmp_path / "whole")
    for name in ("identity", "plans", "counts", "planned", "status", "buffer_set"):
        assert found[name] == one[name]
    assert found["merged"] == ["shard-1", "shard-2", "shard-3"]
    assert len(found["invocations"]) == 3
    # The merged run is a run: asked for the whole plan, it has nothing left to do.
    log = (tmp_path / "merged" / "rollouts.jsonl").read_bytes()
    assert untimed(run(tmp_path / "merged").rows) == untimed(whole.rows)
    assert (tmp_path / "merged" / "rollouts.jsonl").read_bytes() == log
    for name in ("rollouts.csv", "rollouts.parquet"):
        assert (tmp_path / "merged" / name).exists()


def test_missing_rollouts_are_listed_and_run_on_resume(tmp_path: Path) -> None:
    first, second = shards(tmp_path)
    merged = merge_runs([first], tmp_path / "merged")
    assert merged.missing == tuple(sorted(read_record(second)))
    assert len(merged.rows) + len(merged.missing) == merged.planned == 4
    assert header(tmp_path / "merged")["status"] == "incomplete"
    assert len(run(tmp_path / "merged").rows) == 4


def test_a_finished_row_takes_precedence_over_an_error(tmp_path: Path, trouble: Path) -> None:
    (trouble / "MoveCube-0").write_text("raise")
    run(tmp_path / "broken")
    (trouble / "MoveCube-0").unlink()
    whole = run(tmp_path / "whole")
    both = [tmp_path / "broken", tmp_path / "whole"]
    for number, order in enumerate((both, both[::-1])):
        merged = merge_runs(order, tmp_path / f"merged-{number}")
        assert merged.broken == merged.missing == merged.conflicts == ()
        assert len(merged.duplicates) == 3
        assert untimed(merged.rows) == untimed(whole.rows)
        assert "world fell apart" in (merged.folder / "errors.log").read_text()
    only = merge_runs([tmp_path / "broken"], tmp_path / "merged-2")
    assert only.broken == (WorkItem("no-history", EpisodeId("MoveCube", "test", 0)),)


def test_duplicates_that_differ_are_conflicts(tmp_path: Path) -> None:
    a, b = (run(tmp_path / name) for name in "ab")
    log = b.folder / "rollouts.jsonl"
    first, *others = log.read_text().splitlines(keepends=True)
    changed = json.loads(first)
    changed["steps"] -= 1
    log.write_text(json.dumps(changed) + "\n" + "".join(others))
    merged = merge_runs([a.folder, b.folder], tmp_path / "merged")
    assert len(merged.duplicates) == 4
    episode = EpisodeId(changed["family"], "test", changed["episode"])
    assert merged.conflicts == (WorkItem(changed["condition"], episode),)
    assert merged.rows == a.rows


def test_videos_are_copied(tmp_path: Path) -> None:
    run_one(tmp_path / "a", conditions=("k0",), videos=True)
    (row,) = merge_runs([tmp_path / "a"], tmp_path / "merged").rows
    assert row.video is not None
    here, there = (tmp_path / name / row.video for name in ("a", "merged"))
    assert here.read_bytes() == there.read_bytes()
    here.unlink()
    here.symlink_to(__file__)
    with raises(FormatError):
        merge_runs([tmp_path / "a"], tmp_path / "other")
    assert not (tmp_path / "other").exists()


def test_other_runs_and_existing_folders_are_errors(tmp_path: Path) -> None:
    run_one(tmp_path / "a")
    run_one(tmp_path / "b", model_seed=1)
    with raises(RunError):
        merge_runs([tmp_path / "a", tmp_path / "b"], tmp_path / "merged")
    with raises(RunError):
        merge_runs([tmp_path / "a"], tmp_path / "b")
    (tmp_path / "empty").mkdir()
    with raises(RunError):
        merge_runs([tmp_path / "a", tmp_path / "empty"], tmp_path / "merged")
    (tmp_path / "a" / "rollouts.jsonl").write_text("{}\n")
    with raises(FormatError):
        merge_runs([tmp_path / "a"], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()
