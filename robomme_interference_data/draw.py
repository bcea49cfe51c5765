"""Draw the distractor units of a history buffer: pure, and the same on every machine.

Rules 1 to 4 of the protocol. The draw for a query depends on its id, on the set of eligible unit
ids (those of other families), on the seed and on the rule version; on nothing else, and on no
other query. All choices come from SHA-256, none from a random generator.

Rule version 1, for a query of family F and index i:

1. *Units of a family* are put in an order by SHA-256. The query takes the unit at position q of
   its family's order, cyclically, where q numbers all queries that may draw from this family:
   i times the number of such benchmark families, plus the rank of F among them (and an offset
   from SHA-256). So consecutive queries take consecutive units, and all come up equally often.
2. *Families* are put in an order by SHA-256 for every block of m consecutive queries of F, m
   being the number of eligible families, and the order is rotated by one from query to query.
   So within a block every family comes once at each place.
3. A family with fewer units than the largest one joins in proportionally fewer queries, evenly
   spaced, so that its units are not used more often than others; in the queries that it sits
   out it comes after all families that join.
4. The first round takes one unit of each family in that order. Further rounds, needed only if k
   exceeds m, count as the next queries: the families that join then give their next unit.
"""

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cached_property

from robomme_interference_data.constants import FAMILIES, RULE_VERSION
from robomme_interference_data.errors import InvalidOptionError, PoolTooSmallError
from robomme_interference_data.ids import EpisodeId


class UnitPool:
    """The distractor units that buffers draw from.

    Args:
        units: Ids of the episodes that the units were made of; order does not matter.
        seed: Seed of the draw.

    Raises:
        InvalidOptionError: An id occurs twice.
    """

    def __init__(self, units: Iterable[EpisodeId], seed: int = 0):
        self.seed = seed
        families: dict[str, list[EpisodeId]] = {}
        for unit in units:
            families.setdefault(unit.family, []).append(unit)
        for family, members in families.items():
            twice, times = Counter(members).most_common(1)[0]
            if times > 1:
                raise InvalidOptionError(f"unit {twice} is in the pool {times} times")
            members.sort(key=lambda unit: self._hash("unit", str(unit)))
            families[family] = members
        self._families = dict(sorted(families.items()))
        self._eligible: dict[str, _Eligible] = {}

    def __len__(self) -> int:
        return sum(len(members) for members in self._families.values())

    @property
    def families(self) -> tuple[str, ...]:
        """Families in the pool, by name."""
        return tuple(self._families)

    def draw(self, query: EpisodeId, k: int) -> list[EpisodeId]:
        """Draw `k` distinct units of other families for a query; nested in `k`.

        Args:
            query: Id of the query episode.
            k: Number of units, 0 or more.

        Returns:
            The units in buffer order. `draw(query, j)` is the beginning of it for every j ≤ k.

        Raises:
            PoolTooSmallError: The other families together have fewer than `k` units.
        """
        eligible = self._eligible.get(query.family)
        if eligible is None:
            others = {f: units for f, units in self._families.items() if f != query.family}
            eligible = self._eligible[query.family] = _Eligible(self, query.family, others)
        if k > eligible.count:
            raise PoolTooSmallError(
                f"{query} needs {k} distractor units of other families; the pool has "
                f"{eligible.count} ({', '.join(eligible.families) or 'no family'})",
                "Build distractors from more episodes or families, or plan a smaller k.",
            )
        units = eligible.units(query)
        return [next(units) for _ in range(k)]

    def _hash(self, *parts: str) -> bytes:
        text = "\n".join((f"robomme-interference draw {RULE_VERSION}", str(self.seed), *parts))
        return hashlib.sha256(text.encode()).digest()

    def _offset(self, *parts: str) -> int:
        return int.from_bytes(self._hash(*parts)[:8])


class _Eligible:
    """The families that queries of one family draw from."""

    def __init__(self, pool: UnitPool, query_family: str, families: dict[str, list[EpisodeId]]):
        self.pool = pool
        self.query_family = query_family
        self.families = families
        self.count = sum(map(len, families.values()))
        self.largest = max(map(len, families.values()), default=0)
        self._orders: dict[tuple[str, int], list[str]] = {}
        self._offsets: dict[tuple[str, str], int] = {}

    @cached_property
    def _numbering(self) -> dict[str, tuple[int, int]]:
        """For each family: how many benchmark families draw from it, and the query's rank."""
        numbering = {}
        for family in self.families:
            drawing = [name for name in FAMILIES if name != family]
            if self.query_family in drawing:
                rank = drawing.index(self.query_family)
            else:
                rank = self.pool._offset("rank", self.query_family) % len(drawing)
            numbering[family] = (len(drawing), rank)
        return numbering

    def units(self, query: EpisodeId) -> Iterator[EpisodeId]:
        """Yield all eligible units for a query, in buffer order."""
        order = self._order(query)
        numbers = {family: self._number(query, family) for family in order}
        taken = dict.fromkeys(order, 0)

        def next_unit(family: str) -> EpisodeId:
            units = self.families[family]
            unit = units[(self._joined(family, numbers[family]) + taken[family]) % len(units)]
            taken[family] += 1
            return unit

        for turn in range(self.largest):
            joining = [
                family
                for family in order
                if taken[family] < len(self.families[family])
                and self._joined(family, numbers[family] + turn + 1)
                > self._joined(family, numbers[family] + turn)
            ]
            waiting = [family for family in order if family not in joining] if turn == 0 else []
            yield from map(next_unit, joining + waiting)
        for family in order:
            yield from (
                next_unit(family) for _ in range(len(self.families[family]) - taken[family])
            )

    def _order(self, query: EpisodeId) -> list[str]:
        block, rotation = divmod(query.index, len(self.families)) if self.families else (0, 0)
        order = self._orders.get((query.split, block))
        if order is None:
            parts = ("order", query.split, self.query_family, str(block))
            order = sorted(self.families, key=lambda family: self.pool._hash(*parts, family))
            if len(self._orders) > 64:  # queries come by index: older blocks are done
                self._orders.clear()
            self._orders[query.split, block] = order
        return order[rotation:] + order[:rotation]

    def _number(self, query: EpisodeId, family: str) -> int:
        """Return the query's number among all that may draw from a family, plus an offset."""
        drawing, rank = self._numbering[family]
        offset = self._offsets.get((query.split, family))
        if offset is None:
            # Families start at different places, so that small ones join at different queries.
            offset = self.pool._offset("offset", query.split, family) % self.largest
            self._offsets[query.split, family] = offset
        return query.index * drawing + rank + offset

    def _joined(self, family: str, number: int) -> int:
        """Return in how many of the queries before `number` the family has joined."""
        return number * len(self.families[family]) // self.largest
