"""The tables of effects: lift, contrasts, decay and noise."""

import math
from collections.abc import Iterable, Sequence

from robomme_interference_data.bootstrap import LEAST
from robomme_interference_data.evaluate.score.effects import SURE, Contrast, Effects
from robomme_interference_data.evaluate.score.outcomes import SUCCESS, Outcomes
from robomme_interference_data.evaluate.score.paired import COLUMNS, note_of
from robomme_interference_data.evaluate.score.statistics import cohens_h, flip_rate, holm
from robomme_interference_data.tables import Column, Table

__all__ = ["contrast_table", "decay_table", "lift_table", "noise_table"]

_CELL = (Column("simulator"), Column("system"), Column("condition"))


def lift_table(effects: Iterable[Effects]) -> Table:
    """Return each condition's lift over the system's own rate without history."""
    found = [contrast for one in effects for contrast in one.lift]
    columns = (
        *_CELL,
        *(Column("no_history_of"), Column("n", "count")),
        *(Column("rate", "rate"), Column("no_history_rate", "rate"), Column("lift", "points")),
        *COLUMNS,
        *(Column("retention", "ratio"), Column("retention_low", "ratio")),
        *(Column("retention_high", "ratio"), Column("complete", "flag")),
    )
    rows = [
        (
            *(c.simulator, c.system, c.condition, c.against[0], c.n, c.rate, c.against_rate),
            *_tested(c, p),
            *(c.retention.value, c.retention.low, c.retention.high, c.complete),
        )
        for c, p in zip(found, holm([c.test.p for c in found]), strict=True)
    ]
    note = (
        f"{_note(found)} retention: lift divided by the lift at k0, where that one is above zero "
        f"with p < {SURE}; its BCa interval, where any two of no-history, k0 and the condition "
        f"differ in at least {LEAST} episodes. A system with retrieval is, without history, the "
        "system without it."
    )
    return Table("lift", "Lift over no history", columns, tuple(rows), note)


def contrast_table(effects: Iterable[Effects]) -> Table:
    """Return effect sizes between conditions, and of retrieval."""
    found = [contrast for one in effects for contrast in one.contrasts]
    columns = (
        *_CELL,
        *(Column("against_system"), Column("against_condition"), Column("n", "count")),
        *(Column("rate", "rate"), Column("against_rate", "rate"), Column("difference", "points")),
        *COLUMNS,
        *(Column("cohens_h", "ratio"), Column("complete", "flag")),
    )
    rows = [
        (
            *(c.simulator, c.system, c.condition, *c.against, c.n, c.rate, c.against_rate),
            *_tested(c, p),
            cohens_h(c.rate, c.against_rate) if c.n else math.nan,
            c.complete,
        )
        for c, p in zip(found, holm([c.test.p for c in found]), strict=True)
    ]
    return Table("effects", "Effects between conditions", columns, tuple(rows), _note(found))


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
        f"clustered by episode, where at least {LEAST} episodes add to the slope."
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
            pair = pair[:, (pair >= 0).all(axis=0)] == SUCCESS
            if pair.size:
                rows.append(
                    (one.simulator, one.system, condition, pair.shape[1], *flip_rate(*pair))
                )
    note = (
        "Repeats differ in the model seed alone; in each episode the two lowest that count are "
        "compared. A share of flips between conditions (flips in the tables of effects) that is "
        "not above this rate is noise. A flip rate is gross, a difference is net, gained less "
        "lost: one that is smaller than this rate can still be real, and p tells."
    )
    return Table("noise", "Flips between repeats", columns, tuple(rows), note)


def _tested(contrast: Contrast, corrected: float) -> tuple[float | str, ...]:
    change = contrast.change
    test = contrast.test
    numbers = (test.pairs, test.gained, test.lost, test.flips, test.p, corrected)
    return (change.value, change.low, change.high, contrast.interval, *numbers)


def _note(contrasts: Sequence[Contrast]) -> str:
    counts = [(contrast.n, contrast.test.pairs) for contrast in contrasts]
    return f"Over the n episodes that count on both sides. {note_of(counts)}"
