"""Conditions: what history a query episode gets, by name. The registry of all of them.

A condition is `<kind>-k<n>` or, for the paper's, `no-history` and `k<n>`. Its rule turns a query
into sessions, in order; nothing outside this file may assume what they are. Kinds that hold units
of other families hold the very units of `k<n>`, so that two conditions differ in one thing only.
All are nested in n.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DATASETS,
    DEMONSTRATIONS,
    DISTRACTORS,
    MAX_K,
    RAW_DISTRACTORS,
)
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError

from .manifest import SessionEntry

NO_HISTORY = "no-history"
"""The condition with an empty buffer (paper)."""

DEFAULT_CONDITIONS = (NO_HISTORY, "k0", "k1", "k3", "k7")
"""The paper's conditions."""


class SessionProvider(Protocol):
    """What a rule makes the history of one query of."""

    def lesson(self, part: str = "lesson") -> SessionEntry:
        """Return the query's own demonstration: all of it, or a part.

        Args:
            part: `lesson`, all of it; `first` or `second`, a half; `last`, its last frame, held
                for as many frames as a distractor unit has.
        """
        ...

    def units(self, k: int, dataset: str = DISTRACTORS) -> Sequence[SessionEntry]:
        """Return `k` units of other families, in order; nested in `k`, alike in all datasets."""
        ...

    def own_units(self, k: int) -> Sequence[SessionEntry]:
        """Return `k` units of the query's own family, of other scenes; nested in `k`."""
        ...

    def contradiction(self) -> SessionEntry:
        """Return a demonstration in the very scene of the query, with another answer."""
        ...


Sessions = tuple[SessionEntry, ...]


@dataclass(frozen=True)
class Kind:
    """A family of conditions that differ in `k` only.

    Attributes:
        name: `k` for the paper's conditions with history, `no-history`, and so on.
        rule: From a query's provider and `k` to its sessions.
        holds: The sessions in order, in words; units are those of `k<n>`.
        asks: What is asked by it.
        needs: Datasets that a buffer set must hold for it, beside demonstrations and distractors.
        own_family: Whether units are of the query's own family.
        counted: Whether its conditions have a `k` in their name.
    """

    name: str
    rule: Callable[[SessionProvider, int], Sessions] = field(compare=False)
    holds: str = ""
    asks: str = ""
    needs: tuple[str, ...] = ()
    own_family: bool = False
    counted: bool = True

    @property
    def pattern(self) -> str:
        """The names of its conditions, such as `before-k<n>`."""
        prefix = "" if self.name == "k" else f"{self.name}-"
        return f"{prefix}k<n>" if self.counted else self.name


def _nothing(provider: SessionProvider, k: int) -> Sessions:
    return ()


def _lesson_first(provider: SessionProvider, k: int) -> Sessions:
    return (provider.lesson(), *provider.units(k))


def _before(provider: SessionProvider, k: int) -> Sessions:
    return (*provider.units(k), provider.lesson())


def _middle(provider: SessionProvider, k: int) -> Sessions:
    units, half = provider.units(k), (k + 1) // 2
    return (*units[:half], provider.lesson(), *units[half:])


def _held(provider: SessionProvider, k: int) -> Sessions:
    return (provider.lesson(), *[provider.lesson("last")] * k)


def _same(provider: SessionProvider, k: int) -> Sessions:
    return (provider.lesson(), *provider.own_units(k))


def _parts(provider: SessionProvider, k: int) -> Sessions:
    return (provider.lesson("first"), *provider.units(k), provider.lesson("second"))


def _raw(provider: SessionProvider, k: int) -> Sessions:
    return (provider.lesson(), *provider.units(k, RAW_DISTRACTORS))


def _absent(provider: SessionProvider, k: int) -> Sessions:
    return tuple(provider.units(k))


def _stale(provider: SessionProvider, k: int) -> Sessions:
    return (provider.contradiction(), *_lesson_first(provider, k))


def _misled(provider: SessionProvider, k: int) -> Sessions:
    return (provider.contradiction(), *provider.units(k))


_KINDS = (
    Kind(NO_HISTORY, _nothing, "none", "the floor: no memory (paper)", counted=False),
    Kind("k", _lesson_first, "lesson, n units", "retroactive interference (paper)"),
    Kind("before", _before, "n units, lesson", "proactive interference"),
    Kind("middle", _middle, "⌈n/2⌉ units, lesson, the other units", "position"),
    Kind(
        "held",
        _held,
        "lesson, its last frame for n × 32 frames",
        "delay and dilution without content",
    ),
    Kind(
        "same",
        _same,
        "lesson, n units of the query's own family, other scenes",
        "similarity",
        own_family=True,
    ),
    Kind("parts", _parts, "first half of the lesson, n units, second half", "scattered evidence"),
    Kind(
        "raw",
        _raw,
        "lesson, the same n units at full rate: 256 frames, stride 1",
        "whether the stride gives the border away",
        (RAW_DISTRACTORS,),
    ),
    Kind("absent", _absent, "n units", "false memory: must not differ from no-history"),
    Kind(
        "stale",
        _stale,
        "contradicting lesson, lesson, n units",
        "updating: the newer lesson counts",
        (CONTRADICTIONS,),
    ),
    Kind(
        "misled",
        _misled,
        "contradicting lesson, n units",
        "how far a memory is believed",
        (CONTRADICTIONS,),
    ),
)

KINDS: dict[str, Kind] = {kind.name: kind for kind in _KINDS}
"""All kinds by name, in the order of tables."""

_COUNTED = re.compile(r"(?:(?P<kind>[a-z]+)-)?k(?P<k>0|[1-9][0-9]?)")


@dataclass(frozen=True)
class Condition:
    """A condition: what history a query gets.

    Attributes:
        name: `no-history`, `k0`, `k3`, `before-k3`, …
        kind: Its kind.
        k: Number of sessions that its kind adds; 0 for one that does not count.
    """

    name: str
    kind: Kind
    k: int

    def sessions(self, provider: SessionProvider) -> Sessions:
        """Return the sessions of a query's buffer, in order.

        Raises:
            BuildError: The provider does not hold so many units.
            SourceError: It has no contradicting lesson.
        """
        return self.kind.rule(provider, self.k)

    @property
    def sort_key(self) -> tuple[int, int]:
        """Key of the order in tables: by kind as registered, then by `k`."""
        return list(KINDS).index(self.kind.name), self.k

    def __str__(self) -> str:
        return self.name


def parse_condition(text: str | Condition) -> Condition:
    """Read a condition's name; a condition is returned as it is."""
    if isinstance(text, Condition):
        return text
    if isinstance(text, str):
        if text in KINDS and not KINDS[text].counted:
            return Condition(text, KINDS[text], 0)
        match = _COUNTED.fullmatch(text)
        kind = KINDS.get(match["kind"] or "k") if match and match["kind"] != "k" else None
        if match and kind is not None and int(match["k"]) <= MAX_K:
            return Condition(text, kind, int(match["k"]))
    raise InvalidIdError(
        f"{text!r} is not a condition",
        f"Expected {NO_HISTORY}, k0, k1, … k{MAX_K}, before-k3, …",
        "conditions",
    )


def in_order(conditions: Iterable[str | Condition]) -> tuple[Condition, ...]:
    """Return conditions in the order of tables."""
    found = sorted(map(parse_condition, conditions), key=lambda one: one.sort_key)
    names = [one.name for one in found]
    if not found or len(set(names)) < len(names):
        raise InvalidOptionError(
            f"conditions {' '.join(names) or '(none)'}; expected some, each once",
            f"For example: {' '.join(DEFAULT_CONDITIONS)}",
        )
    return tuple(found)


def datasets_of(conditions: Iterable[Condition]) -> tuple[str, ...]:
    """Return the datasets that a buffer set must hold for conditions."""
    further = {name for one in conditions for name in one.kind.needs}
    return tuple(n for n in DATASETS if n in further or n in (DEMONSTRATIONS, DISTRACTORS))
