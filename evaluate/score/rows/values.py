"""The columns that scoring reads of a rollout, and how their values are read from text."""

import math
import re
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple, get_args, get_type_hints

import pyarrow as pa

from robomme_interference_data.constants import (
    ABILITIES,
    DIFFICULTIES,
    MAX_STEPS,
    OFFICIAL,
    PROTOCOL_VERSION,
    SPLITS,
)
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.systems import SystemFacts, name_system
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import arrow_schema
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.rollouts import FINAL, OutcomeColumns, RolloutKey, Status
from robomme_interference_data.schema.shifts import NO_SHIFT, parse_shift

RELEASED_SIMULATOR = OFFICIAL
"""The simulator of rows that name none."""


class Row(NamedTuple):
    """The columns of `Rollout` that scoring reads; None means unknown.

    The simulator of a row under a shift includes the shift, such as `tabletop+light:2`, so that
    rows under different shifts are never pooled. A video is a path that the report can open.
    """

    system: str
    simulator: str
    revision: str | None
    family: str
    condition: str
    split: str
    episode: int
    shift: str
    training_seed: int | None
    model_seed: int
    protocol_version: int
    seed: int | None
    difficulty: str | None
    ability: str | None
    status: str
    success: bool | None
    steps: int | None
    evidence_kept: float | None
    policy: str | None
    policy_id: str | None
    training_step: int | None
    memory: str | None
    retrieval: str | None
    subgoals: str | None
    reads_history: bool
    reference: bool
    retrieval_selected_lesson_fraction: float | None
    retrieval_selected_filler_fraction: float | None
    retrieval_selected_query_fraction: float | None
    chance: float | None
    action_l1: float | None
    action_l1_values: str | None
    video: Path | None
    history_s: float | None
    policy_s: float | None
    model_s: float | None
    model_tokens: int | None


DEFAULTS = {
    "simulator": RELEASED_SIMULATOR,
    "split": "test",
    "shift": NO_SHIFT,
    "model_seed": 0,
    "protocol_version": PROTOCOL_VERSION,
    "reads_history": True,
    "reference": False,
}
"""Values of columns that the released CSV lacks; any other is None."""

_ARROW_TYPES = {
    str: pa.string(),
    int: pa.int64(),
    float: pa.float64(),
    bool: pa.bool_(),
    Path: pa.string(),
}


def record_schema(names: Iterable[str]) -> pa.Schema:
    """Return the schema of some columns in the record of a run.

    Every record has key, outcome and facts. The other columns of `Row` belong to features, and
    their types follow from `Row`, so that scoring imports no feature to read its columns.
    """
    required = {
        field.name: field
        for group in (RolloutKey, OutcomeColumns, SystemFacts)
        for field in arrow_schema(group)
    }
    hints = get_type_hints(Row)
    return pa.schema(
        [
            required.get(name) or pa.field(name, _ARROW_TYPES[get_args(hints[name])[0]])
            for name in names
        ]
    )


_SEPARATOR = "+"  # between a simulator and its shift; no simulator's name contains it
# Used in file names, so no `/`. A user's simulator is named `module:function`.
_SIMULATOR = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._:-]{0,127}")
_WHOLE = re.compile(r"([0-9]{1,18})(?:\.0+)?")  # some programs save whole numbers as floats
TRUTH = dict.fromkeys(("1", "true", "1.0"), True) | dict.fromkeys(("0", "false", "0.0"), False)
_RANGES = {"steps": (0, MAX_STEPS), "protocol_version": (PROTOCOL_VERSION, PROTOCOL_VERSION)}
_NAMES = {"split": SPLITS, "difficulty": DIFFICULTIES, "ability": ABILITIES, "status": FINAL}
MAX_NUMBER = 10**18 - 1
"""The largest number of an episode or a seed, as in episode ids."""

_LARGEST = sys.float_info.max
_MOST = {name: 1.0 for name in ("evidence_kept", "chance")}
_MOST |= {name: 1.0 for name in Row._fields if name.endswith("_fraction")}
_MOST |= {name: _LARGEST for name in ("action_l1", "history_s", "policy_s", "model_s")}
_OPTIONAL = {name for name, hint in get_type_hints(Row).items() if isinstance(None, hint)}
_OPTIONAL -= {"revision"}  # a file that has the column states it in each row


def parse(name: str, value: Any) -> Any:
    """Return the value of a column from what a file holds: text, or a number of any type."""
    text = "" if value is None or value != value else str(value)  # noqa: PLR0124 - NaN
    if name in _OPTIONAL and text.lower() in ("", "nan", "none"):
        return None
    match name:
        case _ if name in _CHECKS:
            _CHECKS[name](text)
        case "revision" if not text:
            raise ValueError("the revision of a buffer set")
        case "status" if text == Status.ONGOING:
            return str(Status.TIMEOUT)  # the released rows record a timeout as ongoing
        case "split" | "difficulty" | "ability" | "status":
            if text not in _NAMES[name]:
                raise InvalidOptionError.one_of(name, text, _NAMES[name])
        case "success" | "reads_history" | "reference":
            if text.lower() not in TRUTH:
                raise ValueError("1, 0, true, false or nothing")
            return TRUTH[text.lower()]
        case (
            "episode"
            | "training_seed"
            | "training_step"
            | "model_seed"
            | "seed"
            | "steps"
            | "protocol_version"
            | "model_tokens"
        ):
            return _whole(text, *_RANGES.get(name, (0, MAX_NUMBER)))
        case _ if name in _MOST:
            return _number(text, _MOST[name])
    return text


def _whole(text: str, low: int, high: int) -> int:
    match = _WHOLE.fullmatch(text)
    if not match or not low <= int(match[1]) <= high:
        raise ValueError(f"a whole number from {low} to {high}")
    return int(match[1])


def _number(text: str, most: float) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value <= most:
        raise ValueError("a fraction from 0 to 1" if most == 1 else "a number from 0")
    return value


def _check_simulator(text: str) -> None:
    name, separator, shift = text.partition(_SEPARATOR)
    if separator:
        parse_shift(shift)
    if not _SIMULATOR.fullmatch(name):
        raise ValueError("up to 128 letters, digits, '.', '_', '-' and ':'")


_CHECKS: dict[str, Callable[[str], object]] = {
    "system": name_system,
    "condition": parse_condition,
    "shift": parse_shift,
    "simulator": _check_simulator,
    "family": lambda text: EpisodeId(text, "test", 0),
    "action_l1_values": lambda text: [_number(value, _LARGEST) for value in text.split()],
}


def shifted(simulator: str, shift: str) -> str:
    """Return the name of a simulator under a shift."""
    return f"{simulator}{_SEPARATOR}{shift}"


def unshifted(simulator: str) -> str:
    """Return the name of a simulator without a shift."""
    return simulator.partition(_SEPARATOR)[0]
