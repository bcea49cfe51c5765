"""Rows are read from CSV, parquet and folders alike, and packed; files that cannot be read."""

import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import score_rows as made
from hypothesis import given, settings
from hypothesis import strategies as st
from score_rows import GOOD

from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.evaluate.score import rollouts
from robomme_interference_data.evaluate.score.check import BITS, REFUSED, field, pack
from robomme_interference_data.evaluate.score.columns import distinct
from robomme_interference_data.evaluate.score.rollouts import Rollouts, read_rollouts


def codes(found: Rollouts) -> set[tuple[str, ...]]:
    names = ("system", "condition", "family", "episode", "model_seed", "status")
    columns = [field(found.packed, name).tolist() for name in names]
    return {(found.systems[one[0]], *one[1:]) for one in zip(*columns, strict=True)}


def test_csv_parquet_and_folders_are_read_alike(tmp_path: Path) -> None:
    rows = made.rows()
    by_csv = read_rollouts([made.write_csv(tmp_path / "a.csv", rows)])
    by_parquet = read_rollouts([made.write_parquet(tmp_path / "a.parquet", rows)])
    (tmp_path / "run").mkdir()
    made.write_parquet(tmp_path / "run" / "rollouts.parquet", rows)
    (tmp_path / "run" / "run.json").write_text('{"format_version": 1, "status": "done"}')
    by_folder = read_rollouts([tmp_path / "run"])
    for other in (by_parquet, by_folder):
        assert np.array_equal(by_csv.packed, other.packed)
        assert by_csv.systems == other.systems == (made.BASE, made.RETRIEVAL, made.OWN)
        assert by_csv.revisions == other.revisions == {"tabletop": made.REVISION}
    assert len(by_csv.packed) == 107  # 9 cells of 12, one row missing
    assert by_folder.sources[0].record["status"] == "done"


@settings(max_examples=15)
@given(st.randoms(use_true_random=False), st.integers(1, 3))
def test_the_order_of_rows_and_files_makes_no_difference(
    tmp_path_factory: pytest.TempPathFactory, order: random.Random, files: int
) -> None:
    folder = tmp_path_factory.mktemp("shuffled")
    rows = [*made.rows(), *made.repeat(made.rows()[:20], 5), *made.repeat(made.rows()[:9], 3)]
    expected = read_rollouts([made.write_parquet(folder / "all.parquet", rows)])
    order.shuffle(rows)
    paths = [
        made.write_parquet(folder / f"{part}.parquet", rows[part::files]) for part in range(files)
    ]
    found = read_rollouts(paths)
    assert np.array_equal(found.packed, expected.packed)
    assert found.model_seeds == expected.model_seeds == (0, 3, 5)
    assert np.array_equal(found.difficulty, expected.difficulty)
    assert np.array_equal(found.seeds, expected.seeds)


def test_the_released_layout(tmp_path: Path) -> None:
    lines = [
        GOOD,
        "my-memory,MoveCube,k0,1,8,hard,ongoing,False,1300",
        "my-memory,MoveCube,no-history,1,8,hard,error,,0",
    ]
    found = read_rollouts([made.released(tmp_path / "a.csv", lines)])
    assert found.simulators == ("robomme",)
    family = 5  # MoveCube
    assert codes(found) == {
        ("my-memory", 1, family, 0, 0, 0),
        ("my-memory", 1, family, 1, 0, 2),
        ("my-memory", 0, family, 1, 0, 3),
    }
    # Its own tables call a system a variant.
    path = tmp_path / "a.csv"
    path.write_text(path.read_text().replace("system", "variant", 1))
    assert codes(read_rollouts([path])) == codes(found)


def test_simulators_have_revisions_and_scenes_of_their_own(tmp_path: Path) -> None:
    rows = made.rows()
    other = [
        replace(one, simulator="robomme", revision="cd" * 32, seed=9, difficulty="hard")
        for one in rows
    ]
    found = read_rollouts([made.write_parquet(tmp_path / "a.parquet", rows + other)])
    assert found.simulators == ("robomme", "tabletop")
    assert found.revisions == {"robomme": "cd" * 32, "tabletop": made.REVISION}
    cube = field(found.packed, "family") == 5
    episodes = np.unique((found.packed[cube] >> np.uint64(19)).astype(np.int64) & (2**23 - 1))
    assert found.difficulty_of(0, episodes).tolist() == [2] * 6
    assert found.difficulty_of(1, episodes).tolist() == [0, 0, 1, 1, 2, 2]


def test_simulators_of_ones_own_are_named_as_runs_name_them(tmp_path: Path) -> None:
    names = ("my_package.kitchen:make_simulator", "_doubles:make", "sim-2.1", "x" * 128)
    rows = [replace(r, simulator=name) for name in names for r in made.rows()[:2]]
    found = read_rollouts([made.write_csv(tmp_path / "a.csv", rows)])
    assert found.simulators == tuple(sorted(names))


@pytest.mark.parametrize(
    ("header", "message"),
    [
        ("family,condition,episode,status", "lacks the columns success"),
        ("family,condition,episode,status,success", "names no system"),
        ("system,simulatr,family,condition,episode,status,success", "has the column 'simulatr'"),
        ("system,family,family,condition,episode,status,success", "two columns of one name"),
        (
            "system,simulator,split,family,condition,episode,status,success",
            "lacks the columns revision, episode_split, model_seed, protocol_version;",
        ),
    ],
)
def test_files_without_what_is_needed_are_refused(
    tmp_path: Path, header: str, message: str
) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(header + "\n")
    with pytest.raises(FormatError) as raised:
        read_rollouts([path])
    assert message in raised.value.message and str(path) in raised.value.message
    assert raised.value.hint


def test_missing_and_damaged_files(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(MissingFileError, match="there is no file or folder"):
        read_rollouts([tmp_path / "nowhere"])
    with pytest.raises(
        MissingFileError, match=r"holds neither rollouts\.parquet nor rollouts\.csv"
    ):
        read_rollouts([tmp_path])
    (tmp_path / "rollouts.jsonl").touch()
    with pytest.raises(MissingFileError, match="go on with it"):
        read_rollouts([tmp_path])
    (tmp_path / "picture.csv").write_bytes(b"a,b\n1,\xff\n")
    with pytest.raises(FormatError, match=r"picture\.csv cannot be read: byte 6 is not UTF-8 text"):
        read_rollouts([tmp_path / "picture.csv"])
    # A byte that is no text in a line with too few fields, in a later block.
    whole = made.write_csv(tmp_path / "late.csv", made.rows()).read_bytes()
    (tmp_path / "late.csv").write_bytes(whole * 1200 + b"x" * 70_000 + b"\xe9,x\n" + whole)
    place = 1200 * len(whole) + 70_000
    with pytest.raises(FormatError, match=rf"late\.csv cannot be read: byte {place} is not UTF-8"):
        read_rollouts([tmp_path / "late.csv"], lenient=True)
    assert capfd.readouterr().err == ""
    (tmp_path / "cut.csv").write_bytes(b"a,b\n1,\xc3")
    with pytest.raises(FormatError, match=r"cut\.csv cannot be read: byte 6 is not UTF-8 text"):
        read_rollouts([tmp_path / "cut.csv"])
    (tmp_path / "rows.txt").touch()
    with pytest.raises(FormatError, match=r"neither \.csv nor \.parquet"):
        read_rollouts([tmp_path / "rows.txt"])
    for name in ("rows.csv", "rows.parquet"):
        (tmp_path / name).write_bytes(b"")
        with pytest.raises(FormatError, match="cannot be read"):
            read_rollouts([tmp_path / name])
    whole = made.write_parquet(tmp_path / "rows.parquet", made.rows()).read_bytes()
    (tmp_path / "rows.parquet").write_bytes(whole[:200] + bytes(100) + whole[300:])
    with pytest.raises(FormatError, match="cannot be read"):
        read_rollouts([tmp_path / "rows.parquet"])
    made.write_csv(tmp_path / "rollouts.csv", made.rows())
    (tmp_path / "run.json").write_text('{"format_version": 99}')
    with pytest.raises(FormatError, match="format version 99"):
        read_rollouts([tmp_path])


def test_a_file_that_is_given_twice_is_refused(tmp_path: Path) -> None:
    path = made.write_csv(tmp_path / "a.csv", made.rows())
    with pytest.raises(InvalidOptionError, match=r"a\.csv is given twice"):
        read_rollouts([path, tmp_path / "." / "a.csv"])


@given(st.lists(st.tuples(*(st.integers(0, 2**bits - 1) for bits in BITS.values())), max_size=20))
def test_packing_keeps_every_field_and_sorts_by_them(rows: list[tuple[int, ...]]) -> None:
    columns = [np.array([row[i] for row in rows], np.int64) for i in range(len(BITS))]
    packed = np.broadcast_to(pack(**dict(zip(BITS, columns, strict=True))), len(rows))
    assert all(field(packed, n).tolist() == c.tolist() for n, c in zip(BITS, columns, strict=True))
    assert sorted(rows) == [rows[i] for i in np.argsort(packed, kind="stable")]
    assert (packed < REFUSED).all()


def test_memory_is_eight_bytes_a_row(tmp_path: Path) -> None:
    found = read_rollouts([made.write_parquet(tmp_path / "a.parquet", made.rows())])
    assert found.packed.nbytes == 8 * 107


def test_recoding_in_steps_is_recoding_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = made.rows()[::-1]
    path = made.write_parquet(tmp_path / "a.parquet", rows)
    expected = read_rollouts([path])
    monkeypatch.setattr(rollouts, "_STEP", 7)
    assert np.array_equal(read_rollouts([path]).packed, expected.packed)


@given(st.lists(st.integers(-3, 3), max_size=30))
def test_distinct_values_are_those_of_numpy(values: list[int]) -> None:
    array = np.array(values, np.int64)
    found, place = distinct(array)
    expected, places = np.unique(array, return_inverse=True)
    assert found.tolist() == expected.tolist()
    assert place.tolist() == places.tolist()
