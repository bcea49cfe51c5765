"""Conditions: what history a query episode gets, by name. The registry of all of them.

A condition is `<kind>-k<n>` or, for the paper's, `no-history` and `k<n>`. Its rule turns a query
into sessions, in order; nothing outside this file may assume what they are.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from robomme_interference_data.constants import MAX_K
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError
from robomme_interference_data.records import SessionEntry

NO_HISTORY = "no-history"
"""The condition with an empty buffer (paper)."""

DEFAULT_CONDITIONS = (NO_HISTORY, "k0", "k1", "k3", "k7")
"""The paper's conditions."""


class Material(Protocol):
    """What a rule makes the history of one query of."""

    def lesson(self) -> SessionEntry:
        """Return the query's own demonstration, whole."""
        ...

    def units(self, k: int) -> Sequence[SessionEntry]:
        """Return `k` distractor units of other families, in order; nested in `k`.

        Raises:
            PoolTooSmallError: There are not so many.
        """
        ...


@dataclass(frozen=True)
class Kind:
    """A family of conditions that differ in `k` only.

    Attributes:
        name: `k` for the paper's conditions with history, `no-history`, and so on.
        rule: From a query's material and `k` to its sessions.
        counted: Whether its conditions have a `k` in their name.
    """

    name: str
    rule: Callable[[Material, int], tuple[SessionEntry, ...]] = field(compare=False)
    counted: bool = True


def _nothing(material: Material, k: int) -> tuple[SessionEntry, ...]:
    return ()


def _lesson_first(material: Material, k: int) -> tuple[SessionEntry, ...]:
    return (material.lesson(), *material.units(k))


_KINDS = (
    Kind(NO_HISTORY, _nothing, counted=False),
    Kind("k", _lesson_first),
)

KINDS: dict[str, Kind] = {kind.name: kind for kind in _KINDS}
"""All kinds by name, in the order of tables."""

_COUNTED = re.compile(r"(?:(?P<kind>[a-z]+)-)?k(?P<k>0|[1-9][0-9]?)")


@dataclass(frozen=True)
class Condition:
    """A condition: what history a query gets.

    Attributes:
        name: `no-history`, `k0`, `k3`, …
        kind: Its kind.
        k: Number of sessions that its kind adds; 0 for one that does not count.
    """

    name: str
    kind: Kind
    k: int

    def sessions(self, material: Material) -> tuple[SessionEntry, ...]:
        """Return the sessions of a query's buffer, in order.

        Raises:
            PoolTooSmallError: The material does not hold so many units.
        """
        return self.kind.rule(material, self.k)

    @property
    def sort_key(self) -> tuple[int, int]:
        """Key of the order in tables: by kind as registered, then by `k`."""
        return list(KINDS).index(self.kind.name), self.k

    def __str__(self) -> str:
        return self.name


def parse_condition(text: str | Condition) -> Condition:
    """Read a condition's name; a condition is returned as it is.

    Raises:
        InvalidIdError: There is no such condition.
    """
    if isinstance(text, Condition):
        return text
    if isinstance(text, str):
        if text in KINDS and not KINDS[text].counted:
            return Condition(text, KINDS[text], 0)
        match = _COUNTED.fullmatch(text)
        kind = KINDS.get((match["kind"] or "k") if match else "")
        if match and kind is not None and kind.counted and int(match["k"]) <= MAX_K:
            return Condition(text, kind, int(match["k"]))
    raise InvalidIdError(
        f"{text!r} is not a condition", f"Expected {NO_HISTORY}, k0, k1, … k{MAX_K}."
    )


def in_order(conditions: Iterable[str | Condition]) -> tuple[Condition, ...]:
    """Return conditions in the order of tables.

    Raises:
        InvalidIdError: One is none.
        InvalidOptionError: One comes twice, or there is none.
    """
    found = sorted(map(parse_condition, conditions), key=lambda one: one.sort_key)
    names = [one.name for one in found]
    if not found or len(set(names)) < len(names):
        raise InvalidOptionError(
            f"conditions {' '.join(names) or '(none)'}; expected some, each once",
            f"For example: {' '.join(DEFAULT_CONDITIONS)}",
        )
    return tuple(found)
