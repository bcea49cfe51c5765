"""The tables of effects: lift, contrasts, decay and noise."""

import math
from collections.abc import Iterable, Sequence

import numpy as np

from robomme_interference_data.evaluate.score.effects import Contrast, Effects
from robomme_interference_data.evaluate.score.outcomes import ERROR, SUCCESS, Outcomes
from robomme_interference_data.evaluate.score.statistics import cohens_h, flip_rate, holm
from robomme_interference_data.tables import Column, Table

__all__ = ["contrast_table", "decay_table", "lift_table", "noise_table"]

_CELL = (Column("simulator"), Column("system"), Column("condition"))
_TESTS = (
    *(Column("low", "points"), Column("high", "points")),
    *(Column("gained", "count"), Column("lost", "count")),
    *(Column("p", "p"), Column("p_holm", "p")),
)
_PAIRED = (
    "Over the n episodes that count on both sides. 95% intervals: BCa bootstrap, clustered by "
    "episode. gained and lost: episodes whose outcome differs; p: McNemar's exact test on them; "
    "p_holm: corrected for the number of tests in this table."
)


def lift_table(effects: Iterable[Effects]) -> Table:
    """Return each condition's lift over the system's own rate without history."""
    found = [contrast for one in effects for contrast in one.lift]
    columns = (
        *_CELL,
        *(Column("no_history_of"), Column("n", "count")),
        *(Column("rate", "rate"), Column("no_history_rate", "rate"), Column("lift", "points")),
        *_TESTS,
        *(Column("retention", "ratio"), Column("retention_low", "ratio")),
        *(Column("retention_high", "ratio"), Column("complete", "flag")),
    )
    rows = [
        (
            *(c.simulator, c.system, c.condition, c.against[0], c.n, c.rate, c.against_rate),
            *_tested(c, p),
            *(c.retention.value, c.retention.low, c.retention.high, c.complete),
        )
        for c, p in zip(found, _corrected(found), strict=True)
    ]
    note = (
        f"{_PAIRED} retention: lift divided by the lift at k0, where that one's interval is above "
        "zero. A system with retrieval is, without history, the system without it."
    )
    return Table("lift", "Lift over no history", columns, tuple(rows), note)


def contrast_table(effects: Iterable[Effects]) -> Table:
    """Return effect sizes between conditions, and of retrieval."""
    found = [contrast for one in effects for contrast in one.contrasts]
    columns = (
        *_CELL,
        *(Column("against_system"), Column("against_condition"), Column("n", "count")),
        *(Column("rate", "rate"), Column("against_rate", "rate"), Column("difference", "points")),
        *_TESTS,
        *(Column("cohens_h", "ratio"), Column("complete", "flag")),
    )
    rows = [
        (
            *(c.simulator, c.system, c.condition, *c.against, c.n, c.rate, c.against_rate),
            *_tested(c, p),
            cohens_h(c.rate, c.against_rate) if c.n else math.nan,
            c.complete,
        )
        for c, p in zip(found, _corrected(found), strict=True)
    ]
    return Table("effects", "Effects between conditions", columns, tuple(rows), _PAIRED)


def decay_table(outcomes: Sequence[Outcomes], effects: Sequence[Effects]) -> Table:
    """Return each system's log-linear decay over the sessions in the buffer."""
    columns = (
        *(Column("simulator"), Column("system"), Column("conditions"), Column("n", "count")),
        *(Column("slope", "points"), Column("low", "points"), Column("high", "points")),
        Column("complete", "flag"),
    )
    rows = [
        (
            *(one.simulator, one.system, " ".join(found.decay_conditions), found.decay_episodes),
            *(found.decay.value, found.decay.low, found.decay.high, found.decay_complete),
        )
        for one, found in zip(outcomes, effects, strict=True)
        if found.decay_conditions
    ]
    note = (
        "slope: change of the success rate with each doubling of the sessions in the buffer, the "
        "lesson included: the least-squares line over log2(k + 1). 95% BCa bootstrap interval, "
        "clustered by episode."
    )
    return Table("decay", "Decay over sessions", columns, tuple(rows), note)


def noise_table(outcomes: Iterable[Outcomes]) -> Table:
    """Return how often two repeats of the same rollout disagree, where there are repeats."""
    columns = (
        *_CELL,
        *(Column("pairs", "count"), Column("flips", "count")),
        *(Column("rate", "rate"), Column("low", "rate"), Column("high", "rate")),
    )
    rows = []
    for one in outcomes:
        for place, condition in enumerate(one.conditions):
            pair = one.repeats[:, place]
            both = np.isin(pair, (-1, ERROR), invert=True).all(axis=0)
            if both.any():
                numbers = flip_rate(*(pair[:, both] == SUCCESS))
                rows.append((one.simulator, one.system, condition, int(both.sum()), *numbers))
    note = (
        "Repeats differ in the model seed alone; the two lowest are compared. Differences between "
        "conditions below the flip rate are noise."
    )
    return Table("noise", "Flips between repeats", columns, tuple(rows), note)


def _tested(contrast: Contrast, corrected: float) -> tuple[float, ...]:
    change = contrast.change
    tests = (contrast.gained, contrast.lost, contrast.p, corrected)
    return (change.value, change.low, change.high, *tests)


def _corrected(contrasts: Sequence[Contrast]) -> list[float]:
    """Correct the p-values that there are; NaN stays."""
    known = [place for place, contrast in enumerate(contrasts) if not math.isnan(contrast.p)]
    adjusted = dict(zip(known, holm([contrasts[place].p for place in known]), strict=True))
    return [adjusted.get(place, math.nan) for place in range(len(contrasts))]
