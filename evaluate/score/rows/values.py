"""What each column of a row of a rollout may hold."""

import math
import re
from typing import Any

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
from robomme_interference_data.simulators.registry import SIMULATORS

from .sources import COLUMNS

_NAMES = {"family": FAMILIES, "episode_split": SPLITS, "difficulty": DIFFICULTIES}
_NAMES |= {"status": tuple(map(str, FINAL))}
_NUMBERS = {
    **dict.fromkeys(("episode", "model_seed", "seed"), (0, 10**18 - 1)),  # as in episode ids
    "steps": (0, MAX_STEPS),
    "protocol_version": (PROTOCOL_VERSION, PROTOCOL_VERSION),
}
_WORDS = dict.fromkeys(("1", "true", "1.0"), True) | dict.fromkeys(("0", "false", "0.0"), False)
_FRACTIONS = {"evidence_kept", "chance", *(name for name in COLUMNS if name.endswith("_fraction"))}
_OPTIONAL = {"seed", "difficulty", "steps", "success", "video", "retrieval_model", *_FRACTIONS}

_WHOLE = re.compile(r"([0-9]{1,18})(?:\.0+)?")  # programs save some whole numbers as floats
# Names of files hold it, so no `/`. A simulator of one's own is `module:function` in rows.
_SIMULATOR = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._:-]{0,127}")
_UNDER = "+"  # no name of a simulator has it


def parsed(name: str, value: Any) -> Any:
    """Return a value of a column as rows have it.

    Raises:
        InterferenceError, ValueError: It is none; the latter says what was expected.
    """
    text = "" if value is None or value != value else str(value)  # noqa: PLR0124 - NaN
    if name in _OPTIONAL and text.lower() in ("", "nan", "none"):
        return None
    if name in _NUMBERS:
        match, (low, high) = _WHOLE.fullmatch(text), _NUMBERS[name]
        if not match or not low <= int(match[1]) <= high:
            raise ValueError(f"a whole number from {low} to {high}")
        return int(match[1])
    if name in _NAMES:
        # Released rows call a timeout what it is before the last step.
        text = str(Status.TIMEOUT) if text == Status.ONGOING else text
        if text not in _NAMES[name]:
            raise InvalidOptionError.one_of(name, text, _NAMES[name])
    elif name in _CHECKS:
        _CHECKS[name](text)
    elif name == "revision" and not text:
        raise ValueError("the revision of a split")
    elif name == "success":
        if text.lower() not in _WORDS:
            raise ValueError("1, 0, true, false or nothing")
        return _WORDS[text.lower()]
    return _fraction(text) if name in _FRACTIONS else text


def _fraction(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= 1:
        raise ValueError("a fraction from 0 to 1")
    return value


def shifted(simulator: str, shift: str) -> str:
    """Return what a simulator under a shift is called: rows under two shifts never mix."""
    return simulator if shift == NO_SHIFT else f"{simulator}{_UNDER}{shift}"


def unshifted(simulator: str) -> str:
    """Return what a simulator is called without a shift."""
    return simulator.partition(_UNDER)[0]


def _check_simulator(text: str) -> None:
    name, under, shift = text.partition(_UNDER)
    if under:
        parse_shift(shift)
    if name not in SIMULATORS and name.lower() in SIMULATORS:
        raise UnknownNameError.none("simulator", name, SIMULATORS)
    if not _SIMULATOR.fullmatch(name):
        raise ValueError("up to 128 letters, digits, '.', '_', '-' and ':'")


_CHECKS = {
    **{"system": name_system, "condition": parse_condition, "simulator": _check_simulator},
    "shift": parse_shift,
}


def shown(value: Any) -> str:
    """Return a value as messages name it."""
    return "(empty)" if value is None else repr(value)
