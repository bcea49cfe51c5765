"""Comparisons family by family, whether families differ, and intervals beyond these nine."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

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

from .contrast import Contrast
from .pairs import pair
from .tables import CELLS, TableSpec, comparison_table

DRAWS = 2000
"""Random signs, and draws of families and episodes."""

_TABLES = ("lift", "effects", "interference")


def family_effects(outcomes: Outcomes, contrasts: Sequence[Contrast]) -> Iterator[Contrast]:
    """Yield each comparison of conditions again, in each family alone."""
    parts = {name: outcomes.of_family(name) for name in outcomes.families}
    wrong = outcomes.missing | outcomes.other
    for one in _of(outcomes, contrasts):
        cells = [outcomes.cell(*one.against), outcomes.cell(one.system, one.condition)]
        for name, here in parts.items():
            pairs = pair(*(outcomes.status[cell][here] for cell in cells))
            if pairs.n:
                names = (one.simulator, one.system, one.condition, one.against)
                whole = not any(wrong[cell][here].any() for cell in cells)
                yield Contrast(*names, "family_effects", pairs, whole, family=name)


_SPEC = TableSpec(
    "Effects over families",
    f"{CELLS} n families:count difference alike:points alike_low:points alike_high:points "
    "without_low:points without_high:points spread:points sample_low:points sample_high:points "
    "p_families:p p_families_holm:p complete",
    "difference: over all episodes, as in the other tables. alike: the mean of the families' own "
    "differences. alike low to alike high: its 95% bootstrap interval for these families, with "
    "episodes drawn within each. without low to without high: the lowest and the highest mean if "
    "one family is left out. spread: the standard deviation of the true differences of families, "
    "estimated without the noise of their episodes. sample low to sample high: as alike low and "
    "alike high, with families drawn too, as a sample of such families: for tasks beyond these, "
    "much wider, and with so few families still "
    f"too narrow. Both from {DRAWS:,} draws, if at least {MIN_EPISODES} episodes differ. "
    "p families: a test of whether the difference varies between families, by "
    f"{DRAWS:,} random sign flips of the differences from their family's mean; p families holm: "
    "after Holm's correction within a simulator.",
    power=False,
)
_COLUMNS = (
    *("alike", "alike_low", "alike_high", "sample_low", "sample_high"),
    *("without_low", "without_high", "spread", "p_families"),
)


def families_table(every: Iterable[Outcomes], contrasts: Sequence[Contrast]) -> Table:
    """Return each comparison with equally weighted families, and whether it varies over them."""
    rows = list[Contrast]()
    for outcomes in every:
        labels = outcomes.family
        found = []
        for one in _of(outcomes, contrasts):
            sides = (one.against, (one.system, one.condition))
            before, after = (success(outcomes.status[outcomes.cell(*side)]) for side in sides)
            families = {*labels[~np.isnan(after - before)].tolist()}
            if len(families) > 1:
                found.append((one, after - before, len(families)))
        if not found:
            continue
        values = np.stack([differences for _, differences, _ in found], axis=1)
        numbers = over_families(values, labels, outcomes.simulator)
        holms = holm([p for *_, p in numbers])
        for (one, _, count), estimates, p_holm in zip(found, numbers, holms, strict=True):
            ps = {"p_families": estimates[-1], "p_families_holm": p_holm}
            more = {"families": count, **dict(zip(_COLUMNS, estimates, strict=True)), **ps}
            rows.append(replace(one, table="families", more=more))
    return comparison_table("families", rows, _SPEC)


def _of(outcomes: Outcomes, contrasts: Iterable[Contrast]) -> list[Contrast]:
    return [
        one for one in contrasts if one.simulator == outcomes.simulator and one.table in _TABLES
    ]


def over_families(
    values: Floats, labels: NDArray[np.int64], key: str, draws: int = DRAWS
) -> list[tuple[float, ...]]:
    """Return, for each comparison, how its difference varies over families.

    In the order of `_COLUMNS`: the mean of the families' means, its 95% interval for these
    families, the one for a sample of such families (NaN if fewer than ten episodes differ), the
    lowest and the highest mean without one of the families, the standard deviation between
    families, and p. `values` are second − first of each episode, NaN where not both count, `(E,
    K)`; `labels` are the families, `(E,)`; `key` seeds the draws. Unknown families and episodes
    take no part in any draw.

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
    found: list[tuple[float, ...]] = [()] * values.shape[1]
    # Most comparisons lack the same episodes, or none: each distinct set is drawn from once.
    for at, known in enumerate(masks.T):
        columns = np.flatnonzero(place == at)
        estimates = _over(values[np.ix_(known, columns)], labels[known], key, draws)
        for column, one in zip(columns.tolist(), estimates, strict=True):
            found[column] = one
    return found


def _over(
    values: Floats, labels: NDArray[np.int64], key: str, draws: int
) -> Iterator[tuple[float, ...]]:
    """Yield what `over_families` returns, for values without NaN."""
    order = np.argsort(labels, kind="stable")
    labels, values = labels[order], values[order]
    starts = np.flatnonzero(np.diff(labels, prepend=-1))
    sizes = np.diff(starts, append=len(labels))[:, None]
    generator = generator_of(f"{key}, families")

    means = np.add.reduceat(values, starts, axis=0) / sizes
    residuals = values - means.repeat(sizes[:, 0], axis=0)
    noise = np.add.reduceat(residuals**2, starts, axis=0) / np.maximum(1, sizes - 1) / sizes
    count, spread = len(starts), np.sqrt(np.maximum(0, means.var(axis=0, ddof=1) - noise.mean(0)))

    def variation(sums: Floats) -> Floats:
        """Return the variation between families of their sums, `(…, F, K)`."""
        whole = sums.sum(axis=-2) ** 2 / len(values)
        return np.asarray(((sums * sums / sizes).sum(axis=-2) - whole).round(9))

    residuals *= np.sqrt(sizes / np.maximum(1, sizes - 1)).repeat(sizes[:, 0], axis=0)
    signs = 1.0 - 2 * generator.integers(0, 2, (draws, len(values)), np.uint8)
    ends = [*starts.tolist(), len(values)]
    sums = np.stack([signs[:, a:b] @ residuals[a:b] for a, b in pairwise(ends)], axis=1)
    reached = (variation(sums) >= variation(means * sizes)).sum(axis=0)
    p = (1 + reached) / (1 + draws)

    alike = means.mean(axis=0)
    without = (means.sum(axis=0) - means) / (count - 1)
    taken = generator.multinomial(len(starts), np.full(len(starts), 1 / len(starts)), draws)
    parts, intervals = np.split(values, starts[1:]), []
    for often in (np.ones_like(taken), taken):
        drawn = sum(_resampled(part, often[:, n], generator) for n, part in enumerate(parts))
        intervals.append(np.quantile(drawn / len(starts), (0.025, 0.975), axis=0))
    for n, column in enumerate(values.T):
        bounds = np.concatenate(intervals)[:, n].tolist()
        yield (
            float(alike[n]),
            *(bounds if varies_enough(column) else [math.nan] * len(bounds)),
            *(float(bound) for bound in (without[:, n].min(), without[:, n].max())),
            float(spread[n]),
            float(p[n]),
        )


def _resampled(values: Floats, often: NDArray[np.int64], generator: np.random.Generator) -> Floats:
    """Return the sums of `often` resampled means of a family's `(N, K)` values, `(D, K)`."""
    rows, counts = np.unique(values, axis=0, return_counts=True)
    drawn = generator.multinomial(often * len(values), counts / len(values))
    return np.asarray(drawn @ rows / len(values))
