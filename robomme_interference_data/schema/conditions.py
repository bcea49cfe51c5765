"""Conditions: which history a query episode gets, by name. The registry of all of them.

A condition is `<kind>-k<n>` or, for the paper's, `no-history` and `k<n>`. Its rule returns the
sessions of a query's buffer in order; no code outside this file may assume what they are. Kinds
with units of other families use the units of `k<n>`, so that two conditions differ in one respect
only. All kinds are nested in n.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol

from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DATASETS,
    DAYS,
    DEMONSTRATIONS,
    DISTRACTORS,
    MAX_K,
    RAW_DISTRACTORS,
)
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError

if TYPE_CHECKING:  # conditions are known wherever rows are, manifests only where buffers are
    from .manifest import SessionEntry

NO_HISTORY = "no-history"
"""The condition with an empty buffer (paper)."""

DEFAULT_CONDITIONS = (NO_HISTORY, "k0", "k1", "k3", "k7")
"""The paper's conditions."""


class SessionProvider(Protocol):
    """The sessions from which rules compose the history of one query."""

    def lesson(self, part: str = "lesson") -> "SessionEntry":
        """Return the query's own demonstration, or a part of it.

        Args:
            part: `lesson` for all of it; `first` or `second` for a half; `last` for its last
                frame, held for as many frames as a distractor unit has.
        """
        ...

    def units(self, k: int, dataset: str = DISTRACTORS) -> "Sequence[SessionEntry]":
        """Return `k` units of other families, nested in `k`; the same episodes in any dataset."""
        ...

    def own_units(self, k: int) -> "Sequence[SessionEntry]":
        """Return `k` units of the query's own family, from other scenes; nested in `k`."""
        ...

    def contradiction(self) -> "SessionEntry":
        """Return a demonstration in the query's scene with another answer."""
        ...

    def day(self, k: int) -> "Sequence[SessionEntry]":
        """Return the query's day up to `k` tasks after its last lesson; nested in `k`."""
        ...


type Sessions = tuple[SessionEntry, ...]


@dataclass(frozen=True)
class ConditionKind:
    """A family of conditions that differ only in `k`.

    Attributes:
        name: `k` for the paper's conditions with history, `no-history`, and so on.
        rule: Returns the sessions for a query's provider and `k`.
        holds: The sessions in order, in words; units are those of `k<n>`.
        asks: The question that it answers.
        needs: Datasets that it needs in addition to demonstrations and distractors.
        own_family: Whether its units are of the query's own family.
        counted: Whether the names of its conditions have a `k`.
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

    def __reduce__(self) -> tuple[Any, ...]:  # rules cannot be pickled
        return _kind, (self.name,)


def _kind(name: str) -> ConditionKind:
    return KINDS[name]


_KINDS = (
    ConditionKind(
        NO_HISTORY, lambda p, k: (), "none", "the floor: no memory (paper)", counted=False
    ),
    ConditionKind(
        "k",
        lambda p, k: (p.lesson(), *p.units(k)),
        "lesson, n units",
        "retroactive interference (paper)",
    ),
    ConditionKind(
        "before",
        lambda p, k: (*p.units(k), p.lesson()),
        "n units, lesson",
        "proactive interference",
    ),
    ConditionKind(
        "middle",
        lambda p, k: (*p.units(k)[: (k + 1) // 2], p.lesson(), *p.units(k)[(k + 1) // 2 :]),
        "⌈n/2⌉ units, lesson, the other units",
        "position",
    ),
    ConditionKind(
        "held",
        lambda p, k: (p.lesson(), *(p.lesson("last") for _ in range(k))),
        "lesson, its last frame for n × 32 frames",
        "delay and dilution without content",
    ),
    ConditionKind(
        "same",
        lambda p, k: (p.lesson(), *p.own_units(k)),
        "lesson, n units of the query's own family, other scenes",
        "similarity",
        own_family=True,
    ),
    ConditionKind(
        "parts",
        lambda p, k: (p.lesson("first"), *p.units(k), p.lesson("second")),
        "first half of the lesson, n units, second half",
        "scattered evidence",
    ),
    ConditionKind(
        "raw",
        lambda p, k: (p.lesson(), *p.units(k, RAW_DISTRACTORS)),
        "lesson, the same n units at full rate: up to 256 frames each",
        "dilution by eight times the frames, at the rate of the lesson",
        (RAW_DISTRACTORS,),
    ),
    ConditionKind(
        "absent",
        lambda p, k: tuple(p.units(k)),
        "n units",
        "false memory: must not differ from no-history",
    ),
    ConditionKind(
        "stale",
        lambda p, k: (p.contradiction(), p.lesson(), *p.units(k)),
        "contradicting lesson, lesson, n units",
        "updating: the newer lesson counts",
        (CONTRADICTIONS,),
    ),
    ConditionKind(
        "misled",
        lambda p, k: (p.contradiction(), *p.units(k)),
        "contradicting lesson, n units",
        "how far a memory is believed",
        (CONTRADICTIONS,),
    ),
    ConditionKind(
        "day",
        lambda p, k: tuple(p.day(k)),
        "the query's day until n tasks after its last lesson, without a cut",
        "one stream without borders",
        (DAYS,),
    ),
    ConditionKind(
        "day-cut",
        lambda p, k: tuple(s for s in p.day(k) if s.role != "transition"),
        "the same without the transitions between tasks",
        "borders",
        (DAYS,),
    ),
    ConditionKind(
        "day-alone",
        lambda p, k: tuple(s for s in p.day(0) if s.role in ("lesson", "contradiction")),
        "the query's lessons of that day alone",
        "the same lessons without anything else",
        (DAYS,),
        counted=False,
    ),
)

KINDS: dict[str, ConditionKind] = {kind.name: kind for kind in _KINDS}
"""All kinds by name, in the order of tables."""

# No leading zeros: a condition has one spelling.
_COUNTED = re.compile(r"(?:(?P<kind>[a-z]+(?:-[a-z]+)*)-)?k(?P<k>0|[1-9][0-9]?)")


@dataclass(frozen=True)
class Condition:
    """A condition: which history a query gets.

    Attributes:
        name: `no-history`, `k0`, `k3`, `before-k3`, …
        kind: Its kind.
        k: Number of sessions that its kind adds; 0 for `no-history`.
    """

    name: str
    kind: ConditionKind
    k: int

    def sessions(self, provider: SessionProvider) -> Sessions:
        """Return the sessions of a query's buffer, in order.

        Raises:
            BuildError: The provider has too few units.
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
    """Parse a condition's name; a condition is returned unchanged."""
    if isinstance(text, Condition):
        return text
    if isinstance(text, str):
        if text in KINDS and not KINDS[text].counted:
            return Condition(text, KINDS[text], 0)
        match = _COUNTED.fullmatch(text)
        kind = KINDS.get(match["kind"] or "k") if match and match["kind"] != "k" else None
        if match and kind is not None and kind.counted and int(match["k"]) <= MAX_K:
            return Condition(text, kind, int(match["k"]))
    raise InvalidIdError(
        f"{text!r} is not a condition",
        f"{_similar(text)}Expected {NO_HISTORY}, k0, k1, … k{MAX_K}, before-k3, …",
        "conditions",
    )


def _similar(text: object) -> str:
    """Return a question about the condition that was likely meant, in small letters, or nothing."""
    small = str(text).strip().lower()
    if small == text:
        return ""
    try:
        return f"Did you mean {parse_condition(small).name!r}? "
    except InvalidIdError:
        return ""


def in_order(conditions: Iterable[str | Condition]) -> tuple[Condition, ...]:
    """Return conditions in the order of tables."""
    ordered = sorted(map(parse_condition, conditions), key=lambda condition: condition.sort_key)
    names = [condition.name for condition in ordered]
    if not ordered or len(set(names)) < len(names):
        raise InvalidOptionError(
            f"conditions {' '.join(names) or '(none)'}; expected at least one, each once",
            f"For example: {' '.join(DEFAULT_CONDITIONS)}",
        )
    return tuple(ordered)


def datasets_of(conditions: Iterable[Condition]) -> tuple[str, ...]:
    """Return the names of the datasets that conditions need."""
    further = {name for condition in conditions for name in condition.kind.needs}
    return tuple(n for n in DATASETS if n in further or n in (DEMONSTRATIONS, DISTRACTORS))
