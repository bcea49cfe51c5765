"""Two sides of a comparison, paired over the episodes that count on both."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robomme_interference_data.evaluate.score.cube import Statuses, counting, success
from robomme_interference_data.stats import LEAST, Interval, holm, mcnemar, paired_interval
from robomme_interference_data.tables import Column, Table

__all__ = ["Pairs", "pair", "paired_table"]


@dataclass(frozen=True)
class Pairs:
    """Two sides, paired over the episodes that count on both.

    Attributes:
        n: Episodes that count on both sides.
        first: Mean success over them on the first side.
        second: The same on the second side.
        change: `second` − `first` with its interval.
        interval: Kind of that interval (see `stats.paired_interval`).
        pairs: Pairs of rollouts that are tested, one an episode: of the lowest model seed that
            counts on both sides.
        gained: Pairs that succeed on the second side alone.
        lost: Pairs that succeed on the first side alone.
    """

    n: int
    first: float
    second: float
    change: Interval
    interval: str
    pairs: int
    gained: int
    lost: int

    @property
    def flips(self) -> float:
        """Share of the pairs whose outcome differs, NaN without pairs."""
        return (self.gained + self.lost) / self.pairs if self.pairs else math.nan

    @property
    def p(self) -> float:
        """Two-sided p-value of McNemar's exact test, NaN without pairs."""
        return mcnemar(self.gained, self.lost) if self.pairs else math.nan


def pair(
    first: Statuses,
    second: Statuses,
    drawn: Interval,
    matched: tuple[Sequence[int], Sequence[int]] | None = None,
) -> Pairs:
    """Compare two sides over the same episodes.

    Args:
        first: Outcomes by episode and model seed, `(E, M) int8`.
        second: The same of the second side, `(E, N) int8`.
        drawn: Mean of second − first with its bootstrap interval.
        matched: Places of the model seeds of each side that are paired, in the order in which a
            pair is looked for; None for all.
    """
    values = np.stack([success(first), success(second)], axis=1)
    known = ~np.isnan(values).any(axis=1)
    values = values[known]
    once = all((counting(side[known]).sum(-1) == 1).all() for side in (first, second))
    change, interval = paired_interval(values, once, drawn)
    if matched is not None:
        first, second = first[:, matched[0]], second[:, matched[1]]
    both = counting(first) & counting(second)
    found = np.flatnonzero(both.any(-1))
    seed = both[found].argmax(-1)
    before, after = (side[found, seed] == 0 for side in (first, second))
    return Pairs(
        len(values),
        *(values.mean(axis=0).tolist() if len(values) else (math.nan, math.nan)),
        change,
        interval,
        len(found),
        int((after & ~before).sum()),
        int((before & ~after).sum()),
    )


def paired_table(
    name: str,
    title: str,
    columns: Sequence[Column],
    found: Sequence[tuple[tuple[Any, ...], Pairs, tuple[Any, ...]]],
    note: str,
    rates: Mapping[str, str],
    change: str = "difference",
    more: Sequence[Column] = (),
) -> Table:
    """Return a table of paired comparisons, with p-values corrected for their number.

    Args:
        name: Of its files.
        title: What it shows.
        columns: Of what is compared.
        found: What is compared, the comparison, and what more is said of it.
        note: How to read it; what is said of all such tables comes after.
        rates: Columns with the rates of the sides, each to the side: `first` or `second`.
        change: What the difference is called.
        more: Columns after those of the comparison.
    """
    p_values = [one.p for _, one, _ in found]
    rows = [
        (
            *(*own, one.n, *(getattr(one, side) for side in rates.values())),
            *(one.change.value, one.change.low, one.change.high, one.interval, one.pairs, one.gained, one.lost, one.flips),
            *(one.p, corrected, *rest),
        )
        for (own, one, rest), corrected in zip(found, holm(p_values), strict=True)
    ]
    whole = (
        *(*columns, Column("n", "count"), *(Column(name, "rate") for name in rates)),
        *(Column(change, "points"), Column("low", "points"), Column("high", "points")),
        *(Column("interval"), Column("pairs", "count"), Column("gained", "count")),
        *(Column("lost", "count"), Column("flips", "rate"), Column("p", "p")),
        *(Column("p_holm", "p"), *more),
    )
    note += (
        f" 95% intervals: bca, BCa bootstrap clustered by episode, where at least {LEAST} episodes "
        "differ; newcombe, Newcombe's paired score interval, where fewer do and each has one "
        "rollout a side; none where fewer do with repeats. pairs: one an episode, of the lowest "
        "model seed that counts on both sides; gained and lost: pairs whose outcome differs, "
        "flips: their share; p: McNemar's exact test on them; p_holm: corrected for the number of "
        "tests in this table."
    )
    if fewer := sum(one.pairs < one.n for _, one, _ in found):
        note += (
            f" In {fewer} row{'s' * (fewer > 1)} the test leaves out a part of the n episodes, in "
            "which no model seed counts on both sides: difference and p are not over the same "
            "episodes."
        )
    return Table(name, title, whole, tuple(rows), note)
