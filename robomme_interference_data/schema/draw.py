"""Draw the distractor units of a history buffer; the result is the same on every machine.

Rules 1 to 4 of the protocol. The draw for a query depends only on its id, the ids of the units of
other families, the seed and the rule version. Choices come from SHA-256, not from a random
generator. Several units of one recorded episode are units like others: they do not overlap, and a
buffer may hold two of them.

Rule version 1, for a query of family F and index i:

1. *Units of a family* are ordered by SHA-256. The query takes the unit at position q, modulo their
   number; q numbers all queries that may draw from this family: i times the number of families
   that do, plus the rank of F among them, plus an offset from SHA-256. So consecutive queries take
   consecutive units, and all units are used equally often. Families that draw are the benchmark's
   nine; if F or a family with units is none of them, those with units and F.
2. *Families* are ordered by SHA-256 for every block of m consecutive queries of F, where m is the
   number of eligible families; the order rotates by one from query to query. So within a block
   every family comes once at each position.
3. A family with fewer units than the largest one joins proportionally fewer queries, evenly
   spaced, so that its units are not used more often than others. In other queries it comes after
   all families that join.
4. The first round takes one unit of each family in that order. Further rounds, needed only if
   k > m, count as the next queries: the families that join then give their next unit.
"""

import hashlib
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import islice
from typing import Any, NamedTuple

from robomme_interference_data.constants import DISTRACTORS, FAMILIES, MAX_STEPS, RULE_VERSION
from robomme_interference_data.errors import BuildError, InvalidOptionError, counted, named
from robomme_interference_data.ids import EpisodeId

from .conditions import Condition
from .days import day_tasks, least_day


class UnitPool:
    """The distractor units that buffers draw from; the order of `units` does not matter."""

    def __init__(self, units: Iterable[EpisodeId], seed: int = 0):
        self._hash = cache(partial(_hash, seed))  # the same for many queries
        families: dict[str, list[EpisodeId]] = {}
        for unit in units:
            families.setdefault(unit.family, []).append(unit)
        for members in families.values():
            twice, times = Counter(members).most_common(1)[0]
            if times > 1:
                raise InvalidOptionError(f"unit {twice} is in the pool {times} times")
            members.sort(key=lambda unit: self._hash("unit", str(unit)))
        self._families = dict(sorted(families.items()))

    def draw(self, query: EpisodeId, k: int) -> list[EpisodeId]:
        """Draw `k` distinct units of other families in buffer order.

        `draw(query, j)` is the beginning of `draw(query, k)` for every j ≤ k.
        """
        others = {name: units for name, units in self._families.items() if name != query.family}
        count = sum(map(len, others.values()))
        if k > count:
            raise BuildError(
                f"{query} needs {k} distractor units of other families; the pool has "
                f"{count} ({', '.join(others) or 'no family'}), {k - count} too few",
                "Build distractors from more episodes or families, or choose "
                f"{named('conditions')} with a "
                "smaller k.",
            )
        return list(islice(self._units(query, others), k))

    def draw_own(self, query: EpisodeId, k: int) -> list[EpisodeId]:
        """Draw `k` distinct units of the query's family, of other episodes; nested in `k`.

        They are consecutive in the family's order; queries start seven units apart.
        """
        units = [unit for unit in self._families.get(query.family, []) if unit.scene != query.scene]
        if k > len(units):
            raise BuildError(
                f"{query} needs {k} units of its own family; the pool has {len(units)} "
                f"others, {k - len(units)} too few",
                f"Build distractors from more episodes of {query.family}, or choose "
                f"{named('conditions')} "
                "with a smaller k.",
            )
        first = 7 * query.index + self._offset("own", query.split, query.family)
        return [units[(first + number) % len(units)] for number in range(k)]

    def _units(self, query: EpisodeId, others: dict[str, list[EpisodeId]]) -> Iterator[EpisodeId]:
        """Yield all units of other families for a query, in buffer order."""
        largest = max(map(len, others.values()), default=0)
        order = self._order(query, list(others))
        named = {query.family, *others}
        drawing = FAMILIES if named <= {*FAMILIES} else tuple(sorted(named))
        numbers = {name: self._number(query, name, largest, drawing) for name in order}
        taken = dict.fromkeys(order, 0)

        def joined(name: str, turn: int) -> int:
            """Return how many of the queries before the turn the family has joined."""
            return (numbers[name] + turn) * len(others[name]) // largest

        def next_unit(name: str) -> EpisodeId:
            unit = others[name][(joined(name, 0) + taken[name]) % len(others[name])]
            taken[name] += 1
            return unit

        for turn in range(largest):
            joining = [
                name
                for name in order
                if taken[name] < len(others[name]) and joined(name, turn + 1) > joined(name, turn)
            ]
            waiting = [name for name in order if name not in joining] if turn == 0 else []
            yield from map(next_unit, joining + waiting)
        for name in order:
            yield from (next_unit(name) for _ in range(len(others[name]) - taken[name]))

    def _order(self, query: EpisodeId, names: list[str]) -> list[str]:
        """Return the other families in the rotated order of the query's block."""
        block, rotation = divmod(query.index, max(1, len(names)))
        parts = ("order", query.split, query.family, str(block))
        order = sorted(names, key=lambda name: self._hash(*parts, name))
        return order[rotation:] + order[:rotation]

    def _number(self, query: EpisodeId, family: str, largest: int, drawing: tuple[str, ...]) -> int:
        """Return the query's number among all that may draw from a family, plus an offset."""
        others = [name for name in drawing if name != family]
        # Families start at different positions, so that small ones join different queries.
        offset = self._offset("offset", query.split, family) % largest
        return query.index * len(others) + others.index(query.family) + offset

    def _offset(self, *parts: str) -> int:
        return int.from_bytes(self._hash(*parts)[:8])


def check_units(
    pool: UnitPool,
    queries: Iterable[EpisodeId],
    conditions: Iterable[Condition],
    absent: Collection[EpisodeId] = (),
    days: Mapping[EpisodeId, EpisodeId] | None = None,
    position_limit: int | None = None,
) -> None:
    """Check that a pool has the units of all buffers, and that every query has what it needs.

    It shows before anything is built, of days as far as their plan decides on it.

    Args:
        pool: The units.
        queries: The query episodes.
        conditions: The conditions.
        absent: Those of them that no lesson is shown for.
        days: The days of queries of days.
        position_limit: Most positions of history and rollout; None for no limit.

    Raises:
        BuildError: The pool has too few units; the message says how many. Or a condition needs the
            lesson of one of `absent`, or more tasks of a day than follow.
        InvalidOptionError: A query's day is longer than the limit.
    """
    chosen, days = list(conditions), days or {}
    # Queries of a family draw alike.
    checked = {episode.family: episode for episode in sorted(queries)}
    # The last one first, so that the error says what all others have, too.
    in_days = sorted(days, key=lambda query: least_day(days[query], query)[0], reverse=True)
    for query in [*in_days, *checked.values(), *sorted(absent)]:
        for condition in chosen:
            provider = _UnreadSessions(query, pool, query in absent, days.get(query))
            frames = sum(session.num_frames for session in condition.sessions(provider))
            if position_limit is not None and frames + MAX_STEPS > position_limit:
                what = f"{query} under {condition}"
                raise too_long(what, f"at least {frames}", frames, position_limit)


def too_few_follow(query: EpisodeId, day: EpisodeId, further: int, k: int) -> BuildError:
    """Return the error about a condition that needs more tasks of a day than follow."""
    return BuildError(
        f"{counted(further, 'task')} of {day} follow after {query} can be asked; a condition needs "
        f"{k}",
        f"Choose {named('conditions')} with at most that many, such as day-k{further}, or build "
        "longer days.",
    )


def too_long(what: str, shown: str, frames: int, limit: int) -> InvalidOptionError:
    """Return the error about a history that, with its rollout, exceeds a position limit (rule 8).

    Args:
        what: The buffer.
        shown: Its number of frames, in words.
        frames: The number of frames, of which it may have more.
        limit: The limit.
    """
    return InvalidOptionError(
        f"{what} needs {frames + MAX_STEPS} positions ({shown} history frames + {MAX_STEPS} "
        f"steps); the limit is {limit}",
        f"Leave out the condition, or set {named('position_limit', 'none')} for systems without a "
        "limit.",
    )


def only_in_days(query: EpisodeId) -> BuildError:
    """Return the error about a condition that needs a lesson which the query's day does not show.

    A day may show none, or the goal may ask for the first of two.
    """
    return BuildError(
        f"{query} is a query of a day, which decides on its lessons",
        f"Choose {named('conditions')} of days alone: no-history,day-alone,day-k0,day-k2",
    )


@dataclass(frozen=True)
class _UnreadSessions:
    """Sources of a query's sessions, before data is read: drawing checks that units suffice."""

    query: EpisodeId
    pool: UnitPool
    absent: bool
    in_day: EpisodeId | None

    def lesson(self, part: str = "lesson") -> Any:
        if self.absent:
            raise only_in_days(self.query)
        return _Unread("lesson")

    def contradiction(self) -> Any:
        return _Unread("contradiction")

    def units(self, k: int, dataset: str = DISTRACTORS) -> Sequence[Any]:
        return [_Unread("distractor") for _ in self.pool.draw(self.query, k)]

    def own_units(self, k: int) -> Sequence[Any]:
        return [_Unread("distractor") for _ in self.pool.draw_own(self.query, k)]

    def day(self, k: int) -> Sequence[Any]:
        if self.in_day is None:
            return ()
        asked, sessions = least_day(self.in_day, self.query)
        further = day_tasks(self.in_day) - 1 - asked
        if k > further:
            raise too_few_follow(self.query, self.in_day, further, k)
        return [_Unread(*session) for session in sessions[: 2 * (asked + k + 1)]]


class _Unread(NamedTuple):
    """A session that is not read yet, with the number of frames that is certain."""

    role: str
    num_frames: int = 0


def _hash(seed: int, *parts: str) -> bytes:
    # The version is hashed, too: new rules make new draws, instead of nearly the same ones.
    text = "\n".join((f"robomme-interference draw {RULE_VERSION}", str(seed), *parts))
    return hashlib.sha256(text.encode()).digest()
