"""Records to Arrow and JSON and back: from one declaration, checked when read."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data import EpisodeId
from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.codec import (
    arrow_schema,
    from_dict,
    from_table,
    to_dict,
    to_table,
)
from robomme_interference_data.storage.text import read_header


@dataclass(frozen=True)
class Part:
    name: str
    source: EpisodeId
    size: int


@dataclass(frozen=True)
class Row:
    episode_id: EpisodeId
    count: int
    share: float
    fine: bool
    note: str | None
    digests: dict[str, str]
    goals: tuple[str, ...]
    parts: tuple[Part, ...]
    best: Part | None


PART = Part("a", EpisodeId("MoveCube", "train", 1), 3)
QUERY = EpisodeId("InsertPeg", "test", 4)
ROW = Row(QUERY, 7, 0.5, True, None, {"x": "1", "y": "2"}, ("g",), (PART,), PART)
PLAIN = {
    "episode_id": "InsertPeg/test/4",
    "family": "InsertPeg",
    "split": "test",
    "index": 4,
    "count": 7,
    "share": 0.5,
    "fine": True,
    "note": None,
    "digests": {"x": "1", "y": "2"},
    "goals": ["g"],
    "parts": [{"name": "a", "source": "MoveCube/train/1", "size": 3}],
    "best": {"name": "a", "source": "MoveCube/train/1", "size": 3},
}

ids = st.builds(EpisodeId, st.sampled_from(["MoveCube", "X"]), st.just("test"), st.integers(0, 99))
parts = st.builds(Part, st.text(max_size=5), ids, st.integers(-(2**63), 2**63 - 1))
rows = st.builds(
    Row,
    ids,
    st.integers(-9, 9),
    st.floats(allow_nan=False),
    st.booleans(),
    st.none() | st.text(max_size=5),
    st.fixed_dictionaries({"x": st.text(max_size=3), "y": st.text(max_size=3)}),
    st.lists(st.text(max_size=5), max_size=3).map(tuple),
    st.lists(parts, max_size=3).map(tuple),
    st.none() | parts,
)


def test_plain_values() -> None:
    assert to_dict(ROW) == PLAIN
    assert from_dict(Row, PLAIN, "here") == ROW


@given(st.lists(rows, max_size=4))
def test_round_trips(found: list[Row]) -> None:
    table = to_table(found, arrow_schema(Row, ["x", "y"]))
    assert table.to_pylist() == [to_dict(row) for row in found]
    assert list(from_table(Row, table, "here")) == found
    assert [from_dict(Row, to_dict(row), "here", strict=True) for row in found] == found


@pytest.mark.parametrize(
    "change",
    [
        {"count": True},
        {"count": 2**63},
        {"share": "0.5"},
        {"share": 10**400},
        {"fine": 1},
        {"note": 3},
        {"episode_id": "MoveCube"},
        {"goals": "g"},
        {"goals": [None]},
        {"digests": []},
        {"parts": [{"name": "a", "size": 3}]},
    ],
)
def test_wrong_values_raise_one_error(change: dict[str, Any]) -> None:
    with raises(FormatError):
        from_dict(Row, {**PLAIN, **change}, "here")


def test_missing_and_unknown_names() -> None:
    short = {name: value for name, value in PLAIN.items() if name not in ("note", "goals")}
    with raises(FormatError):
        from_dict(Row, short, "here")
    assert from_dict(Row, {**short, "goals": ["g"]}, "here") == ROW  # None may be left out
    assert from_dict(Row, {**PLAIN, "more": 1}, "here") == ROW
    with raises(FormatError):
        from_dict(Row, {**PLAIN, "more": 1}, "here", strict=True)
    table = to_table([ROW], arrow_schema(Row, ["x", "y"])).drop_columns(["share"])
    with raises(FormatError):
        list(from_table(Row, table, "here"))


@dataclass(frozen=True)
class Header:
    format_version: int
    name: str


@pytest.mark.parametrize(
    "text",
    [
        '{"format_version": 2, "name": "a"}',
        '{"name": "a"}',
        '{"format_version": 1}',
        '{"format_version": 1, "name": "a", "nmae": 1}',
        "[]",
    ],
)
def test_headers(tmp_path: Path, text: str) -> None:
    path = tmp_path / "header.json"
    path.write_text(text)
    with raises(FormatError):
        read_header(path, Header)
