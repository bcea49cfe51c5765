"""Shards of a run and the run that they make together."""

import json
from pathlib import Path
from typing import Any

import pytest
from run_calls import run, untimed
from typer.testing import CliRunner

from robomme_interference_data.cli import app
from robomme_interference_data.errors import FormatError, InvalidOptionError, RunFolderError
from robomme_interference_data.evaluate import merge_runs
from robomme_interference_data.evaluate.log import read_log

pytestmark = pytest.mark.usefixtures("troubled_world")


def shards(tmp_path: Path, count: int = 3, **changes: Any) -> list[Path]:
    folders = [tmp_path / f"shard-{number}" for number in range(1, count + 1)]
    for number, folder in enumerate(folders, 1):
        run(folder, shard=f"{number}/{count}", **changes)
    return folders


def test_shards_make_the_run(tmp_path: Path) -> None:
    whole = run(tmp_path / "whole")
    folders = shards(tmp_path)
    assert sorted(len(read_log(folder)) for folder in folders) == [4, 6, 6]  # 8 episodes, 2 each
    merged = merge_runs(folders, tmp_path / "merged")
    assert untimed(merged.rows) == untimed(whole.rows)
    assert (merged.planned, merged.missing, merged.broken, merged.double) == (16, (), (), ())
    header = json.loads((tmp_path / "merged" / "run.json").read_text())
    one = json.loads((tmp_path / "whole" / "run.json").read_text())
    for name in ("identity", "plans", "counts", "planned", "status", "policy", "versions"):
        assert header[name] == one[name]
    assert header["merged"] == ["shard-1", "shard-2", "shard-3"]
    # The merged run is a run: asked for the whole plan, it has nothing left to do.
    log = (tmp_path / "merged" / "rollouts.jsonl").read_bytes()
    assert untimed(run(tmp_path / "merged").rows) == untimed(whole.rows)
    assert (tmp_path / "merged" / "rollouts.jsonl").read_bytes() == log


def test_what_is_missing_is_told_and_run_by_going_on(tmp_path: Path) -> None:
    first, second, third = shards(tmp_path)
    merged = merge_runs([first, second], tmp_path / "merged")
    left = {(row.family, row.condition, row.episode) for row in read_log(third).values()}
    assert set(merged.missing) == left
    assert len(merged.rows) + len(left) == merged.planned == 16
    assert json.loads((tmp_path / "merged" / "run.json").read_text())["status"] == "incomplete"
    assert len(run(tmp_path / "merged").rows) == 16


def test_a_finished_row_stands_before_an_error(tmp_path: Path) -> None:
    (tmp_path / "trouble" / "MoveCube-0").write_text("raise")
    broken = run(tmp_path / "broken", families=["MoveCube"])
    (tmp_path / "trouble" / "MoveCube-0").unlink()
    whole = run(tmp_path / "whole", families=["MoveCube"])
    assert broken.counts["error"] == 1
    both = [tmp_path / "broken", tmp_path / "whole"]
    for number, order in enumerate((both, both[::-1])):
        merged = merge_runs(order, tmp_path / f"merged-{number}")
        assert merged.broken == merged.missing == merged.differing == ()
        assert len(merged.double) == 3
        assert untimed(merged.rows) == untimed(whole.rows)
        assert "world fell apart" in (merged.folder / "errors.log").read_text()
    only = merge_runs([tmp_path / "broken"], tmp_path / "merged-2")
    assert only.broken == (("MoveCube", "no-history", 0),)


def test_double_cells_that_differ_are_told_apart(tmp_path: Path) -> None:
    run(tmp_path / "a", families=["MoveCube"])
    run(tmp_path / "b", families=["MoveCube"])
    log = tmp_path / "b" / "rollouts.jsonl"
    lines = log.read_text().splitlines(keepends=True)
    changed = json.loads(lines[0])
    changed["steps"] -= 1
    log.write_text(json.dumps(changed) + "\n" + "".join(lines[1:]))
    merged = merge_runs([tmp_path / "a", tmp_path / "b"], tmp_path / "merged")
    assert len(merged.double) == 4
    assert merged.differing == ((changed["family"], changed["condition"], changed["episode"]),)
    assert list(merged.rows) == sorted(
        read_log(tmp_path / "a").values(), key=lambda row: (row.episode, row.condition == "k0")
    )


def test_videos_come_along(tmp_path: Path) -> None:
    run(tmp_path / "a", families=["MoveCube"], episodes="0", conditions=["k0"], videos=True)
    (row,) = merge_runs([tmp_path / "a"], tmp_path / "merged").rows
    assert row.video is not None
    here, there = (tmp_path / name / row.video for name in ("a", "merged"))
    assert here.read_bytes() == there.read_bytes()


def test_other_runs_and_taken_folders_are_refused(tmp_path: Path) -> None:
    run(tmp_path / "a", families=["MoveCube"], episodes="0")
    run(tmp_path / "b", families=["MoveCube"], episodes="0", model_seed=1)
    with pytest.raises(RunFolderError, match=r"b holds another run: model_seed is 1 there, 0 here"):
        merge_runs([tmp_path / "a", tmp_path / "b"], tmp_path / "merged")
    with pytest.raises(RunFolderError, match="b is there already"):
        merge_runs([tmp_path / "a"], tmp_path / "b")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RunFolderError, match="empty holds no run"):
        merge_runs([tmp_path / "a", tmp_path / "empty"], tmp_path / "merged")
    (tmp_path / "a" / "rollouts.jsonl").write_text("{}\n")
    with pytest.raises(FormatError, match="line 1 is not a row"):
        merge_runs([tmp_path / "a"], tmp_path / "merged")
    assert not (tmp_path / "merged").exists()
    with pytest.raises(InvalidOptionError, match="4/3 is not a shard"):
        run(tmp_path / "c", shard="4/3")
    assert not (tmp_path / "c").exists()


def test_the_command_tells_what_is_missing_and_double(tmp_path: Path) -> None:
    first, second, third = shards(tmp_path)
    words = ["merge", str(first), str(first), str(second), "--out"]
    done = CliRunner().invoke(app, [*words, str(tmp_path / "merged")])
    assert done.exit_code == 0, done.output
    count = len(read_log(third))
    assert f"{count} missing: " in done.stderr
    assert f"{len(read_log(first))} in more than one run, the first one kept: " in done.stderr
    assert f"{16 - count} of 16 rollouts in " in done.stdout
    shown = CliRunner().invoke(app, [*words, str(tmp_path / "again"), "--json"])
    told = json.loads(shown.stdout)
    assert (told["planned"], told["rows"], len(told["missing"])) == (16, 16 - count, count)
    assert told["differing"] == told["broken"] == []
