"""The table of systems, their conditions, and valid names."""

import pytest

from robomme_interference_data.errors import InvalidIdError, InvalidOptionError
from robomme_interference_data.evaluate.systems import (
    SYSTEMS,
    base_of,
    check_history,
    display_name,
    is_reference,
    known_system,
    name_system,
)

CONDITIONS = ("no-history", "k0", "k1", "k3", "k7")


@pytest.mark.parametrize("name", [*SYSTEMS, "my-memory"])
def test_conditions_of_a_system(name: str) -> None:
    without_memory = ("pi05_baseline", "hold", "mean")
    expected = ["no-history"] if name in without_memory else list(CONDITIONS)
    if name.startswith("retrieval-"):
        expected = ["k0", "k1", "k3", "k7"]
    assert [one for one in CONDITIONS if name_system(name).applies(one)] == expected


def test_the_base_of_a_retrieval_system() -> None:
    assert base_of("retrieval-framesamp-modul") == "perceptual-framesamp-modul"
    assert base_of("retrieval-replay-window") == "replay-window"
    assert base_of("retrieval-replay-window8-extrapolate") == "replay-window8-extrapolate"
    for step in ("", "-joined"):
        assert base_of(f"retrieval-replay-full-extrapolate{step}") == "replay-full-extrapolate"
    assert base_of("replay-window") is base_of("my-memory") is None
    assert all((base_of(name) in SYSTEMS) == one.retrieval for name, one in SYSTEMS.items())


@pytest.mark.parametrize("step", ["mean", "joined", "last", "top32", "max-0.9-wrist", "oracle"])
def test_a_control_behind_another_retrieval_step(step: str) -> None:
    system = name_system(f"retrieval-recall-framesamp-{step}")
    assert system.display == f"Retrieval-Recall-FrameSamp ({step})"
    assert system.sampling == "framesamp"
    assert not system.applies("no-history") and system.applies("k0")
    assert is_reference(system.name) and not is_reference(f"retrieval-replay-window-{step}")
    assert base_of(system.name) == "recall-framesamp"
    assert display_name(system.name) == system.display


def test_a_control_with_a_memory_of_another_size() -> None:
    system = name_system("retrieval-recall-framesamp8-joined")
    assert (system.sampling, system.step, system.reference) == ("framesamp:8", "joined", True)
    assert known_system("perceptual-framesamp8-modul") is known_system("framesamp8") is None


def test_position_limits_name_the_conditions() -> None:
    limited = {name for name, system in SYSTEMS.items() if system.position_limit is not None}
    assert limited == {
        name for name in SYSTEMS if name.startswith(("perceptual-", "recurrent-"))
    } | {"retrieval-framesamp-modul"}
    for name, system in SYSTEMS.items():
        check_history(system, {"k7": 2796})  # 2796 + 1300 = 4096
        longest = {"k7": 2796, "k31": 2797, "k63": 100_000}
        if name in limited:
            with pytest.raises(InvalidOptionError, match="under k31, 100000 frames under k63"):
                check_history(system, longest)
        else:
            check_history(system, longest)


def test_names_outside_the_table() -> None:
    own = name_system("my-memory.v2")
    assert (own.name, own.display, own.paper) == ("my-memory.v2", "my-memory.v2", False)
    assert name_system("memer") is SYSTEMS["memer"]
    assert name_system("holdout").display == "holdout"


@pytest.mark.parametrize("sampling", ["full", "framesamp", "window"])
def test_recall_and_guess_of_questions_are_bounds(sampling: str) -> None:
    for name in ("questions-guess", f"questions-recall-{sampling}"):
        for known in (name, f"retrieval-{name}", f"retrieval-{name}-joined"):
            assert name_system(known).name == known and is_reference(known)
        assert base_of(f"retrieval-{name}") == base_of(f"retrieval-{name}-joined") == name


@pytest.mark.parametrize("name", ["", " ", "-x", "a b", "a/b", "x" * 65, "π"])
def test_invalid_names_are_errors(name: str) -> None:
    with pytest.raises(InvalidIdError, match="is not the name of a system"):
        name_system(name)
