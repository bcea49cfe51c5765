"""Columns of tables that name and describe an episode. Pure rules.

Other programs change how values are stored: pandas makes floats of whole numbers, and NaN of empty
ones. What has one meaning is read; the rest is an error that names column and value.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

from robomme_interference_data.errors import SourceError
from robomme_interference_data.schema.codec import from_dict
from robomme_interference_data.schema.records import EvidenceSpan

from .flags import parse_flag

NAMING = ("episode_id", "family", "split", "index")
"""Columns that name an episode, see `families.ids_by_columns`."""

_LARGEST = 1 << 53
"""Floats beyond it are no longer exact whole numbers."""


@dataclass(frozen=True)
class EpisodeColumns:
    """Per-episode columns of a LeRobot dataset; None where it has none."""

    goals: tuple[str, ...] | None
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exact: bool | None
    exec_start_idx: int | None
    evidence: tuple[EvidenceSpan, ...] | None


def read_episode_columns(row: Mapping[str, Any], where: str) -> EpisodeColumns:
    """Read the columns of an episode, given as plain values; `where` names it in errors.

    Raises:
        SourceError: A column has a value of another meaning.
    """
    names = [field.name for field in fields(EpisodeColumns)]
    return EpisodeColumns(**{name: read_column(name, row.get(name), where) for name in names})


def read_column(name: str, value: Any, where: str) -> Any:
    """Read the value of one of the columns; None if it is empty.

    Raises:
        SourceError: It has another meaning.
    """
    try:
        return parse_column(name, value)
    except ValueError as error:
        raise SourceError(
            f"{where}: {error}", "Correct the per-episode column in meta/, or remove it."
        ) from None


def parse_column(name: str, value: Any) -> Any:
    """Return the value of one of the columns in its own type; None if it is empty.

    Raises:
        ValueError: It has another meaning.
    """
    parse, expected = _COLUMNS[name]
    try:
        return None if _is_empty(value) else parse(value)
    except (ValueError, OverflowError):
        raise ValueError(
            f"{name} is {repr(value)[:200]}; expected {expected}, or nothing"
        ) from None


def _is_empty(value: Any) -> bool:
    """Return whether a value is none: null, NaN as pandas writes it, or empty text."""
    return value is None or value == "" or (isinstance(value, float) and math.isnan(value))


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        raise ValueError(value)
    number = int(value)
    if isinstance(value, float) and (number != value or abs(number) >= _LARGEST):
        raise ValueError(value)
    return number


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(value)
    return value


def _texts(value: Any) -> tuple[str, ...]:
    if isinstance(value, str):
        return (value,)
    if not isinstance(value, list):
        raise ValueError(value)
    return tuple(map(_text, value))


def _evidence(value: Any) -> tuple[EvidenceSpan, ...]:
    if not isinstance(value, list):
        raise ValueError(value)
    return tuple(from_dict(EvidenceSpan, span, "evidence") for span in value)


_COLUMNS: dict[str, tuple[Callable[[Any], Any], str]] = {
    # They name the episode.
    "episode_id": (_text, "its id"),
    "family": (_text, "the name of one"),
    "split": (_text, "train, val, test or heldout"),
    "index": (_whole, "a whole number"),
    # They describe it.
    "tasks": (_texts, "texts"),
    "goals": (_texts, "texts"),
    "seed": (_whole, "a whole number"),
    "difficulty": (_text, "easy, medium or hard"),
    "simulator": (_text, "the name of one"),
    "exact": (parse_flag, "true or false"),
    "exec_start_idx": (_whole, "a whole number"),
    "evidence": (_evidence, "spans of frames"),
}
"""How each column is read, and what it holds."""
