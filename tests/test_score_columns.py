"""Columns as programs save them: numbers as floats or text, with gaps, of types that do not fit."""

import os
import subprocess
import sys
from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import score_rows as made

from robomme_interference_data.errors import BadRowsError, FormatError
from robomme_interference_data.evaluate.score.columns import whole_number
from robomme_interference_data.evaluate.score.rollouts import read_rollouts


def write(path: Path, **columns: Any) -> Path:
    """Write the rows of `score_rows` with some columns replaced."""
    table = pa.Table.from_pylist([row.as_dict() for row in made.rows()], made.ROLLOUT_SCHEMA)
    for name, values in columns.items():
        table = table.set_column(table.schema.get_field_index(name), name, values)
    pq.write_table(table, path)
    return path


@pytest.mark.parametrize(
    ("value", "number"),
    [
        *((0, 0), (7, 7), ("7", 7), ("007", 7), ("630000.0", 630000), ("5.000", 5), (1.0, 1)),
        *((Decimal("3.0"), 3), ("18446744073709551616", 2**64), ("9" * 21, None)),
        *((-1, None), ("-1", None), (0.5, None), ("0.5", None), ("5.", None), (".0", None)),
        *(("", None), (" 3", None), ("1_0", None), ("٣", None), ("0x1", None), ("1e3", None)),
        *((None, None), (True, None), (float("nan"), None), (float("inf"), None)),
    ],
)
def test_what_is_a_whole_number(value: Any, number: int | None) -> None:
    assert whole_number(value) == number


@pytest.mark.parametrize("kind", [pa.float32(), pa.float64(), pa.uint8(), pa.string()])
def test_whole_numbers_of_any_type_are_read_alike(tmp_path: Path, kind: Any) -> None:
    episodes = pa.array([row.episode for row in made.rows()]).cast(kind)
    success = pa.array([row.success for row in made.rows()]).cast(pa.int8()).cast(pa.float64())
    found = read_rollouts([write(tmp_path / "a.parquet", episode=episodes, success=success)])
    expected = read_rollouts([made.write_parquet(tmp_path / "b.parquet", made.rows())])
    assert np.array_equal(found.packed, expected.packed)


def test_one_odd_number_refuses_its_own_row_only(tmp_path: Path) -> None:
    episodes = [float(row.episode) for row in made.rows()]
    episodes[40] = 0.5
    path = write(tmp_path / "a.parquet", episode=pa.array(episodes))
    with pytest.raises(BadRowsError) as raised:
        read_rollouts([path])
    assert raised.value.message.splitlines() == [
        "1 bad row:",
        f"{path}, row 41: episode 0.5; expected a whole number from 0 to 131071",
    ]
    found = read_rollouts([path], lenient=True)
    assert (len(found.packed), found.refused) == (106, 1)


@pytest.mark.parametrize("gap", [None, float("nan")])
def test_a_scene_may_lack_its_seed_but_no_rollout_the_models(tmp_path: Path, gap: Any) -> None:
    seeds = [float(row.seed or 0) for row in made.rows()]
    path = write(tmp_path / "a.parquet", seed=pa.array([gap, *seeds[1:]], from_pandas=False))
    found = read_rollouts([path])
    whole = read_rollouts([made.write_parquet(tmp_path / "b.parquet", made.rows())])
    assert np.array_equal(found.packed, whole.packed)
    # Other rows of that episode tell its seed.
    assert np.array_equal(found.seeds, whole.seeds)

    models = pa.array([0.0, gap, *([5.0] * 105)], from_pandas=False)
    path = write(tmp_path / "c.parquet", model_seed=models)
    with pytest.raises(BadRowsError, match=r"1 bad row:\n.*row 2: model_seed .*; expected"):
        read_rollouts([path])
    found = read_rollouts([path], lenient=True)
    assert (len(found.packed), found.refused, found.model_seeds) == (106, 1, (0, 5))


def test_a_csv_in_which_a_gap_made_all_seeds_floats(tmp_path: Path) -> None:
    rows = made.rows()
    path = made.write_csv(tmp_path / "a.csv", rows)
    expected = read_rollouts([path])
    floats: list[Any] = [replace(row, seed=float(row.seed or 0)) for row in rows]  # type: ignore[arg-type]
    path = made.write_csv(tmp_path / "b.csv", [replace(floats[0], seed=None), *floats[1:]])
    assert ",1005.0," in path.read_text(encoding="utf-8")
    found = read_rollouts([path])
    assert np.array_equal(found.packed, expected.packed)
    assert np.array_equal(found.seeds, expected.seeds)


@pytest.mark.parametrize(
    ("name", "kind", "expected"),
    [
        ("family", pa.list_(pa.string()), "text"),
        ("system", pa.binary(), "text"),
        ("status", pa.int64(), "text"),
        ("video", pa.struct([("path", pa.string())]), "text"),
        ("episode", pa.list_(pa.int64()), "numbers"),
        ("seed", pa.bool_(), "numbers"),
        ("success", pa.date32(), "true and false"),
    ],
)
def test_a_column_of_a_type_that_does_not_fit_is_named(
    tmp_path: Path, name: str, kind: Any, expected: str
) -> None:
    path = write(tmp_path / "a.parquet", **{name: pa.nulls(107, kind)})
    with pytest.raises(FormatError) as raised:
        read_rollouts([path], lenient=True)
    assert raised.value.message.startswith(f"{path}: the column '{name}' holds ")
    assert raised.value.message.endswith(f"; expected {expected}")
    assert raised.value.hint


def test_scoring_never_imports_pandas(tmp_path: Path) -> None:
    """It would take seconds, and a Ctrl-C meanwhile would be lost."""
    (tmp_path / "pandas").mkdir()
    mark = tmp_path / "imported"
    (tmp_path / "pandas" / "__init__.py").write_text(f"open({str(mark)!r}, 'w').close()")
    rows = made.rows()
    rows[0] = replace(rows[0], seed=None, video="videos/0.mp4")
    paths = [
        made.write_parquet(tmp_path / "a.parquet", rows),
        made.write_csv(tmp_path / "b.csv", made.repeat(rows, 1)),
        write(tmp_path / "c.parquet", model_seed=pa.array([2.0] * 107), seed=pa.nulls(107)),
    ]
    code = "from robomme_interference_data.cli import app; app()"
    given = ["score", *map(str, paths), "--grid", "given", "--out", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-c", code, *given],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "report.html").exists()
    assert not mark.exists()
