"""A whole run: rows, resume, and the same from one worker as from several."""

import csv
import dataclasses
import json
from pathlib import Path

import factories
import pyarrow.parquet as pq
import pytest
import rollout_doubles
from hypothesis import given
from hypothesis import strategies as st
from run_calls import CHEAT, WORLD, run, untimed

from robomme_interference_data import load_split
from robomme_interference_data.errors import PolicyError
from robomme_interference_data.evaluate import run_evaluation
from robomme_interference_data.evaluate.log import read_log
from robomme_interference_data.evaluate.rows import ROLLOUT_SCHEMA, TIMING_COLUMNS, Rollout

pytestmark = pytest.mark.usefixtures("world")


def test_what_a_policy_says_of_itself_is_on_record(tmp_path: Path) -> None:
    changes = {"conditions": ["no-history"], "families": ["MoveCube"], "episodes": "0"}
    run(tmp_path / "run", policy="python:own_policies:with_array", **changes)
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["policy"] == {"policy": "still", "sizes": [0, 1, 2], "4": 5.0}
    with pytest.raises(PolicyError, match=r"metadata\(\) returned a str"):
        run(tmp_path / "other", policy="python:own_policies:with_text", **changes)
    assert not (tmp_path / "other").exists()


# --- a run -------------------------------------------------------------------------------------


def test_a_run_writes_a_row_for_every_rollout(tmp_path: Path) -> None:
    result = run(tmp_path / "run")
    # Four families with two episodes each, under two conditions. Without history the cheat fails,
    # but for MoveCube/test/1, which times out.
    assert result.counts == {"success": 8, "fail": 7, "timeout": 1, "error": 0}
    assert (result.planned, result.stopped, len(result.rows)) == (16, None, 16)
    first = [(row.family, row.episode, row.condition) for row in result.rows[:4]]
    assert first == [("VideoRepick", i, c) for i in (0, 1) for c in ("no-history", "k0")]
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["status"] == "complete"
    assert header["counts"] == result.counts
    assert header["policy"] == {"policy": "cheat"}
    assert header["plans"] == [
        {
            "families": list(factories.FAMILIES),
            "episodes": [0, 1],
            "conditions": ["no-history", "k0"],
            "shard": "1/1",
        }
    ]
    assert {"numpy", "python", "robomme-interference-data"} <= set(header["versions"])


def test_the_three_files_agree(tmp_path: Path) -> None:
    rows = [row.as_dict() for row in run(tmp_path / "run", families=["MoveCube"]).rows]
    table = pq.read_table(tmp_path / "run" / "rollouts.parquet")
    assert table.schema.equals(ROLLOUT_SCHEMA)
    assert table.to_pylist() == rows
    with (tmp_path / "run" / "rollouts.csv").open(newline="") as file:
        read = list(csv.DictReader(file))
    assert list(read[0]) == ROLLOUT_SCHEMA.names == [f.name for f in dataclasses.fields(Rollout)]
    for text, row in zip(read, rows, strict=True):
        assert text["episode"] == str(row["episode"])
        assert text["success"] == ("true" if row["success"] else "false")
        assert text["retrieval_model"] == ""
        assert text["wall_s"] == str(row["wall_s"])
    lines = (tmp_path / "run" / "rollouts.jsonl").read_text().splitlines()
    logged = [json.loads(line) for line in lines]  # as they ended
    assert sorted(logged, key=rows.index) == rows


def test_several_workers_write_what_one_writes(tmp_path: Path) -> None:
    one = run(tmp_path / "one", conditions=["no-history", "k0", "k3"])
    four = run(tmp_path / "four", conditions=["k3", "no-history", "k0"], workers=4)
    assert untimed(one.rows) == untimed(four.rows)
    tables = [
        pq.read_table(tmp_path / name / "rollouts.parquet").drop_columns(list(TIMING_COLUMNS))
        for name in ("one", "four")
    ]
    assert tables[0].equals(tables[1])


def test_conditions_are_those_that_the_split_has(tmp_path: Path) -> None:
    result = run(tmp_path / "run", conditions=None, families=["MoveCube"], episodes="0")
    assert [row.condition for row in result.rows] == ["no-history", "k0", "k1", "k3"]


# --- resume ------------------------------------------------------------------------------------


def test_finished_rollouts_are_not_run_again(tmp_path: Path) -> None:
    first = run(tmp_path / "run", families=["MoveCube"])
    text = (tmp_path / "run" / "rollouts.jsonl").read_text()
    again = run(tmp_path / "run", families=["MoveCube"], workers=2)
    assert again.rows == first.rows
    assert (tmp_path / "run" / "rollouts.jsonl").read_text() == text


def test_a_run_may_grow(tmp_path: Path) -> None:
    run(tmp_path / "run", families=["PatternLock"], episodes="1")
    grown = run(tmp_path / "run", families=["MoveCube", "PatternLock"], episodes="0-1")
    assert len(grown.rows) == 8
    table = pq.read_table(tmp_path / "run" / "rollouts.parquet").to_pylist()
    assert [(r["family"], r["episode"]) for r in table[::2]] == [
        *[("MoveCube", 0), ("MoveCube", 1), ("PatternLock", 0), ("PatternLock", 1)]
    ]
    # A smaller plan keeps the rows of the larger one.
    run(tmp_path / "run", families=["PatternLock"], episodes="1")
    assert pq.read_metadata(tmp_path / "run" / "rollouts.parquet").num_rows == 8
    assert len(json.loads((tmp_path / "run" / "run.json").read_text())["plans"]) == 2  # each once


@given(cut=st.integers(1, 400))
def test_a_torn_line_is_dropped_and_run_again(
    tmp_path_factory: pytest.TempPathFactory, cut: int
) -> None:
    out = tmp_path_factory.mktemp("torn") / "run"
    whole = _whole_run()
    out.mkdir()
    for name in ("run.json", "rollouts.jsonl"):
        (out / name).write_bytes(whole[name])
    log = out / "rollouts.jsonl"
    log.write_bytes(log.read_bytes()[:-cut])
    kept = read_log(out)
    assert len(kept) == 3 or cut > len(whole["rollouts.jsonl"].splitlines()[-1])
    assert log.read_bytes().startswith(b"".join(_lines(whole["rollouts.jsonl"])[: len(kept)]))


def _lines(text: bytes) -> list[bytes]:
    return [line + b"\n" for line in text.split(b"\n")[:-1]]


_WHOLE: dict[str, bytes] = {}


def _whole_run() -> dict[str, bytes]:
    if not _WHOLE:
        import tempfile

        with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
            patch.setenv(rollout_doubles.SPLIT, str(factories.split()))
            run(Path(folder) / "run", families=["MoveCube"])
            for name in ("run.json", "rollouts.jsonl"):
                _WHOLE[name] = (Path(folder) / "run" / name).read_bytes()
    return _WHOLE


def test_after_a_torn_line_the_run_goes_on(tmp_path: Path) -> None:
    out = tmp_path / "run"
    first = run(out, families=["MoveCube"])
    log = out / "rollouts.jsonl"
    log.write_bytes(log.read_bytes()[:-20])
    again = run(out, families=["MoveCube"])
    assert untimed(again.rows) == untimed(first.rows)
    assert len(log.read_bytes().splitlines()) == 4
    assert read_log(out) == {row.key: row for row in again.rows}


def test_the_split_may_be_given_by_any_path(tmp_path: Path) -> None:
    run(tmp_path / "run", families=["MoveCube"], episodes="0")
    link = tmp_path / "split"
    link.symlink_to(factories.split())
    again = run_evaluation(
        CHEAT,
        link,
        tmp_path / "run",
        simulator=WORLD,
        system="mine",
        families=["MoveCube"],
        episodes="0",
        conditions=["no-history", "k0"],
    )
    assert len(again.rows) == 2
    assert load_split(link).revision == load_split(factories.split()).revision
