"""Comparisons family by family, whether families differ, and what is said beyond these nine."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.bootstrap import LEAST, Floats, enough, generator_of
from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.contrasts import Contrast
from robomme_interference_data.evaluate.score.cube import Cube, Flags, success
from robomme_interference_data.evaluate.score.pairs import (
    COLUMNS,
    corrected,
    how_to_read,
    pair,
    tested,
)
from robomme_interference_data.tables import Provisional, Table

DRAWS = 2000
"""Permutations, and draws of families and episodes."""

_TABLES = ("lift", "effects", "interference")


def family_effects_table(cubes: Iterable[Cube], contrasts: Sequence[Contrast]) -> Table:
    """Return each comparison of conditions in each family."""
    own, tests = [], []
    for cube in cubes:
        parts = {name: cube.of_family(name) for name in FAMILIES}
        for one in _of(cube, contrasts):
            cells = [cube.cell(*one.against), cube.cell(one.system, one.condition)]
            for name, here in parts.items():
                pairs = pair(*(cube.status[cell][here] for cell in cells))
                if pairs.n:
                    whole = not any((cube.missing | cube.other)[c][here].any() for c in cells)
                    names = (cube.simulator, one.system, one.condition, *one.against, name)
                    own.append((*names, pairs.n, pairs.second, pairs.first))
                    tests.append((pairs, cube.simulator, whole))
    rows = (
        (*names, *test, complete)
        for names, test, (_, _, complete) in zip(own, tested(tests), tests, strict=True)
    )
    return Table.make(
        "family_effects",
        "Effects by family",
        "simulator system condition against_system against_condition family n:count rate:rate "
        f"against_rate:rate difference:points {COLUMNS} complete:flag",
        rows,
        "The lifts, effects and kinds of interference of the tables of those names, in each family "
        "alone, over the n episodes that count on both sides. "
        + how_to_read(tests, "the tests of this table in one simulator"),
    )


def families_table(cubes: Iterable[Cube], contrasts: Sequence[Contrast]) -> Table:
    """Return each comparison with families weighing alike, and whether it differs over them."""
    rows = []
    for cube in cubes:
        found = _of(cube, contrasts)
        labels = np.array([FAMILIES.index(one.family) for one in cube.episodes])
        values = [
            success(cube.status[cube.cell(one.system, one.condition)])
            - success(cube.status[cube.cell(*one.against)])
            for one in found
        ]
        shown = [n for n, one in enumerate(values) if len({*labels[~np.isnan(one)].tolist()}) > 1]
        if not shown:
            continue
        numbers = over_families(
            np.stack([values[n] for n in shown], axis=1), labels, cube.simulator
        )
        holms = corrected([float(p) for *_, p in numbers], [0] * len(shown))
        for n, (*told, p), p_holm in zip(shown, numbers, holms, strict=True):
            one, known = found[n], ~np.isnan(values[n])
            ps = [q if one.complete else Provisional(q) for q in (p, p_holm)]
            counts = (int(known.sum()), len({*labels[known].tolist()}))
            names = (cube.simulator, one.system, one.condition, *one.against)
            rows.append((*names, *counts, one.pairs.change.value, *told, *ps, one.complete))
    return Table.make(
        "families",
        "Effects over families",
        "simulator system condition against_system against_condition n:count families:count "
        "difference:points alike:points alike_low:points alike_high:points sample_low:points "
        "sample_high:points p_families:p p_families_holm:p complete:flag",
        rows,
        "difference: over all episodes, as in the other tables and the headline, which speak of "
        "these families as they are. alike: the mean of the families' own differences. alike_low "
        "to alike_high: 95% bootstrap interval of it for these families, episodes drawn within "
        "each. sample_low to sample_high: the same where families are drawn too, as a sample of "
        "such families: what holds for tasks beyond these, and much wider; of so few families "
        f"still too narrow. Both from {DRAWS:,} draws, where at least {LEAST} episodes differ. "
        "p_families: whether the difference is another one in other families, by a permutation "
        f"test of {DRAWS:,} draws; p_families_holm: corrected by Holm's method within a simulator.",
    )


def _of(cube: Cube, contrasts: Iterable[Contrast]) -> list[Contrast]:
    return [one for one in contrasts if one.simulator == cube.simulator and one.table in _TABLES]


def over_families(
    values: Floats, labels: NDArray[np.int64], key: str, draws: int = DRAWS
) -> list[tuple[float, ...]]:
    """Return what families have in common and what not, of several comparisons.

    The permutation test: with the sum Sᶠ of a family's nᶠ differences, Σ Sᶠ² / nᶠ is the larger the
    more families differ; p is the share of the draws that deal the episodes out to the families
    anew and reach the observed value, itself counted as one of them.

    Source: Davison and Hinkley (1997), Bootstrap Methods and their Application, sections 3.8 (draws
    of clusters, then within them) and 4.3 (permutations).

    Args:
        values: Second − first of each episode, NaN where not both count, `(E, K) float64`.
        labels: Number of each episode's family, `(E,) int64`.
        key: Text that seeds the draws.
        draws: Their number.

    Returns:
        Of each comparison: the mean of the families' means; its 95% interval for these families,
        and for a sample of such families, NaN where fewer than ten episodes differ; p.
    """
    order = np.argsort(labels, kind="stable")
    labels, values = labels[order], values[order]
    starts = np.flatnonzero(np.diff(labels, prepend=-1))
    known: Flags = ~np.isnan(values)
    # Most comparisons lack the same episodes, mostly none: each mask is summed once.
    masks, place = np.unique(known, axis=1, return_inverse=True)
    both = np.concatenate([np.where(known, values, 0.0), masks], axis=1)
    generator = generator_of(f"{key}, families")

    def apart(at: Floats) -> tuple[Floats, Floats]:
        return at[..., : len(place)], at[..., len(place) :][..., place]

    def spread(rows: Floats) -> Floats:
        sums, counts = apart(np.add.reduceat(rows, starts, axis=0))
        return np.asarray((sums * sums / np.maximum(counts, 1)).sum(axis=0).round(9))

    observed = spread(both)
    reached = sum(spread(generator.permutation(both)) >= observed for _ in range(draws))
    p = (1 + np.asarray(reached)) / (1 + draws)

    sums, counts = apart(np.add.reduceat(both, starts, axis=0))
    alike = _mean(sums[None], counts[None], np.ones((1, len(starts))))[0]
    taken = generator.multinomial(len(starts), np.full(len(starts), 1 / len(starts)), draws)
    intervals = []
    for often in (np.ones_like(taken), taken):
        drawn = [
            generator.multinomial(often[:, n] * len(part), np.full(len(part), 1 / len(part))) @ part
            for n, part in enumerate(np.split(both, starts[1:]))
        ]
        means = _mean(*apart(np.stack(drawn, axis=1)), often.astype(float))
        intervals.append(np.nanquantile(means, (0.025, 0.975), axis=0))
    return [
        (
            float(alike[n]),
            *(
                float(bound[n]) if enough(values[known[:, n], n]) else math.nan
                for bounds in intervals
                for bound in bounds
            ),
            float(p[n]),
        )
        for n in range(values.shape[1])
    ]


def _mean(sums: Floats, counts: Floats, weights: Floats) -> Floats:
    """Return the weighted mean of the families' means, `(D, K)`, of `(D, F, K)` and `(D, F)`.

    A family without an episode has no weight; NaN where none has any.
    """
    means = sums / np.maximum(counts, 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = np.einsum("dfk,df->dk", means, weights)
        return np.asarray(total / np.einsum("dfk,df->dk", counts > 0, weights))
