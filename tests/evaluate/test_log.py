"""The files of a run, compared with golden ones, and damaged records."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.run.identity import plain
from robomme_interference_data.evaluate.run.log import open_log, read_run
from robomme_interference_data.evaluate.run.row import model_columns, read_record
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.storage.parquet import open_parquet

GOLDEN = Path(__file__).parent.parent / "golden" / "run"

HEADER, KNOWN = read_run(GOLDEN)
ROWS = list(KNOWN.values())
"""One of the lesson behind seven units, one with retrieved frames, and one that broke."""


@pytest.mark.parametrize("name", ["run", "not-utf-8-\udcff"])
def test_golden_files(tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    with open_log(out, HEADER.identity, HEADER.buffer_set) as log:
        log.begin(HEADER.invocations[0], HEADER.probe)
        for row in ROWS:
            log.append(row, trace="Traceback\n…" if row.error else None)
        log.end(log.header)
    for file in ("rollouts.jsonl", "rollouts.csv", "run.json", "errors.log"):
        assert (out / file).read_text() == (GOLDEN / file).read_text(), file
    table = open_parquet(out / "rollouts.parquet").read()
    assert table.to_pylist() == [to_dict(row) for row in ROWS[::-1]]  # in canonical order


def test_a_killed_run_has_the_status_of_its_record(tmp_path: Path) -> None:
    out = tmp_path / "run"
    with open_log(out, HEADER.identity, "my-buffers") as log:
        log.begin(HEADER.invocations[0])
        for row in ROWS[:2]:
            log.append(row)
    assert json.loads((out / "run.json").read_text())["status"] == "running"
    header, _ = read_run(out)
    assert (header.status, header.planned) == ("incomplete", 3)
    assert header.counts == {"success": 1, "fail": 0, "timeout": 1, "error": 0}


HOSTILE = st.recursive(
    st.integers()
    | st.integers(10**300, 10**5000)
    | st.text(st.characters(codec=None))
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.binary(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
)
"""What policies, models and servers may report."""


def nested(depth: int) -> Any:
    return [nested(depth - 1)] if depth else "deep"


@pytest.mark.slow
@settings(max_examples=50)
@given(tokens=st.lists(st.integers(), max_size=3), metadata=HOSTILE, text=st.text(max_size=99))
@example(tokens=[10**30], metadata=nested(200), text="\ud800\x1b[2J")
@example(tokens=[-1], metadata={"a": {"b": nested(90)}}, text="")
def test_a_run_can_read_everything_that_it_writes(
    tmp_path_factory: pytest.TempPathFactory, tokens: list[int], metadata: Any, text: str
) -> None:
    out = tmp_path_factory.mktemp("hostile")
    stored = plain({"metadata": metadata, text: text})
    columns = model_columns(1, tokens, 0)
    row = replace(ROWS[2], **columns, error=plain(text), finished_at=None)
    with open_log(out, {"policy_metadata": stored}, "my-buffers") as log:
        log.begin(replace(HEADER.invocations[0], policy=stored))
        log.append(row, text)
        log.end(log.header)
    header, rows = read_run(out)
    assert header.identity == {"policy_metadata": stored} and [*rows.values()] == [row]
    assert header.invocations[0].policy == stored
    stands = all(one >= 0 for one in tokens) and sum(tokens) < 1 << 63
    assert (columns["model_tokens"], columns["model_faults"]) == (
        sum(tokens) if tokens and stands else None,
        int(not stands),
    )


@given(cut=st.integers(0, 2000))
def test_only_a_line_that_was_cut_short_is_dropped(
    tmp_path_factory: pytest.TempPathFactory, cut: int
) -> None:
    out = tmp_path_factory.mktemp("torn")
    whole = (GOLDEN / "rollouts.jsonl").read_bytes()
    text = whole[: max(0, len(whole) - cut)]
    (out / "run.json").write_bytes((GOLDEN / "run.json").read_bytes())
    (out / "rollouts.jsonl").write_bytes(text)
    kept = text.count(b"\n")
    assert list(read_record(out).values()) == ROWS[:kept]
    with open_log(out, HEADER.identity, "my-buffers") as log:
        assert list(log.rows.values()) == ROWS[:kept]
    assert (out / "rollouts.jsonl").read_bytes() == b"".join(whole.splitlines(True)[:kept])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"{}", "system is missing"),
        (b"not json", "Expecting value"),
        (b"[" * 20_000, "recursion"),
        (json.dumps(to_dict(ROWS[0]) | {"condition": "k"}).encode(), "'k' is not a condition"),
        (json.dumps(to_dict(ROWS[0]) | {"status": "fail"}).encode(), "contradicts status"),
        (json.dumps(to_dict(ROWS[1]) | {"video": "../x"}).encode(), "'../x'; expected videos"),
        (json.dumps(to_dict(ROWS[1]) | {"video": "run.json"}).encode(), "video 'run.json'"),
        (json.dumps(to_dict(ROWS[0])).encode(), "a second one of MoveCube/test/3 under k7"),
    ],
)
def test_a_damaged_line_is_an_error_with_its_number(
    tmp_path: Path, line: bytes, words: str
) -> None:
    first = (GOLDEN / "rollouts.jsonl").read_bytes().splitlines(True)[0]
    (tmp_path / "rollouts.jsonl").write_bytes(first + line + b"\n")
    with raises(FormatError) as e:
        read_record(tmp_path)
    assert words in e.value.message
