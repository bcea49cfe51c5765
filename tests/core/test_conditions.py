"""Conditions are values: names, order, and the sessions that their rules give."""

import pickle
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data import EpisodeId
from robomme_interference_data.conditions import (
    DEFAULT_CONDITIONS,
    KINDS,
    in_order,
    parse_condition,
)
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError
from robomme_interference_data.records import SessionEntry


def entry(role: str, number: int) -> SessionEntry:
    name = EpisodeId("MoveCube", "train", number)
    return SessionEntry(role, "MoveCube", name, "distractors", "r", number, 0, 32, 1, "s")


class Material:
    def lesson(self) -> SessionEntry:
        return entry("lesson", 99)

    def units(self, k: int) -> Sequence[SessionEntry]:
        return [entry("distractor", number) for number in range(k)]


def test_the_papers_conditions() -> None:
    assert DEFAULT_CONDITIONS == ("no-history", "k0", "k1", "k3", "k7")
    found = {
        name: [one.source.index for one in parse_condition(name).sessions(Material())]
        for name in DEFAULT_CONDITIONS
    }
    assert found == {
        "no-history": [],
        "k0": [99],
        "k1": [99, 0],
        "k3": [99, 0, 1, 2],
        "k7": [99, 0, 1, 2, 3, 4, 5, 6],
    }


@given(st.integers(0, 63))
def test_names(k: int) -> None:
    condition = parse_condition(f"k{k}")
    assert (condition.name, condition.k, str(condition)) == (f"k{k}", k, f"k{k}")
    assert parse_condition(condition) is condition
    assert pickle.loads(pickle.dumps(condition)) == condition


@pytest.mark.parametrize(
    "given",
    [
        *("", "k", "k64", "k-1", "k03", "K3", "3", "nohistory", "no-history-k0", "x-k3", " k3"),
        *(3, None, b"k3"),
    ],
)
def test_what_is_no_condition(given: Any) -> None:
    with pytest.raises(InvalidIdError, match="is not a condition"):
        parse_condition(given)


def test_order() -> None:
    names = [one.name for one in in_order(["k7", "k10", "no-history", "k0"])]
    assert names == ["no-history", "k0", "k7", "k10"]
    for names in ([], ["k1", "k1"]):
        with pytest.raises(InvalidOptionError, match="expected some, each once"):
            in_order(names)


def test_the_registry() -> None:
    assert list(KINDS) == ["no-history", "k"]
    assert all(kind.name == name for name, kind in KINDS.items())
