"""The files of a run, held against golden ones, and what is no record."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.run.log import open_log, read_record, read_run
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.storage.parquet import open_parquet

GOLDEN = Path(__file__).parent.parent / "golden" / "run"

HEADER, KNOWN = read_run(GOLDEN)
ROWS = list(KNOWN.values())
"""One of the lesson behind seven units, one with a retrieval step, and one that broke."""


@pytest.mark.parametrize("name", ["run", "not-utf-8-\udcff"])
def test_golden_files(tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    with open_log(out, HEADER.identity, HEADER.split) as log:
        log.begin(HEADER.starts[0])
        for row in ROWS:
            log.append(row, trace="Traceback\n…" if row.error else None)
        log.end(log.header)
    for file in ("rollouts.jsonl", "rollouts.csv", "run.json", "errors.log"):
        assert (out / file).read_text() == (GOLDEN / file).read_text(), file
    table = open_parquet(out / "rollouts.parquet").read()
    assert table.to_pylist() == [to_dict(row) for row in ROWS[::-1]]  # in canonical order


def test_a_killed_run_stands_as_its_record_says(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with open_log(out, HEADER.identity, "my-split") as log:
        log.begin(HEADER.starts[0])
        for row in ROWS[:2]:
            log.append(row)
    assert json.loads((out / "run.json").read_text())["status"] == "running"
    header, _ = read_run(out)
    assert (header.status, header.planned) == ("incomplete", 3)
    assert header.counts == {"success": 1, "fail": 0, "timeout": 1, "error": 0}


@given(cut=st.integers(0, 2000))
def test_a_line_that_was_cut_short_is_dropped_and_only_that_one(
    tmp_path_factory: pytest.TempPathFactory, cut: int
) -> None:
    out = tmp_path_factory.mktemp("torn")
    whole = (GOLDEN / "rollouts.jsonl").read_bytes()
    text = whole[: max(0, len(whole) - cut)]
    (out / "run.json").write_bytes((GOLDEN / "run.json").read_bytes())
    (out / "rollouts.jsonl").write_bytes(text)
    kept = text.count(b"\n")
    assert list(read_record(out).values()) == ROWS[:kept]
    with open_log(out, HEADER.identity, "my-split") as log:
        assert list(log.rows.values()) == ROWS[:kept]
    assert (out / "rollouts.jsonl").read_bytes() == b"".join(whole.splitlines(True)[:kept])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"{}", "system is missing"),
        (b"not json", "Expecting value"),
        (b"[" * 20_000, "recursion"),
        (json.dumps(to_dict(ROWS[0]) | {"unknown": 1}).encode(), "unknown unknown"),
        (json.dumps(to_dict(ROWS[0]) | {"steps": "many"}).encode(), "steps: 'many'"),
        (json.dumps(to_dict(ROWS[0]) | {"condition": "k"}).encode(), "'k' is not a condition"),
        (json.dumps(to_dict(ROWS[0]) | {"status": "fail"}).encode(), "contradicts status"),
        (
            json.dumps(to_dict(ROWS[1]) | {"video": "../x"}).encode(),
            "video '../x'; expected videos",
        ),
        (json.dumps(to_dict(ROWS[1]) | {"video": "run.json"}).encode(), "video 'run.json'"),
        (json.dumps(to_dict(ROWS[0])).encode(), "a second one of MoveCube/test/3 under k7"),
    ],
)
def test_a_damaged_line_is_named(tmp_path: Path, line: bytes, words: str) -> None:
    first = (GOLDEN / "rollouts.jsonl").read_bytes().splitlines(True)[0]
    (tmp_path / "rollouts.jsonl").write_bytes(first + line + b"\n")
    with pytest.raises(FormatError, match=r"rollouts\.jsonl, line 2 is no row of a rollout") as e:
        read_record(tmp_path)
    assert words in e.value.message
