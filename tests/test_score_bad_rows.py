"""Bad rows are named by file and line and refused: values, duplicates, data that do not mix."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import score_rows as made
from score_rows import GOOD

from robomme_interference_data.errors import BadRowsError
from robomme_interference_data.evaluate.score import batches
from robomme_interference_data.evaluate.score.rollouts import read_rollouts
from robomme_interference_data.evaluate.score.scoring import score


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (
            "my-memory,MoveCub,k0,0,7,easy,fail,0,9",
            "unknown family 'MoveCub'. Did you mean 'MoveCube'?",
        ),
        ("my-memory,,k0,0,7,easy,fail,0,9", "unknown family ''"),
        ("my-memory,MoveCube,k64,0,7,easy,fail,0,9", "'k64' is not a condition"),
        (
            "my-memory,MoveCube,k0,0,7,easy,failed,0,9",
            "unknown status 'failed'. Did you mean 'fail'?",
        ),
        ("my-memory,MoveCube,k0,0,7,easy,fail,1,9", "success '1' contradicts status 'fail'"),
        ("my-memory,MoveCube,k0,0,7,easy,error,0,9", "success '0' contradicts status 'error'"),
        (
            "my-memory,MoveCube,k0,0,7,easy,success,,9",
            "success (empty) contradicts status 'success'",
        ),
        ("my-memory,MoveCube,k0,0,7,easy,fail,maybe,9", "success 'maybe'; expected 1, 0, true"),
        (
            "my-memory,MoveCube,k0,-1,7,easy,fail,0,9",
            "episode '-1'; expected a whole number from 0 to",
        ),
        ("my-memory,MoveCube,k0,1.5,7,easy,fail,0,9", "episode '1.5'; expected a whole number"),
        ("my-memory,MoveCube,k0,1_0,7,easy,fail,0,9", "episode '1_0'; expected a whole number"),
        ("my-memory,MoveCube,k0,٣,7,easy,fail,0,9", "episode '٣'; expected a whole number"),
        ("my-memory,MoveCube,k0, 3,7,easy,fail,0,9", "episode ' 3'; expected a whole number"),
        (
            "my-memory,MoveCube,k0,131072,7,easy,fail,0,9",
            "episode '131072'; expected a whole number",
        ),
        ("my-memory,MoveCube,k0,,7,easy,fail,0,9", "episode (empty); expected a whole number"),
        (
            "my-memory,MoveCube,k0,0,7,easy,fail,0,1301",
            "steps '1301'; expected a whole number from 0 to 1300",
        ),
        ("my-memory,MoveCube,k0,0,x,easy,fail,0,9", "seed 'x'; expected a whole number from 0"),
        ("my-memory,MoveCube,k0,0,7,tough,fail,0,9", "unknown difficulty 'tough'"),
        (
            "my-memory,MoveCube,k1,0,7,hard,fail,0,9",
            "difficulty 'hard' differs from that of other rows",
        ),
        ("my-memory,MoveCube,k1,0,9,easy,fail,0,9", "seed '9' differs from that of other rows"),
        ("pi05-baseline,MoveCube,k0,0,7,easy,fail,0,9", "reads like the system 'pi05_baseline'"),
        (",MoveCube,k0,0,7,easy,fail,0,9", "'' is not the name of a system"),
        ("my-memory,MoveCube,k0,1,7,easy,fail,0", "the line has 8 fields; expected 9"),
        (GOOD, "the same rollout as"),
        ("", "is not the name of a system"),
    ],
)
def test_bad_rows_are_refused_with_file_line_and_reason(
    tmp_path: Path, line: str, reason: str
) -> None:
    path = made.released(tmp_path / "rows.csv", [GOOD, line, GOOD.replace("k0", "k3")])
    with pytest.raises(BadRowsError) as raised:
        read_rollouts([path])
    assert raised.value.message.startswith(f"1 bad row:\n{path}, line 3: ")
    assert reason in raised.value.message
    assert raised.value.hint is not None and "--lenient" in raised.value.hint
    # Leniently it is left out and counted; the others stay.
    found = read_rollouts([path], lenient=True)
    assert (found.refused, len(found.packed)) == (1, 2)
    assert (found.refusals[0].line, found.refusals[0].path) == (3, path)
    assert reason in found.refusals[0].reason


def test_lines_are_right_in_every_block(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "_BLOCK", 150)  # about three rows
    lines = [f"my-memory,MoveCube,k0,{number},{number},easy,fail,0,9" for number in range(40)]
    for broken in (4, 11, 25):
        lines[broken] = "only,three,fields"
    lines[30] = lines[30].replace("fail", "bad")
    path = made.released(tmp_path / "rows.csv", lines)
    found = read_rollouts([path], lenient=True)
    assert {refusal.line for refusal in found.refusals} == {6, 13, 27, 32}
    assert (found.refused, len(found.packed)) == (4, 36)


def test_lines_are_right_after_quoted_line_breaks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batches, "_BLOCK", 600)  # about three rows: some end inside quotes
    rows = [replace(row, goal="do\nit" if row.episode % 2 else "do") for row in made.rows()[:20]]
    rows[5] = replace(rows[5], goal='a "long\r\n\nstory"')
    rows[7] = replace(rows[7], family="X")
    rows[15] = rows[14]
    path = made.write_csv(tmp_path / "a.csv", rows)
    lines = path.read_bytes().decode().splitlines(keepends=True)
    begins = [n for n, line in enumerate(lines, 1) if line.startswith(made.BASE)]
    lines[begins[18] - 1] = "too,short\n"
    path.write_bytes("".join(lines).encode())
    found = read_rollouts([path], lenient=True)
    assert len(begins) == 20 and len(found.packed) == 17
    assert sorted((r.line, r.reason.partition(" ")[0]) for r in found.refusals) == [
        (begins[7], "unknown"),
        (begins[15], "the"),
        (begins[18], "the"),
    ]


def test_rows_of_parquet_are_counted_from_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batches, "_BATCH", 10)
    table = pa.Table.from_pylist([row.as_dict() for row in made.rows()])
    names = table["family"].to_pylist()
    names[17] = "Unknown"
    place = table.schema.get_field_index("family")
    pq.write_table(table.set_column(place, "family", pa.array(names)), tmp_path / "x.parquet")
    with pytest.raises(BadRowsError, match=r"x\.parquet, row 18: unknown family 'Unknown'"):
        read_rollouts([tmp_path / "x.parquet"])


def test_many_bad_rows_are_counted_and_ten_are_named(tmp_path: Path) -> None:
    lines = [f"my-memory,MoveCube,k0,{n},{n},easy,fail,1,9" for n in range(25)]
    with pytest.raises(BadRowsError) as raised:
        read_rollouts([made.released(tmp_path / "rows.csv", lines)])
    shown = raised.value.message.splitlines()
    assert shown[0] == "25 bad rows:"
    assert len(shown) == 12 and shown[-1] == "… and 15 more so far"


def test_a_duplicate_in_another_file_names_both_places(tmp_path: Path) -> None:
    rows = made.rows()
    paths = [
        made.write_csv(tmp_path / "one.csv", rows[:50]),
        made.write_csv(tmp_path / "two.csv", [rows[60], rows[8]]),
    ]
    with pytest.raises(BadRowsError) as raised:
        read_rollouts(paths)
    assert raised.value.message.splitlines() == [
        "1 bad row:",
        f"{paths[1]}, line 3: the same rollout as {paths[0]}, line 10",
    ]
    found = read_rollouts(paths, lenient=True)
    assert (len(found.packed), found.refused) == (51, 1)
    # Equal rows: one stays, and counts.
    expected = read_rollouts([made.write_csv(tmp_path / "all.csv", [*rows[:50], rows[60]])])
    assert np.array_equal(found.packed, expected.packed)


def test_rows_of_one_rollout_that_contradict_each_other_all_go(tmp_path: Path) -> None:
    rows = made.rows()
    other = replace(rows[8], status="timeout", success=False)  # rows[8] failed
    one = made.write_csv(tmp_path / "one.csv", rows[:50])
    two = made.write_csv(tmp_path / "two.csv", [other, rows[60]])
    three = made.write_csv(tmp_path / "three.csv", [rows[3], rows[8]])
    with pytest.raises(BadRowsError) as raised:
        read_rollouts([one, two, three])
    more = "; its rows contradict each other"
    assert raised.value.message.splitlines() == [
        "4 bad rows:",
        f"{one}, line 10: the same rollout as {two}, line 2{more}",
        f"{two}, line 2: the same rollout as {one}, line 10{more}",
        f"{three}, line 2: the same rollout as {one}, line 5",
        f"{three}, line 3: the same rollout as {one}, line 10{more}",
    ]
    kept = [*rows[:8], *rows[9:50], rows[60]]
    expected = read_rollouts([made.write_csv(tmp_path / "kept.csv", kept)])
    for paths in ([one, two, three], [three, two, one], [two, one, three]):
        found = read_rollouts(paths, lenient=True)
        assert np.array_equal(found.packed, expected.packed)
        assert found.refused == 4


def test_of_rows_that_differ_on_an_episode_the_first_counts(tmp_path: Path) -> None:
    first = next(row for row in made.rows() if row.condition == "k0")
    rows = [replace(first, condition=name, seed=seed) for name, seed in KINDS]
    with pytest.raises(BadRowsError) as raised:
        read_rollouts([path := made.write_csv(tmp_path / "a.csv", rows)])
    assert raised.value.message.splitlines() == [
        "2 bad rows:",
        f"{path}, line 3: seed '8' differs from that of other rows of the same episode",
        f"{path}, line 5: seed '8' differs from that of other rows of the same episode",
    ]


KINDS = (("k0", 7), ("k1", 8), ("k3", 7), ("k7", 8))


def test_lines_of_duplicates_beside_lines_that_are_no_rows(tmp_path: Path) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.rows()[:2])
    lines = path.read_text(encoding="utf-8").splitlines()
    path.write_text("\n".join([lines[0], "x,y", *lines[1:], lines[1]]) + "\n", encoding="utf-8")
    found = read_rollouts([path], lenient=True)
    assert [str(refusal) for refusal in found.refusals] == [
        f"{path}, line 2: the line has 2 fields; expected {lines[0].count(',') + 1}",
        f"{path}, line 5: the same rollout as {path}, line 3",
    ]


def test_videos_are_those_of_rows_that_stay(tmp_path: Path) -> None:
    rows = [replace(row, video=f"{row.episode}.mp4") for row in made.rows()[:3]]
    changed = replace(rows[1], status="success", success=True, video="x.mp4")  # it failed
    folders = [tmp_path / name for name in "ab"]
    for folder, given_rows in zip(folders, (rows, [changed, rows[2]]), strict=True):
        folder.mkdir()
        made.write_parquet(folder / "rollouts.parquet", given_rows)
        (folder / "run.json").write_text('{"format_version": 1}')
    for paths in (folders, folders[::-1]):
        found = read_rollouts(paths, lenient=True)
        assert len(found.packed) == 2
        assert sorted(found.videos.values()) == [folders[0] / "0.mp4", folders[0] / "2.mp4"]


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"revision": "cd" * 32}, "rows of different splits do not mix"),
        ({"protocol_version": 2}, "protocol version '2'; expected 1"),
        ({"seed": 5}, "seed '5' differs from that of other rows of the same episode"),
    ],
)
def test_rows_of_different_data_do_not_mix(
    tmp_path: Path, change: dict[str, object], reason: str
) -> None:
    rows = made.rows()
    rows[20] = replace(rows[20], **change)  # type: ignore[arg-type]
    with pytest.raises(BadRowsError) as raised:
        read_rollouts([made.write_csv(tmp_path / "a.csv", rows)])
    first = raised.value.message.splitlines()[1]
    assert first.startswith(f"{tmp_path / 'a.csv'}, line 22: ") and reason in first


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("../escaped", "'../escaped' is not the name of a simulator; expected up to 128 letters"),
        ("a/b", "'a/b' is not the name"),
        (".hidden", "'.hidden' is not the name"),
        ("", "'' is not the name"),
        ("x" * 129, "is not the name"),
        ("RoboMME", "there is no simulator 'RoboMME'. Did you mean 'robomme'?"),
        ("Tabletop", "Did you mean 'tabletop'?"),
    ],
)
def test_a_simulator_has_a_name_that_a_file_can_have(
    tmp_path: Path, name: str, reason: str
) -> None:
    rows = made.rows()
    rows[3] = replace(rows[3], simulator=name)
    with pytest.raises(BadRowsError) as raised:
        read_rollouts([made.write_csv(tmp_path / "a.csv", rows)])
    first = raised.value.message.splitlines()[1]
    assert first.startswith(f"{tmp_path / 'a.csv'}, line 5: ") and reason in first


def test_a_row_without_a_revision_is_bad_where_others_name_one(tmp_path: Path) -> None:
    rows = made.rows()
    rows[1] = replace(rows[1], revision="")
    path = made.write_csv(tmp_path / "a.csv", rows)
    with pytest.raises(BadRowsError, match="line 3: revision is empty"):
        read_rollouts([path])
    found = read_rollouts([path], lenient=True)
    assert (found.refused, len(found.packed)) == (1, len(rows) - 1)
    assert list(found.revisions.values()) == [made.REVISION]


def test_nothing_but_bad_rows_says_how_many(tmp_path: Path) -> None:
    path = made.write_csv(tmp_path / "a.csv", [replace(r, family="X") for r in made.rows()[:3]])
    with pytest.raises(BadRowsError, match=r"all 3 rows are bad; the first is .*line 2: unknown"):
        score([path], lenient=True)
