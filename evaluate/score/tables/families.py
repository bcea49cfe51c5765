"""Whether effects differ between families, and intervals for tasks beyond these nine."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.score.outcomes import Outcomes, success
from robomme_interference_data.stats.bootstrap import (
    MIN_EPISODES,
    Floats,
    generator_of,
    varies_enough,
)
from robomme_interference_data.stats.significance import holm
from robomme_interference_data.viz.tables import Table

from .comparison import COMPLETE, SIDES, ComparisonTable, comparison_table
from .contrast import Contrast, Effect

DRAWS = 2000
"""Random signs, and draws of families and episodes."""

MIN_IN_FAMILY = 20
"""Episodes of each family from which p families holds: with 10 it finds too much, 19%."""

_EFFECTS = (Effect.HISTORY, Effect.SESSIONS, Effect.RETRIEVAL, Effect.INTERFERENCE)

FAMILIES = ComparisonTable(
    name="families",
    title="Effects over families",
    columns=SIDES
    | {
        "n": "count",
        "families": "count",
        "difference": "points",
        "alike": "points",
        "alike_low": "points",
        "alike_high": "points",
        "without_low": "points",
        "without_high": "points",
        "spread": "points",
        "sample_low": "points",
        "sample_high": "points",
        "p_families": "p",
        "p_families_holm": "p",
    }
    | COMPLETE,
    note=(
        "difference: over all episodes, as in the table effects. alike: the mean of the families' "
        "own differences. alike low to alike high: its 95% bootstrap interval for these families, "
        "with episodes drawn within each. without low to without high: the lowest and the highest "
        "mean if one family is left out. spread: the standard deviation of the true differences of "
        "families, estimated without the noise of their episodes. sample low to sample high: as "
        "alike low and alike high, with families drawn too, as a sample of such families: for "
        "tasks beyond these, much wider, and with so few families still too narrow. Both from "
        f"{DRAWS:,} draws, if at least {MIN_EPISODES} episodes differ. p families: a test of "
        f"whether the difference varies between families, by {DRAWS:,} random sign flips of the "
        "differences from their family's mean, if each family has at least "
        f"{MIN_IN_FAMILY} episodes; p families holm: after Holm's correction within a simulator. "
        "All of it is for these checkpoints: training runs are fixed."
    ),
    explain=False,
)


def families_table(all_outcomes: Iterable[Outcomes], contrasts: Sequence[Contrast]) -> Table:
    """Return each effect with equally weighted families, and whether it varies over them."""
    rows = list[Contrast]()
    for outcomes in all_outcomes:
        labels = outcomes.family
        effects, differences, counts = list[Contrast](), list[Floats](), list[NDArray[np.int64]]()
        for contrast in contrasts:
            if contrast.simulator != outcomes.simulator or contrast.effect not in _EFFECTS:
                continue
            before = success(outcomes.status[outcomes.cell(*contrast.against)])
            after = success(outcomes.status[outcomes.cell(contrast.system, contrast.condition)])
            _, sizes = np.unique(labels[~np.isnan(after - before)], return_counts=True)
            if len(sizes) > 1:
                effects.append(contrast)
                differences.append(after - before)
                counts.append(sizes)
        if not effects:
            continue
        estimates = over_families(np.stack(differences, axis=1), labels, outcomes.simulator)
        estimates = [
            estimate if sizes.min() >= MIN_IN_FAMILY else estimate._replace(p_families=math.nan)
            for estimate, sizes in zip(estimates, counts, strict=True)
        ]
        holms = holm([estimate.p_families for estimate in estimates])
        for contrast, sizes, estimate, p_holm in zip(
            effects, counts, estimates, holms, strict=True
        ):
            columns = {"families": len(sizes), **estimate._asdict(), "p_families_holm": p_holm}
            rows.append(replace(contrast, columns=columns))
    return comparison_table(FAMILIES, rows)


class OverFamilies(NamedTuple):
    """How the difference of a comparison varies over families."""

    alike: float  # mean of the families' means
    alike_low: float  # its 95% interval for these families
    alike_high: float
    sample_low: float  # the one for a sample of such families
    sample_high: float
    without_low: float  # lowest and highest mean without one of the families
    without_high: float
    spread: float  # standard deviation between families
    p_families: float  # holds with `MIN_IN_FAMILY` episodes of each family or more


def over_families(
    values: Floats, labels: NDArray[np.int64], key: str, draws: int = DRAWS
) -> list[OverFamilies]:
    """Return, for each comparison, how its difference varies over families.

    Intervals are NaN if fewer than ten episodes differ. `values` are second − first of each
    episode, NaN where not both count, `(E, K)`; `labels` are the families, `(E,)`; `key` seeds the
    draws. Unknown families and episodes take no part in any draw.

    With the mean mᶠ and the variance sᶠ² of a family's nᶠ differences, the standard deviation
    between families is that of the means less their noise: √max(0, var(mᶠ) − mean(sᶠ² / nᶠ)).

    The test: Σ nᶠ mᶠ² − (Σ nᶠ mᶠ)² / n grows with the differences between families. Its
    distribution without any comes from random signs of the residuals (d − mᶠ) √(nᶠ / (nᶠ − 1)), so
    that families may differ in how often their outcomes flip; the observed value counts as one of
    the draws.

    Source: Davison and Hinkley (1997), Bootstrap Methods and their Application, section 3.8 (draws
    of clusters, then within them); Wu (1986), Annals of Statistics 14, 1261–1295 (signs of
    residuals); the deviation between groups: Searle (1971), Linear Models, chapter 9.
    """
    masks, place = np.unique(~np.isnan(values), axis=1, return_inverse=True)
    by_column: dict[int, OverFamilies] = {}
    # Most comparisons lack the same episodes, or none: each distinct set is drawn from once.
    for at, known in enumerate(masks.T):
        columns = np.flatnonzero(place == at)
        estimates = _over(values[np.ix_(known, columns)], labels[known], key, draws)
        by_column |= zip(columns.tolist(), estimates, strict=True)
    return [by_column[column] for column in range(values.shape[1])]


@dataclass(frozen=True)
class _ByFamily:
    """The differences of episodes, `(E, K)`, those of a family in consecutive rows."""

    values: Floats
    starts: NDArray[np.int64]  # the first row of each family, (F,)

    @classmethod
    def of(cls, values: Floats, labels: NDArray[np.int64]) -> Self:
        """Sort episodes by the label of their family."""
        order = np.argsort(labels, kind="stable")
        return cls(values[order], np.flatnonzero(np.diff(labels[order], prepend=-1)))

    @property
    def sizes(self) -> NDArray[np.int64]:
        """Episodes of each family, `(F, 1)`."""
        return np.diff(self.starts, append=len(self.values))[:, None]

    @property
    def means(self) -> Floats:
        """Means of families, `(F, K)`."""
        return self.sums(self.values) / self.sizes

    @property
    def residuals(self) -> Floats:
        """Differences from the mean of their family, `(E, K)`."""
        return self.values - self.means.repeat(self.sizes[:, 0], axis=0)

    @property
    def parts(self) -> list[Floats]:
        """The rows of each family."""
        return np.split(self.values, self.starts[1:])

    def sums(self, rows: Floats) -> Floats:
        """Return the sums over each family of values by episode, `(F, K)`."""
        return np.add.reduceat(rows, self.starts, axis=0)


def _over(
    values: Floats, labels: NDArray[np.int64], key: str, draws: int
) -> Iterator[OverFamilies]:
    """Yield what `over_families` returns, for values without NaN."""
    families = _ByFamily.of(values, labels)
    generator = generator_of(f"{key}, families")
    p = _p_families(families, generator, draws)
    fixed, sampled = _bootstrap(families, generator, draws)
    means, count = families.means, len(families.starts)
    alike, without = means.mean(axis=0), (means.sum(axis=0) - means) / (count - 1)
    spread = _spread(families)
    for n, column in enumerate(families.values.T):
        enough = varies_enough(column)
        alike_low, alike_high = fixed[:, n].tolist() if enough else (math.nan, math.nan)
        sample_low, sample_high = sampled[:, n].tolist() if enough else (math.nan, math.nan)
        yield OverFamilies(
            alike=float(alike[n]),
            alike_low=alike_low,
            alike_high=alike_high,
            sample_low=sample_low,
            sample_high=sample_high,
            without_low=float(without[:, n].min()),
            without_high=float(without[:, n].max()),
            spread=float(spread[n]),
            p_families=float(p[n]),
        )


def _spread(families: _ByFamily) -> Floats:
    """Return the standard deviation between families, without the noise of episodes, `(K,)`."""
    variances = families.sums(families.residuals**2) / np.maximum(1, families.sizes - 1)
    noise = (variances / families.sizes).mean(axis=0)
    return np.asarray(np.sqrt(np.maximum(0, families.means.var(axis=0, ddof=1) - noise)))


def _p_families(families: _ByFamily, generator: np.random.Generator, draws: int) -> Floats:
    """Return p of equal differences in all families, `(K,)`."""
    sizes, episodes = families.sizes, len(families.values)
    # Residuals vary less than the differences do, in small families most.
    scale = np.sqrt(sizes / np.maximum(1, sizes - 1))
    residuals = families.residuals * scale.repeat(sizes[:, 0], axis=0)
    signs = 1.0 - 2 * generator.integers(0, 2, (draws, episodes), np.uint8)
    ends = [*families.starts.tolist(), episodes]
    flipped = np.stack([signs[:, a:b] @ residuals[a:b] for a, b in pairwise(ends)], axis=1)

    def variation(sums: Floats) -> Floats:
        """Return the variation between families of their sums, `(…, F, K)`."""
        whole = sums.sum(axis=-2) ** 2 / episodes
        return np.asarray(((sums * sums / sizes).sum(axis=-2) - whole).round(9))

    reached = (variation(flipped) >= variation(families.means * sizes)).sum(axis=0)
    return np.asarray((1 + reached) / (1 + draws))


def _bootstrap(
    families: _ByFamily, generator: np.random.Generator, draws: int
) -> tuple[Floats, Floats]:
    """Return the 95% intervals of the mean of families, `(2, K)`: for these, and for a sample."""
    count = len(families.starts)
    taken = generator.multinomial(count, np.full(count, 1 / count), draws)
    intervals = []
    # Each family once, for just these families; then as often as drawn, for a sample of families.
    for often in (np.ones_like(taken), taken):
        drawn = sum(
            _resampled(part, often[:, n], generator) for n, part in enumerate(families.parts)
        )
        intervals.append(np.quantile(drawn / count, (0.025, 0.975), axis=0))
    return intervals[0], intervals[1]


def _resampled(values: Floats, often: NDArray[np.int64], generator: np.random.Generator) -> Floats:
    """Return the sums of `often` resampled means of a family's `(N, K)` values, `(D, K)`."""
    rows, counts = np.unique(values, axis=0, return_counts=True)
    drawn = generator.multinomial(often * len(values), counts / len(values))
    return np.asarray(drawn @ rows / len(values))
