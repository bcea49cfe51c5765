"""The table of systems, their conditions, and valid names."""

import pytest
from support.messages import raises

from robomme_interference_data.errors import InvalidIdError, InvalidOptionError
from robomme_interference_data.evaluate.systems import SYSTEMS, check_history, name_system

CONDITIONS = ("no-history", "k0", "k1", "k3", "k7")


@pytest.mark.parametrize("name", [*SYSTEMS, "my-memory"])
def test_conditions_of_a_system(name: str) -> None:
    without_memory = ("pi05_baseline", "hold", "mean")
    expected = ["no-history"] if name in without_memory else list(CONDITIONS)
    if name.startswith("retrieval-"):
        expected = ["k0", "k1", "k3", "k7"]
    assert [one for one in CONDITIONS if name_system(name).facts.applies(one)] == expected


def test_position_limits_name_the_conditions() -> None:
    limited = {name for name, system in SYSTEMS.items() if system.position_limit is not None}
    assert limited == {
        name for name in SYSTEMS if name.startswith(("perceptual-", "recurrent-"))
    } | {"retrieval-framesamp-modul"}
    for name, system in SYSTEMS.items():
        check_history(system, {"k7": 2796})  # 2796 + 1300 = 4096
        longest = {"k7": 2796, "k31": 2797, "k63": 100_000}
        if name in limited:
            with raises(InvalidOptionError):
                check_history(system, longest)
        else:
            check_history(system, longest)


def test_names_outside_the_table() -> None:
    own = name_system("my-memory.v2")
    assert (own.name, own.display, own.paper) == ("my-memory.v2", "my-memory.v2", False)
    assert name_system("memer") is SYSTEMS["memer"]
    assert name_system("holdout").display == "holdout"


@pytest.mark.parametrize("name", ["", " ", "-x", "a b", "a/b", "x" * 65, "π"])
def test_invalid_names_are_errors(name: str) -> None:
    with raises(InvalidIdError):
        name_system(name)
