"""States of units whose robot has another number of values than the query's. Pure rules.

A buffer set stores the states of each dataset as they were recorded. One array of the states of a
buffer exists only by a rule:

- `refuse`: such a buffer is an error;
- `pad`: zeros follow fewer values; more values are an error, because none is ever cut off;
- `omit`: zeros take the place of all values of that session.
"""

from collections.abc import Callable, Mapping
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError, named

OtherStates = Literal["refuse", "pad", "omit"]

OTHER_STATES: tuple[OtherStates, ...] = get_args(OtherStates)
"""The rules."""


def check_rule(rule: str) -> OtherStates:
    """Return a rule.

    Raises:
        InvalidOptionError: There is no such rule.
    """
    for known in OTHER_STATES:
        if rule == known:
            return known
    raise InvalidOptionError.one_of("other_states", rule, OTHER_STATES)


def _as_setting(rule: OtherStates) -> str:
    return named("other_states", rule)


def check_sizes(
    what: str,
    size: int,
    others: Mapping[str, int],
    rule: OtherStates,
    written: Callable[[OtherStates], str] = _as_setting,
) -> None:
    """Check that a rule gives one array of states.

    Args:
        what: What needs the array, such as a buffer, for the error.
        size: Number of values of the query's states.
        others: Numbers of values of other sessions or datasets, by what they are called.
        rule: The rule.
        written: Returns how another rule is chosen, for the error.

    Raises:
        InvalidOptionError: It does not.
    """
    for name, other in others.items():
        if other == size or rule == "omit" or (rule == "pad" and other < size):
            continue
        ways = [f"{written('omit')} (zeros in their place)"]
        if other < size:
            ways.insert(0, f"{written('pad')} (zeros after them)")
        cut = f"; {rule} cuts off no values" if rule == "pad" else ""
        raise InvalidOptionError(
            f"{what}: {name} has states of {other} values, the query of {size}{cut}",
            f"Choose {' or '.join(ways)}.",
            option="other_states",
        )


def fit_states(states: NDArray[np.float32], size: int, rule: OtherStates) -> NDArray[np.float32]:
    """Return states, `(n, D)`, with the query's number of values, `(n, size) float32`.

    `check_sizes` has checked that the rule allows it.
    """
    if states.shape[1] == size:
        return states
    fitted = np.zeros((len(states), size), np.float32)
    if rule == "pad":
        fitted[:, : states.shape[1]] = states
    return fitted
