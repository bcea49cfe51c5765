"""Which of two systems falls faster over k."""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, partial
from itertools import combinations
from typing import NamedTuple

import numpy as np

from robomme_interference_data.evaluate.score.outcomes import ERROR, Outcomes
from robomme_interference_data.evaluate.score.partners import share_weights
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.stats.bootstrap import DRAWS, Floats
from robomme_interference_data.stats.runs import RunSpread, independent, run_spread
from robomme_interference_data.stats.signs import sign_flips
from robomme_interference_data.viz.tables import Table

from .comparison import ComparisonTable, comparison_table
from .contrast import Contrast, Effect
from .decay import (
    Falls,
    all_complete,
    falls_of,
    fit_over_runs,
    fits,
    shared_ks,
    spreads_along,
    statuses_of,
)
from .pairs import Pairs, add_runs, shared_runs

INTERACTION = ComparisonTable(
    name="interaction",
    title="Which system falls faster",
    columns={
        "simulator": "text",
        "system": "text",
        "against_system": "text",
        "conditions": "text",
        "n": "count",
        "runs": "count",
        "scope": "text",
        "slope": "points",
        "against_slope": "points",
        "difference": "points",
        "low": "points",
        "high": "points",
        "if_failures": "points",
        "if_successes": "points",
        "gained": "count",
        "lost": "count",
        "p": "p",
        "p_holm": "p",
        "joint_low": "points",
        "joint_high": "points",
        "verdict": "text",
        "p_fit": "p",
        "primary": "flag",
        "complete": "flag",
    },
    note=(
        "slope: change of the success rate per doubling of the sessions (least-squares line over "
        "log2(k + 1) of all conditions listed); difference: between the two slopes, positive if "
        "the system falls more slowly than the other one. Each pair of systems once; those whose "
        "histories may differ are left out. Over the n episodes that count in all cells; gained "
        "and lost: episodes whose own slope is higher or lower than the other system's. p: "
        "sign-flip test of the episodes' differences; low to high: the 95% interval of all "
        "differences that this test does not reject, if at least ten episodes differ. p fit: "
        "whether the difference between the two rates departs from a line over log2(k + 1), by "
        "sign flips, not corrected."
    ),
    corrected=(
        "the tests of the primary analysis: these, and k7 against k0 of each system, in effects"
    ),
    explain=False,
)


def interaction_table(contrasts: Iterable[Contrast]) -> Table:
    """Return the falls of two systems compared, among some comparisons."""
    return comparison_table(INTERACTION, [c for c in contrasts if c.effect is Effect.SLOPES])


def interactions_of(outcomes: Outcomes, draws: int = DRAWS) -> list[Contrast]:
    """Compare how fast each pair of systems falls over all `k<n>` that both have.

    Each pair is tested once. Systems whose histories may differ are left out, and so are
    references.
    """
    contrasts = _interactions(outcomes, draws)
    if not (outcomes.status == ERROR).any():
        return contrasts
    failures, successes = (
        # With more that counts, there can be further pairs of systems.
        {(other.system, other.against): other.pairs for other in _interactions(changed, draws)}
        for changed in map(outcomes.with_errors_as, (Status.FAIL, Status.SUCCESS))
    )
    for place, contrast in enumerate(contrasts):
        key = contrast.system, contrast.against
        pairs = replace(contrast.pairs, if_failures=failures[key], if_successes=successes[key])
        contrasts[place] = replace(contrast, pairs=pairs)
    return contrasts


class _Apart(NamedTuple):
    """The falls of two systems under shared conditions."""

    system: str
    other: str
    conditions: list[str]
    first: Falls  # of the other one
    second: Falls
    related: bool  # whether equal training runs of both are the same weights

    @property
    def change(self) -> Floats:
        """The differences of slopes by episode, `(E,)`."""
        return (self.second.slopes - self.first.slopes).round(12)

    @property
    def spread(self) -> RunSpread:
        """The spread of the difference over training runs."""
        first, second = self.first.by_run, self.second.by_run
        if self.related and first.shape == second.shape:
            return run_spread(second - first)
        return independent(run_spread(first), run_spread(second))

    @property
    def residual_spreads(self) -> list[RunSpread]:
        """The same along each direction in which the difference can depart from a line."""
        first, second = self.first.residuals, self.second.residuals
        if self.related and first.shape == second.shape:
            return spreads_along(second - first)
        return [
            independent(*both)
            for both in zip(spreads_along(first), spreads_along(second), strict=True)
        ]


_FallsOf = Callable[[str, tuple[str, ...], tuple[bool, ...]], Falls]
"""From a system, conditions, and which repeats are used, to the system's falls."""


def _falls(
    outcomes: Outcomes, system: str, conditions: tuple[str, ...], repeats: tuple[bool, ...]
) -> Falls:
    used = np.array(repeats)
    status = statuses_of(outcomes, system, conditions)[..., used]
    return falls_of(status, outcomes.training[used], conditions)


def _apart(outcomes: Outcomes, falls: _FallsOf, system: str, other: str) -> _Apart | None:
    """Return the falls of two systems; None if they are not compared."""
    conditions = shared_ks(outcomes, system, other)
    if not conditions or not outcomes.pairable(system, other):
        return None
    first, second = (statuses_of(outcomes, name, conditions) for name in (other, system))
    related = share_weights(outcomes, system, other)
    training = outcomes.training
    if related:
        both = [shared_runs([*first, *second], training)] * 2
    else:
        both = [shared_runs([*side], training) for side in (first, second)]
    if not all(runs.any() for runs in both):
        return None
    of_other, of_system = (
        falls(name, tuple(conditions), tuple(runs.tolist()))
        for name, runs in zip((other, system), both, strict=True)
    )
    return _Apart(system, other, conditions, of_other, of_system, related)


def _interactions(outcomes: Outcomes, draws: int) -> list[Contrast]:
    systems = [name for name in outcomes.systems if not outcomes.is_reference(name)]
    # A system is in many pairs.
    falls = cache(partial(_falls, outcomes))
    every = [_apart(outcomes, falls, *both) for both in combinations(systems, 2)]
    compared = [apart for apart in every if apart is not None]
    if not compared:
        return []
    key = outcomes.simulator
    tests = sign_flips(np.stack([apart.change for apart in compared], axis=1), key, draws)
    differences = [apart.second.success - apart.first.success for apart in compared]
    p_fits = fits(differences, [apart.conditions for apart in compared], key, draws)
    contrasts = []
    for apart, test, p_fit in zip(compared, tests, p_fits, strict=True):
        known = ~np.isnan(apart.change)
        n = int(known.sum())
        pairs = Pairs(
            n=n,
            first=float(apart.first.slopes[known].mean()) if n else math.nan,
            second=float(apart.second.slopes[known].mean()) if n else math.nan,
            at=test.at,
            method="sign-flip" if n else "",
            pairs=n,
            gained=int((apart.change > 0).sum()),
            lost=int((apart.change < 0).sum()),
            p=test.p,
        )
        residuals = (apart.second.residuals.mean(axis=1) - apart.first.residuals.mean(axis=1))[
            :, None
        ]
        contrasts.append(
            Contrast(
                key,
                apart.system,
                apart.conditions[-1],
                (apart.other, apart.conditions[-1]),
                Effect.SLOPES,
                add_runs(pairs, apart.spread),
                all_complete(outcomes, [apart.system, apart.other], apart.conditions),
                columns={
                    "conditions": " ".join(apart.conditions),
                    "slope": pairs.second,
                    "against_slope": pairs.first,
                    "p_fit": fit_over_runs(p_fit, apart.residual_spreads, residuals, key),
                },
            )
        )
    return contrasts
