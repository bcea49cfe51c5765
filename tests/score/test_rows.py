"""Rows are read from CSV, parquet and records of runs alike; bad ones are named and refused."""

import json
import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support import scoring as made
from support.messages import raises
from support.scoring import GOOD

from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.evaluate.score.compare import compare
from robomme_interference_data.evaluate.score.rows import row_format
from robomme_interference_data.evaluate.score.rows.export import export
from robomme_interference_data.evaluate.score.rows.reading import CheckedRows, read_rows

COLUMNS = ("simulator", "system", "condition", "family", "episode", "model_seed", "status")


def told(rows: CheckedRows, *columns: str) -> list[tuple[Any, ...]]:
    """What the rows hold, sorted."""
    return sorted((tuple(getattr(row, c) for c in columns or COLUMNS) for row in rows), key=repr)


def write(path: Path, **columns: Any) -> Path:
    """Write the rows of `scoring` with some columns replaced."""
    table = pq.read_table(made.write_parquet(path, made.rows()))
    for name, values in columns.items():
        table = table.set_column(table.schema.get_field_index(name), name, values)
    pq.write_table(table, path)
    return path


# --- what is read ------------------------------------------------------------------------------


def test_csv_parquet_and_runs_are_read_alike(tmp_path: Path) -> None:
    rows = made.rows()
    run = made.write_run(tmp_path / "run", rows, status="complete")
    by_csv, by_parquet, by_run = (
        read_rows([path])
        for path in (
            made.write_csv(tmp_path / "a.csv", rows),
            made.write_parquet(tmp_path / "a.parquet", rows),
            run,
        )
    )
    assert len(by_csv) == 107  # 9 cells of 12, one row missing
    assert told(by_csv) == told(by_parquet) == told(by_run)
    for other in (by_csv, by_parquet, by_run):
        assert set(other.names("system")) == {made.BASE, made.RETRIEVAL, made.OWN}
        assert other.revisions == {"tabletop": made.REVISION}
    header = by_run.sources[run / "rollouts.jsonl"]
    assert header is not None and header.status == "complete"
    assert list(by_csv.sources.values()) == [None]


@settings(max_examples=5)
@given(st.randoms(use_true_random=False), st.integers(1, 3))
def test_the_order_of_rows_and_files_makes_no_difference(
    tmp_path_factory: pytest.TempPathFactory, order: random.Random, files: int
) -> None:
    folder = tmp_path_factory.mktemp("shuffled")
    rows = [
        *made.rows(),
        *made.changed(made.rows()[:20], model_seed=5),
        *made.changed(made.rows()[:9], model_seed=3),
    ]
    expected = made.score(made.write_parquet(folder / "all.parquet", rows), draws=50)
    order.shuffle(rows)
    found = made.score(
        *(made.write_parquet(folder / f"{n}.parquet", rows[n::files]) for n in range(files)),
        draws=50,
    )
    assert {name: table.csv() for name, table in found.tables.items()} == {
        name: table.csv() for name, table in expected.tables.items()
    }


def test_a_record_holds_what_came_last(tmp_path: Path) -> None:
    good = made.rows()[3]
    broken = replace(good, status="error", success=None, error="it broke")
    folder = made.write_run(tmp_path / "run", [broken, made.rows()[4], broken, good])
    assert told(read_rows([folder]), "episode", "status") == [(3, "fail"), (4, "fail")]
    # A crash can cut the last line short.
    record = folder / "rollouts.jsonl"
    record.write_bytes(record.read_bytes() + b'{"system": "my')
    assert len(read_rows([folder])) == 2
    record.write_bytes(b'{"system": "my')
    with raises(FormatError):
        read_rows([folder])
    # What did not break is not run again: two rows contradict each other.
    made.write_run(folder, [good, broken])
    with raises(FormatError):
        read_rows([folder])


def test_the_released_layout(tmp_path: Path) -> None:
    lines = [
        GOOD,
        "my-memory,MoveCube,k0,1,8,hard,ongoing,False,1300",
        "my-memory,MoveCube,no-history,1,8,hard,error,,0",
    ]
    path = made.released(tmp_path / "a.csv", lines)
    expected = [
        ("robomme", "my-memory", "k0", "MoveCube", 0, 0, "success"),
        ("robomme", "my-memory", "k0", "MoveCube", 1, 0, "timeout"),
        ("robomme", "my-memory", "no-history", "MoveCube", 1, 0, "error"),
    ]
    assert told(read_rows([path])) == expected
    # The paper's own tables call a system a variant; a program may begin a file with a mark.
    text = path.read_text(encoding="utf-8").replace("system", "variant", 1)
    path.write_text(text, encoding="utf-8-sig")
    assert told(read_rows([path])) == expected


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_csv_files_as_other_programs_save_them(tmp_path: Path, end: str) -> None:
    """With the line ends of any system, a mark at the start, and blank lines."""
    text = made.write_csv(tmp_path / "a.csv", made.rows()).read_text(encoding="utf-8")
    lines = [*text.splitlines(), "", " ", "," * text.splitlines()[0].count(","), ",,", ""]
    lines.insert(5, "")
    saved = tmp_path / "b.csv"
    for encoding in ("utf-8-sig", "utf-16"):
        saved.write_text(end.join(lines), encoding=encoding, newline="")
        assert told(read_rows([saved])) == told(read_rows([tmp_path / "a.csv"]))


def test_columns_without_a_name_are_not_read(tmp_path: Path) -> None:
    """Such as the index of pandas, and what a spreadsheet has behind the last column."""
    text = made.write_csv(tmp_path / "a.csv", made.rows()).read_text(encoding="utf-8")
    head, *lines = text.splitlines()
    wide = [f",{head},,", *(f"{number},{line},," for number, line in enumerate(lines))]
    (tmp_path / "b.csv").write_text("\n".join(wide), encoding="utf-8")
    table = pq.read_table(made.write_parquet(tmp_path / "a.parquet", made.rows()))
    indexed = table.append_column("__index_level_0__", pa.array(range(len(table))))
    pq.write_table(indexed, tmp_path / "b.parquet")
    expected = told(read_rows([tmp_path / "a.csv"]))
    for name in ("b.csv", "b.parquet"):
        assert told(read_rows([tmp_path / name])) == expected


@pytest.mark.parametrize("separator", [";", "\t"])
def test_other_separators_are_named(tmp_path: Path, separator: str) -> None:
    path = made.released(tmp_path / "rows.csv", [GOOD])
    path.write_text(path.read_text(encoding="utf-8").replace(",", separator))
    with raises(FormatError) as raised:
        read_rows([path])
    assert "commas" in raised.value.message


def test_simulators_have_revisions_scenes_and_names_of_their_own(tmp_path: Path) -> None:
    names = ("my_package.kitchen:make_simulator", "_doubles:make", "sim-2.1", "x" * 128)
    rows = made.rows()[:2]
    for number, name in enumerate(names):
        rows += made.changed(rows[:2], simulator=name, revision=f"{number}" * 64, seed=number)
    found = read_rows([made.write_csv(tmp_path / "a.csv", rows)])
    assert found.names("simulator") == sorted((*names, "tabletop"))
    assert len(found.revisions) == 5


@pytest.mark.parametrize("kind", [pa.float32(), pa.float64(), pa.uint8(), pa.string()])
def test_numbers_of_any_type_are_read_alike(tmp_path: Path, kind: Any) -> None:
    episodes = pa.array([row.episode for row in made.rows()]).cast(kind)
    success = pa.array([row.success for row in made.rows()]).cast(pa.int8()).cast(pa.float64())
    words = pa.array([row.family for row in made.rows()]).dictionary_encode()
    found = write(tmp_path / "a.parquet", episode=episodes, success=success, family=words)
    expected = made.write_parquet(tmp_path / "b.parquet", made.rows())
    assert told(read_rows([found])) == told(read_rows([expected]))


@pytest.mark.parametrize("gap", [None, float("nan")])
def test_a_scene_may_lack_its_seed_but_no_rollout_the_models(tmp_path: Path, gap: Any) -> None:
    seeds = [gap, *(float(row.seed or 0) for row in made.rows()[1:])]
    path = write(tmp_path / "a.parquet", seed=pa.array(seeds, from_pandas=False))
    assert [row.seed for row in read_rows([path])][:2] == [None, 1]
    text = made.write_csv(tmp_path / "b.csv", made.rows()).read_text()
    (tmp_path / "b.csv").write_text(text.replace(",1000,", ",1000.0,"))  # as with a gap beside it
    assert 1000 in read_rows([tmp_path / "b.csv"]).names("seed")
    models = pa.array([0.0, gap, *([5.0] * 105)], from_pandas=False)
    path = write(tmp_path / "c.parquet", model_seed=models)
    with raises(FormatError):
        read_rows([path])
    found = read_rows([path], lenient=True)
    assert (len(found), found.bad_count, found.names("model_seed")) == (106, 1, [0, 5])


# --- bad rows ----------------------------------------------------------------------------------

BAD = {
    "a family": ("my-memory,easy,k0,0,7,easy,fail,0,9", "'easy' is not a family name"),
    "a condition": ("my-memory,MoveCube,k64,0,7,easy,fail,0,9", "'k64' is not a condition"),
    "won": ("my-memory,MoveCube,k0,0,7,easy,fail,1,9", "success True contradicts status 'fail'"),
    "neither": ("my-memory,MoveCube,k0,0,7,easy,success,,9", "success (empty) contradicts"),
    "maybe": ("my-memory,MoveCube,k0,0,7,easy,fail,maybe,9", "success 'maybe'; expected 1, 0"),
    "too great": (f"my-memory,MoveCube,k0,{10**18},7,easy,fail,0,9", "expected a whole number"),
    "no episode": ("my-memory,MoveCube,k0,,7,easy,fail,0,9", "episode (empty); expected a whole"),
    "two difficulties": ("my-memory,MoveCube,k1,0,7,hard,fail,0,9", "difficulty 'hard' beside"),
    "too short": ("my-memory,MoveCube,k0,1,7,easy,fail,0", "the line has 8 fields; expected 9"),
    "twice": (GOOD, "the same rollout as"),
    "no columns": ("x", "the line has 1 field; expected 9"),
}


@pytest.mark.parametrize(("line", "reason"), BAD.values(), ids=BAD.keys())
def test_bad_rows_are_refused_with_file_line_and_reason(
    tmp_path: Path, line: str, reason: str
) -> None:
    path = made.released(tmp_path / "rows.csv", [GOOD, line, GOOD.replace("k0", "k3")])
    with pytest.raises(FormatError) as raised:
        read_rows([path])
    assert raised.value.message.startswith(f"1 bad row:\n{path}, line 3: ")
    assert reason in raised.value.message
    assert raised.value.hint is not None and "lenient" in raised.value.hint
    # Leniently it is left out and counted; the others stay.
    found = read_rows([path], lenient=True)
    assert (found.bad_count, len(found)) == (1, 2)
    assert found.bad_reasons[0].startswith(f"{path}, line 3: ") and reason in found.bad_reasons[0]


OF_RUNS = {
    "another buffer set": ({"revision": "cd" * 32}, "rows of different buffer sets do not mix"),
    "no revision": ({"revision": ""}, "revision (empty); expected"),
    "another scene": ({"seed": 5}, "seed 5 beside 1002: an episode has one"),
    "a path": ({"simulator": "../escaped"}, "simulator '../escaped'; expected up to 128 letters"),
    "a fraction": ({"retrieval_selected_lesson_fraction": "half"}, "'half'; expected"),
}


@pytest.mark.parametrize(("change", "reason"), OF_RUNS.values(), ids=OF_RUNS.keys())
def test_bad_rows_of_runs_are_refused(tmp_path: Path, change: dict[str, Any], reason: str) -> None:
    rows = made.rows()
    rows[20] = replace(rows[20], **change)
    path = made.write_csv(tmp_path / "a.csv", rows)
    with pytest.raises(FormatError) as raised:
        read_rows([path])
    first = raised.value.message.splitlines()[1]
    assert first.startswith(f"{path}, line 22: ") and reason in first
    found = read_rows([path], lenient=True)
    assert (found.bad_count, len(found)) == (1, 106)


def test_leniently_the_most_frequent_revision_is_kept(tmp_path: Path) -> None:
    rows = made.rows()
    rows[0] = replace(rows[0], revision="cd" * 32)
    found = read_rows([made.write_csv(tmp_path / "a.csv", rows)], lenient=True)
    assert found.bad_count == 1 and found.revisions == {"tabletop": made.REVISION}
    assert "line 2: revision 'cdcd" in found.bad_reasons[0]


def test_lines_are_right_after_quoted_line_breaks(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(
        "system,goal,family,condition,episode,status,success\n"
        'mine,"do\nit",X/Y,k0,0,fail,0\n'  # lines 2 and 3
        "mine,do,MoveCube,k0,1,fail,0\n"
        "too,short\n"
        'mine,"a ""long\n\nstory""",MoveCube,k0,1,fail,0\n'  # lines 6 to 8
        "mine,do,2Cubes,k0,2,fail,0\n"
    )
    found = read_rows([path], lenient=True)
    assert len(found) == 1
    assert [text.removeprefix(f"{path}, line ")[:10] for text in found.bad_reasons] == [
        *("2: 'X/Y' i", "5: the lin", "6: the sam", "9: '2Cubes")
    ]
    assert f"as {path}, line 4" in found.bad_reasons[2]


def test_many_bad_rows_are_counted_and_ten_are_named(tmp_path: Path) -> None:
    lines = [f"my-memory,MoveCube,k0,{n},{n},easy,fail,1,9" for n in range(25)]
    path = made.released(tmp_path / "rows.csv", [*lines, GOOD])
    with pytest.raises(FormatError) as raised:
        read_rows([path])
    shown = raised.value.message.splitlines()
    assert (shown[0], len(shown), shown[-1]) == ("25 bad rows:", 12, "… and 15 more")
    assert len(read_rows([path], lenient=True).bad_reasons) == 10


def test_rows_of_one_rollout_that_contradict_each_other_all_go(tmp_path: Path) -> None:
    rows = made.rows()
    other = replace(rows[8], status="timeout", success=False)  # rows[8] failed
    one = made.write_csv(tmp_path / "one.csv", rows[:50])
    two = made.write_csv(tmp_path / "two.csv", [other, rows[60]])
    three = made.write_csv(tmp_path / "three.csv", [rows[3], rows[8]])
    with pytest.raises(FormatError) as raised:
        read_rows([one, two, three])
    more = "; its rows contradict each other"
    assert raised.value.message.splitlines() == [
        "4 bad rows:",
        f"{one}, line 10: the same rollout as {two}, line 2{more}",
        f"{two}, line 2: the same rollout as {one}, line 10{more}",
        f"{three}, line 2: the same rollout as {one}, line 5",
        f"{three}, line 3: the same rollout as {one}, line 10{more}",
    ]
    # Of equal rows one stays and counts.
    kept = made.write_csv(tmp_path / "kept.csv", [*rows[:8], *rows[9:50], rows[60]])
    for paths in ([one, two, three], [three, two, one], [two, one, three]):
        found = read_rows(paths, lenient=True)
        assert (told(found), found.bad_count) == (told(read_rows([kept])), 4)


def test_nothing_but_bad_rows_and_no_rows_are_no_score(tmp_path: Path) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.changed(made.rows()[:3], family="X/Y"))
    with raises(FormatError):
        made.score(path, lenient=True)
    with raises(FormatError):
        made.score(made.write_csv(tmp_path / "b.csv", []))
    with raises(FormatError):
        compare(tmp_path / "b.csv", path)


# --- shifts ------------------------------------------------------------------------------------


def test_rows_under_several_shifts_never_mix(tmp_path: Path) -> None:
    rows = made.cells({(made.OWN, "k0"): "ssff"})
    lit = made.changed(made.cells({(made.OWN, "k0"): "sfff"}), shift="light:2")
    found = made.score(made.write_csv(tmp_path / "a.csv", [*rows, *lit]))
    assert sorted(found.outcomes) == ["tabletop", "tabletop+light:2"]
    rates = {(one.simulator, one.part): one.counts[0] for one in found.cells if not one.part}
    assert rates == {("tabletop", ""): 2, ("tabletop+light:2", ""): 1}
    # Exported, they keep the name, and are read as what they are.
    exported = export(found.rows, tmp_path / "out")
    assert [path.name for path in exported] == [
        f"{made.OWN}-tabletop+light:2_rollouts.csv",
        f"{made.OWN}-tabletop_rollouts.csv",
    ]
    assert told(read_rows(exported, [made.OWN])) == told(found.rows)
    both = [made.write_csv(tmp_path / "b.csv", rows), made.write_csv(tmp_path / "c.csv", lit)]
    # Only a comparison that is asked for pairs them, and says so.
    (note, *_) = compare(*both).notes
    assert "a is of tabletop and b of tabletop+light:2" in note


@pytest.mark.parametrize(
    ("column", "value"), [("shift", "fog:1"), ("shift", ""), ("simulator", "tabletop+fog:1")]
)
def test_what_is_no_shift_is_a_bad_row(tmp_path: Path, column: str, value: str) -> None:
    path = write(tmp_path / "a.parquet", **{column: pa.array([value, *["none"] * 106])})
    with raises(FormatError):
        read_rows([path])


# --- files -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("family,condition,episode", "lacks the columns status or success"),
        ("family,condition,episode,status,success", "names no system"),
        ("system,family,family,condition,episode,status,success", "two columns 'family'"),
        ("", "lacks the columns"),
    ],
)
def test_files_without_what_is_needed_are_refused(
    tmp_path: Path, header: str, message: str
) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(header + "\n")
    with pytest.raises(FormatError) as raised:
        read_rows([path])
    assert message in raised.value.message and str(path) in raised.value.message
    assert raised.value.hint


def test_a_folder_that_is_of_no_run(tmp_path: Path) -> None:
    with raises(MissingFileError):
        read_rows([tmp_path])


def test_files_that_cannot_be_read(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    whole = made.write_parquet(tmp_path / "rows.parquet", made.rows()).read_bytes()
    text = made.write_csv(tmp_path / "rows.csv", made.rows()).read_bytes()
    record = (made.write_run(tmp_path / "run", made.rows()) / "rollouts.jsonl").read_bytes()
    damaged = {
        "a.csv": b"a,b\n1,\xff\n",
        # A byte that is no text in a line with too few fields.
        "late.csv": text + b"\xe9,x\n" + text,
        "cut.csv": b"a,b\n1,\xc3",
        "empty.parquet": b"",
        "b.parquet": whole[:200] + bytes(100) + whole[300:],
        "a.jsonl": record.replace(b'"episode"', b"episode", 1),
        "b.jsonl": record + b"[1]\n",
        "c.jsonl": record + b"[" * 100_000 + b"\n",
        "rows.txt": b"",
    }
    for name, data in damaged.items():
        (tmp_path / name).write_bytes(data)
        with raises(FormatError) as raised:
            read_rows([tmp_path / name], lenient=True)
        assert name in raised.value.message
        assert "UTF-8" in (raised.value.hint or "") or name not in ("a.csv", "late.csv", "cut.csv")
    nested = write(tmp_path / "n.parquet", family=pa.nulls(107, pa.list_(pa.string())))
    with raises(FormatError):
        read_rows([nested])
    assert capfd.readouterr().err == ""


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 3, 40_000])
@pytest.mark.parametrize("damage", [(b"{", b"{x"), (b'"MoveCube"', b"[]")])
def test_a_damaged_line_of_a_record_is_numbered_as_in_an_editor(
    tmp_path: Path, number: int, damage: tuple[bytes, bytes]
) -> None:
    """Also where pyarrow reads the file in several blocks."""
    run = made.write_run(tmp_path / "run", made.rows()[:1])
    record = run / "rollouts.jsonl"
    line = record.read_bytes()
    record.write_bytes(line * (number - 1) + line.replace(*damage, 1) + line * 2)
    with pytest.raises(FormatError) as raised:
        read_rows([run])
    assert f"{record}, line {number} " in raised.value.message
    assert "row " not in raised.value.message.removeprefix(str(record)).replace("no row of", "")
    assert "build" not in (raised.value.hint or "")


def test_files_of_too_many_rows_are_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(row_format, "_MAX_ROWS", 100)
    rows = made.rows()
    sources = (
        made.write_csv(tmp_path / "a.csv", rows),
        made.write_parquet(tmp_path / "a.parquet", rows),
        made.write_run(tmp_path / "run", rows),
    )
    for path in sources:
        with raises(FormatError):
            read_rows([path], lenient=True)


def test_files_that_are_not_there_or_twice(tmp_path: Path) -> None:
    for path in (tmp_path / "nowhere", tmp_path):
        with pytest.raises(MissingFileError):
            read_rows([path])
    path = made.write_csv(tmp_path / "a.csv", made.rows())
    with raises(InvalidOptionError):
        read_rows([path, tmp_path / "." / "a.csv"])
    folder = made.write_run(tmp_path / "run", made.rows())
    (folder / "run.json").write_text(json.dumps({"format_version": 99}))
    with raises(FormatError):
        read_rows([folder])


def test_rows_of_one_system_with_and_without_a_revision_do_not_mix(tmp_path: Path) -> None:
    rows = [r for r in made.rows() if r.system == made.RETRIEVAL]
    half = made.write_csv(tmp_path / "half.csv", rows[:12])
    other = tmp_path / "other.csv"
    other.write_text(
        "system,simulator,family,condition,episode,status,success\n"
        f"{made.RETRIEVAL},tabletop,MoveCube,k7,3,success,1\n"
    )
    for paths in ([half, other], [other, half]):
        with raises(InvalidOptionError):
            read_rows(paths, lenient=True)
