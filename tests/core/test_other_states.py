"""Units of another robot, whose states have another number of values than the query's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buffer_sets import violations
from support.messages import raises
from support.two_robots import CONDITIONS, build_two_robots

from robomme_interference_data import BufferSet, load_buffer_set
from robomme_interference_data.build_dataset.alike import differences, in_buffers
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.other_states import (
    OTHER_STATES,
    OtherStates,
    check_rule,
    check_sizes,
    fit_states,
)

NAME = "Lift/test/0"


def test_states_by_hand() -> None:
    states = np.array([[1, 2], [3, 4]], np.float32)
    assert fit_states(states, 3, "pad").tolist() == [[1, 2, 0], [3, 4, 0]]
    assert fit_states(states, 3, "omit").tolist() == [[0, 0, 0], [0, 0, 0]]
    assert fit_states(states, 1, "omit").tolist() == [[0], [0]]
    for rule in OTHER_STATES:
        assert fit_states(states, 2, rule) is states


@given(st.integers(1, 20), st.integers(1, 20), st.sampled_from(OTHER_STATES))
def test_no_value_is_ever_cut_off(size: int, other: int, rule: OtherStates) -> None:
    """A rule either keeps all values, or none of them, or is an error."""
    fits = size == other or rule == "omit" or (rule == "pad" and other < size)
    if not fits:
        with pytest.raises(InvalidOptionError) as caught:
            check_sizes("a buffer", size, {"a session": other}, rule)
        assert caught.value.option == "other_states"
        return
    check_sizes("a buffer", size, {"a session": other}, rule)
    states = np.arange(1, 2 * other + 1, dtype=np.float32).reshape(2, other)
    fitted = fit_states(states, size, rule)
    assert fitted.shape == (2, size) and fitted.dtype == np.float32
    if rule == "omit" and size != other:
        assert not fitted.any()
    else:
        assert fitted[:, :other].tolist() == states.tolist() and not fitted[:, other:].any()


def test_unknown_rule() -> None:
    with raises(InvalidOptionError):
        check_rule("cut")


def test_units_alone_may_be_of_another_robot() -> None:
    features = {"observation.state": (8,), "action": (8,), "observation.images.front": (4, 6, 3)}
    other = features | {"observation.state": (14,), "action": (2,)}
    for kind, alike in (
        ("distractors", True),
        ("distractors-raw", True),
        ("contradictions", False),
    ):
        looks = [("one", in_buffers(kind, features, 10)), ("two", in_buffers(kind, other, 10))]
        assert (not differences(*looks)) is alike
        # A frame rate is that of all sessions.
        assert differences(looks[0], ("two", in_buffers(kind, features, 15)))


@pytest.fixture(scope="module")
def narrower(tmp_path_factory: pytest.TempPathFactory) -> BufferSet:
    """Units with states of 3 values."""
    return load_buffer_set(build_two_robots(tmp_path_factory.mktemp("narrower"), 3))


@pytest.fixture(scope="module")
def wider(tmp_path_factory: pytest.TempPathFactory) -> BufferSet:
    """Units with states of 14 values."""
    return load_buffer_set(build_two_robots(tmp_path_factory.mktemp("wider"), 14))


LESSON = [[float(n)] * 8 for n in range(5)]


def test_states_of_a_buffer(narrower: BufferSet) -> None:
    buffer = narrower.load(NAME, "k1")
    unit = [float(n) for n in (0, 2, 4, 6)]
    assert buffer.states_by("pad").tolist() == LESSON + [[n] * 3 + [0.0] * 5 for n in unit]
    assert buffer.states_by("omit").tolist() == LESSON + [[0.0] * 8] * 4
    assert buffer.session_states(0).tolist() == LESSON
    assert buffer.session_states(1).tolist() == [[n] * 3 for n in unit]
    assert buffer.frames().shape == (9, 16, 24, 3)
    with raises(InvalidOptionError) as caught:
        _ = buffer.states
    assert caught.value.option == "other_states"
    hint = str(caught.value.hint)
    assert 'states_by("pad")' in hint and 'states_by("omit")' in hint
    chunks = [*buffer.stream(4, other_states="pad")]
    joined = np.concatenate([chunk.states for chunk in chunks])
    np.testing.assert_array_equal(joined, buffer.states_by("pad"))
    with raises(InvalidOptionError):
        next(buffer.stream(4))
    with raises(InvalidOptionError):
        next(buffer.stream(4, other_states="cut"))  # type: ignore[arg-type]
    for condition in ("no-history", "k0"):
        alike = narrower.load(NAME, condition)
        assert alike.states.tolist() == (LESSON if condition == "k0" else [])


def test_more_values_are_never_cut_off(wider: BufferSet) -> None:
    buffer = wider.load(NAME, "raw-k1")
    for rule in ("refuse", "pad"):
        with raises(InvalidOptionError) as caught:
            buffer.states_by(rule)  # type: ignore[arg-type]
        assert "pad (" not in str(caught.value.hint) and "omit" in str(caught.value.hint)
    assert buffer.states_by("omit").tolist() == LESSON + [[0.0] * 8] * 8
    assert buffer.session_states(1).shape == (8, 14)


@pytest.mark.parametrize("name", ["narrower", "wider"])
def test_such_sets_are_verified_like_others(name: str, request: Any) -> None:
    opened: BufferSet = request.getfixturevalue(name)
    assert violations(Path(opened.location)) == []
    for condition in CONDITIONS:
        opened.load(NAME, condition, verify=True)
