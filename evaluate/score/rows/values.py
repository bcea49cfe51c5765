"""What each column of a row of a rollout may hold."""

import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

from robomme_interference_data.constants import (
    DIFFICULTIES,
    FAMILIES,
    MAX_STEPS,
    PROTOCOL_VERSION,
    SPLITS,
)
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.evaluate.systems import name_system
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.rollouts import FINAL, Status
from robomme_interference_data.schema.shifts import NO_SHIFT, parse_shift
from robomme_interference_data.simulators.registry import OFFICIAL, SIMULATORS

RELEASED_SIMULATOR = OFFICIAL
"""The simulator of rows that name none."""


class Row(NamedTuple):
    """What scoring reads of a rollout: columns of `Rollout`; None is unknown.

    The simulator of rows under a shift has its name in it, such as `tabletop+light:2`, so that
    rows under two shifts never mix. A video is a path, as the report finds it.
    """

    system: str
    simulator: str
    revision: str | None
    family: str
    condition: str
    split: str
    episode: int
    shift: str
    model_seed: int
    protocol_version: int
    seed: int | None
    difficulty: str | None
    status: str
    success: bool | None
    steps: int | None
    evidence_kept: float | None
    retrieval_model: str | None
    retrieval_selected_lesson_fraction: float | None
    retrieval_selected_filler_fraction: float | None
    retrieval_selected_query_fraction: float | None
    chance: float | None
    video: Any


DEFAULTS = {
    **{"simulator": RELEASED_SIMULATOR, "split": "test"},
    **{"shift": NO_SHIFT, "model_seed": 0, "protocol_version": PROTOCOL_VERSION},
}
"""Values of columns that the released layout lacks; any other is None."""

_SEPARATOR = "+"  # no name of a simulator has it
# File names contain it, so no `/`. A simulator of one's own is `module:function` in rows.
_SIMULATOR = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._:-]{0,127}")
_WHOLE = re.compile(r"([0-9]{1,18})(?:\.0+)?")  # programs save some whole numbers as floats
_TRUTH = dict.fromkeys(("1", "true", "1.0"), True) | dict.fromkeys(("0", "false", "0.0"), False)


def parse(name: str, value: Any) -> Any:
    """Return a value of a column as rows have it."""
    text = "" if value is None or value != value else str(value)  # noqa: PLR0124 - NaN
    if name in _OPTIONAL and text.lower() in ("", "nan", "none"):
        return None
    return _PARSERS[name](text)


def _whole(low: int, high: int) -> Callable[[str], int]:
    def parsed(text: str) -> int:
        match = _WHOLE.fullmatch(text)
        if not match or not low <= int(match[1]) <= high:
            raise ValueError(f"a whole number from {low} to {high}")
        return int(match[1])

    return parsed


def _one_of(name: str, known: tuple[str, ...]) -> Callable[[str], str]:
    def parsed(text: str) -> str:
        if text not in known:
            raise InvalidOptionError.one_of(name, text, known)
        return text

    return parsed


def _checked(check: Callable[[str], object]) -> Callable[[str], str]:
    def parsed(text: str) -> str:
        check(text)
        return text

    return parsed


def _status(text: str) -> str:
    # Released rows call a timeout what it is before the last step.
    return _final(str(Status.TIMEOUT) if text == Status.ONGOING else text)


def _success(text: str) -> bool:
    if text.lower() not in _TRUTH:
        raise ValueError("1, 0, true, false or nothing")
    return _TRUTH[text.lower()]


def _fraction(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 1:
        raise ValueError("a fraction from 0 to 1")
    return value


def _revision(text: str) -> str:
    if not text:
        raise ValueError("the revision of a buffer set")
    return text


def _check_simulator(text: str) -> None:
    name, separator, shift = text.partition(_SEPARATOR)
    if separator:
        parse_shift(shift)
    if name not in SIMULATORS and name.lower() in SIMULATORS:
        raise UnknownNameError.none("simulator", name, SIMULATORS)
    if not _SIMULATOR.fullmatch(name):
        raise ValueError("up to 128 letters, digits, '.', '_', '-' and ':'")


_final = _one_of("status", tuple(map(str, FINAL)))
_number = _whole(0, 10**18 - 1)  # as in episode ids
_FRACTIONS = (
    *("evidence_kept", "chance"),
    *(name for name in Row._fields if name.endswith("_fraction")),
)
_OPTIONAL = {"seed", "difficulty", "steps", "success", "video", "retrieval_model", *_FRACTIONS}
_PARSERS: dict[str, Callable[[str], Any]] = {
    "system": _checked(name_system),
    "simulator": _checked(_check_simulator),
    "revision": _revision,
    "family": _one_of("family", FAMILIES),
    "condition": _checked(parse_condition),
    "split": _one_of("split", SPLITS),
    "shift": _checked(parse_shift),
    "protocol_version": _whole(PROTOCOL_VERSION, PROTOCOL_VERSION),
    "difficulty": _one_of("difficulty", DIFFICULTIES),
    "status": _status,
    "success": _success,
    "steps": _whole(0, MAX_STEPS),
    **dict.fromkeys(("episode", "model_seed", "seed"), _number),
    **dict.fromkeys(("video", "retrieval_model"), str),
    **dict.fromkeys(_FRACTIONS, _fraction),
}


def shifted(simulator: str, shift: str) -> str:
    """Return the name of a simulator under a shift."""
    return f"{simulator}{_SEPARATOR}{shift}"


def unshifted(simulator: str) -> str:
    """Return the name of a simulator without a shift."""
    return simulator.partition(_SEPARATOR)[0]
