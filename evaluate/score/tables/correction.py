"""Which comparisons are corrected together, and what each of them then shows.

A comparison has one corrected p-value, whichever table or sentence shows it.
"""

import math
from collections import Counter
from collections.abc import Hashable, Iterable, Sequence
from dataclasses import replace

from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.significance import ALPHA, holm

from .contrast import Contrast, Effect, Verdict
from .pairs import Pairs

PRIMARY_CONDITION = "k7"
"""The condition of the primary analysis; the one with the most sessions if it was not run."""

PRIMARY_GROUP = "primary"

NULL_FINDINGS = "26% (95% interval 20 to 32%) of simulated reports of three systems"
"""Reports without any effect that hold a finding in some table: see benchmarks/null_scores.py."""


def with_primary(contrasts: Sequence[Contrast], all_outcomes: Iterable[Outcomes]) -> list[Contrast]:
    """Return comparisons with the primary ones marked, which are corrected together.

    Primary are, in each simulator, k7 against k0 of each system that is no reference, and the
    differences between the falls of two systems.
    """
    compared = {
        (outcomes.simulator, system)
        for outcomes in all_outcomes
        for system in outcomes.systems
        if not outcomes.is_reference(system)
    }
    conditions: dict[tuple[str, str], list[str]] = {}
    for contrast in contrasts:
        cell = (contrast.simulator, contrast.system)
        if contrast.effect is Effect.SESSIONS and cell in compared:
            conditions.setdefault(cell, []).append(contrast.condition)
    latest = {cell: _primary_condition(names) for cell, names in conditions.items()}
    marked = []
    for contrast in contrasts:
        is_fall = (
            contrast.effect is Effect.SESSIONS
            and latest.get((contrast.simulator, contrast.system)) == contrast.condition
        )
        is_primary = is_fall or contrast.effect is Effect.SLOPES
        group = PRIMARY_GROUP if is_primary else contrast.group
        marked.append(replace(contrast, primary=is_primary, group=group))
    return marked


def _primary_condition(names: Sequence[str]) -> str:
    if PRIMARY_CONDITION in names:
        return PRIMARY_CONDITION
    return max(names, key=lambda name: parse_condition(name).k)


def primary_falls(contrasts: Iterable[Contrast], simulator: str) -> list[Contrast]:
    """Return the primary fall of each system in a simulator."""
    return [
        contrast
        for contrast in contrasts
        if contrast.simulator == simulator
        and contrast.primary
        and contrast.effect is Effect.SESSIONS
    ]


def correct(contrasts: Iterable[Contrast], alpha: float = ALPHA) -> list[Contrast]:
    """Return comparisons with p-values corrected by Holm within their group and simulator.

    The verdict is that of the corrected p-value, unless it would be another one if all errors of
    the comparisons were failures, or all successes.
    """
    contrasts = list(contrasts)
    groups = [(contrast.simulator, contrast.group) for contrast in contrasts]
    sizes = Counter(groups)
    ps = corrected([contrast.pairs.p for contrast in contrasts], groups)
    if_failures = corrected([_p(c.pairs, c.pairs.if_failures) for c in contrasts], groups)
    if_successes = corrected([_p(c.pairs, c.pairs.if_successes) for c in contrasts], groups)
    return [
        replace(contrast, tests=sizes[group], p_holm=p, verdict=verdict_of(p, possible, alpha))
        for contrast, group, p, *possible in zip(
            contrasts, groups, ps, if_failures, if_successes, strict=True
        )
    ]


def _p(pairs: Pairs, imputed: Pairs | None) -> float:
    return pairs.p if imputed is None else imputed.p


def corrected(p_values: Sequence[float], groups: Sequence[Hashable]) -> list[float]:
    """Return p-values after Holm's correction within each group."""
    places: dict[Hashable, list[int]] = {}
    for place, group in enumerate(groups):
        places.setdefault(group, []).append(place)
    adjusted = [math.nan] * len(p_values)
    for here in places.values():
        for place, p in zip(here, holm([p_values[at] for at in here]), strict=True):
            adjusted[place] = p
    return adjusted


def verdict_of(p: float, possible: Iterable[float], alpha: float = ALPHA) -> Verdict | None:
    """Return what a corrected p-value shows; `possible` are those if errors had outcomes.

    None without a p-value.
    """
    if math.isnan(p):
        return None
    # Errors may not be random: a finding that depends on them is none.
    if any((other < alpha) != (p < alpha) for other in possible):
        return Verdict.DEPENDS
    return Verdict.SHOWN if p < alpha else Verdict.NOT_SHOWN
