"""How many steps successes take, and whether they take longer with more sessions."""

import math
from collections.abc import Iterable

import numpy as np

from robomme_interference_data.evaluate.score.comparisons.contrast import START
from robomme_interference_data.evaluate.score.comparisons.tables import tested
from robomme_interference_data.evaluate.score.outcomes import Outcomes, steps_to_success
from robomme_interference_data.stats.bootstrap import DRAWS, Interval
from robomme_interference_data.stats.signs import SignFlips, sign_flips
from robomme_interference_data.viz.tables import Table


def steps_table(every: Iterable[Outcomes], draws: int = DRAWS) -> Table:
    """Return the steps to success of each cell, compared with the same system's k0."""
    rows = [row for outcomes in every for row in _rows(outcomes, draws)]
    return tested(
        "steps",
        "Steps to success",
        "simulator system condition n:count median:ratio mean:ratio pairs:count "
        "difference:ratio low:ratio high:ratio p:p p_holm:p complete:flag",
        rows,
        f"Over the n episodes that succeed. difference: mean steps minus those under {START}, over "
        "the pairs: episodes that succeed under both conditions. Episodes that only one of them "
        "solves are not compared, so an effect on them shows in the rates alone. low to high and "
        "p: sign flips of the episodes' differences, if at least ten differ; p holm: after Holm's "
        "correction among the tests of this table in one simulator.",
    )


def _rows(outcomes: Outcomes, draws: int) -> list[tuple[object, ...]]:
    steps = steps_to_success(outcomes.status, outcomes.steps)
    cells = np.argwhere(~np.isnan(steps).all(axis=-1)).tolist()
    if not cells or not np.nanmax(steps):  # answers to questions take none
        return []
    start = outcomes.conditions.index(START) if START in outcomes.conditions else None
    compared = [(s, c) for s, c in cells if start is not None and c != start]
    changes = [steps[s, c] - steps[s, start] for s, c in compared]
    tests = dict[tuple[int, int], SignFlips]()
    if changes:
        flips = sign_flips(np.stack(changes, axis=1), outcomes.simulator, draws)
        tests = dict(zip(compared, flips, strict=True))
    rows = list[tuple[object, ...]]()
    for s, c in cells:
        known = steps[s, c][~np.isnan(steps[s, c])]
        names = (outcomes.simulator, outcomes.systems[s], outcomes.conditions[c])
        own = (len(known), float(np.median(known)), float(known.mean()))
        test, whole = tests.get((s, c)), bool(outcomes.complete[s, c])
        if test is None:
            rows.append((*names, *own, None, *Interval(math.nan), math.nan, whole))
            continue
        whole = whole and bool(outcomes.complete[s, start])
        pairs = int((~np.isnan(steps[s, c] - steps[s, start])).sum())
        rows.append((*names, *own, pairs, *test.at(), test.p, whole))
    return rows
