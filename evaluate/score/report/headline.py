"""The main finding of each simulator's rows, in a few sentences."""

import math
from collections.abc import Sequence

from robomme_interference_data.evaluate.score.comparisons.contrast import START, Contrast
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.cells import Cell
from robomme_interference_data.evaluate.score.tables.equivalence import BEYOND, EQUIVALENT, OPEN
from robomme_interference_data.evaluate.systems import display_name, published_base
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.intervals import wilson
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.stats.signs import simultaneous
from robomme_interference_data.viz.tables import percent, points

from .offline import offline_headline
from .strongest import named, shown


def headline(score: Score, simulator: str) -> str:
    """Return the main finding of one simulator's rows, or of recordings.

    Only complete cells are compared. The leader has the highest rate at k0; systems that are not
    distinguishable from the best are named, and intervals and p-values are corrected for the choice
    of the leader. A reference leads only if there is no other system.
    """
    if score.recordings is not None and simulator == score.recordings.simulator:
        return offline_headline(score)
    found = [one for one in score.cells if one.simulator == simulator and not one.part]
    cells = [cell for cell in found if not cell.reference] or found
    complete = [cell for cell in cells if cell.complete]
    sentences = _leading(score, complete) if complete else [_nothing_complete(cells)]
    if not all(cell.complete for cell in found):
        done = sum(cell.complete for cell in found)
        sentences.append(f"{done} of {len(found)} cells are complete.")
    return " ".join(sentences)


def _leading(score: Score, complete: Sequence[Cell]) -> list[str]:
    """State the best rate at k0 and how far it falls, or else the best rate."""
    best = _best(complete, START) or _best(complete, _best(complete)[0].condition)
    leader = best[0]
    key = ("effects", leader.simulator, leader.system, (leader.system, START))
    falls = [
        c
        for c in score.contrasts
        if (c.table, c.simulator, c.system, c.against) == key and c.pairs.n
    ]
    rate = (
        f"In {leader.simulator}, {display_name(leader.system)} succeeds in {percent(leader.rate)} "
        f"of {leader.n} episodes "
    )
    interval = _chosen_interval(leader, complete)
    if leader.condition != START or not falls:
        first = f"{rate}under {named(leader.condition)} ({interval})."
        return [first, *_tied(complete, leader), *_hurting(score, leader)]
    fall = max(falls, key=lambda one: parse_condition(one.condition).k)
    first = f"{rate}if the history holds only the lesson ({START}, {interval}), "
    sentences = [first + _from_start(score, fall), *_tied(complete, leader)]
    if fall.complete:
        highest = _best(complete, fall.condition)[0]
        if highest.system != leader.system:
            highest_rate = f"{percent(highest.rate)}, of {display_name(highest.system)}"
            sentences.append(f"The highest rate at {fall.condition} is {highest_rate}.")
        sentences += _tied(complete, highest)
    sentences += _equal(score, fall) + _beside_base(score, fall)
    return sentences + _hurting(score, leader)


def _chosen_interval(leader: Cell, complete: Sequence[Cell]) -> str:
    """Return the interval of the leader's rate, corrected for its choice among all systems."""
    among = sum(cell.condition == leader.condition for cell in complete)
    level = simultaneous(among)
    low, high = wilson(leader.rate * leader.trials, leader.trials, level)
    chosen = f", corrected for the choice among {among} systems" * (among > 1)
    return f"95% interval {100 * low:.1f} to {100 * high:.1f}{chosen}"


def _tied(complete: Sequence[Cell], first: Cell) -> list[str]:
    """Name the other systems that are not distinguishable from the best of a condition."""
    cells = [c for c in complete if c.best and c.condition == first.condition and c is not first]
    if not cells:
        return []
    be = "is" if len(cells) == 1 else "are"
    names = f"{_listed(cells)} {be} not distinguishable from the best"
    return [f"Under {named(first.condition)}, {names}."]


def _listed(cells: Sequence[Cell]) -> str:
    *names, last = (display_name(cell.system) for cell in cells)
    return f"{', '.join(names)} and {last}" if names else last


def _nothing_complete(cells: Sequence[Cell]) -> str:
    counting = [cell for cell in cells if cell.n]
    if not counting:
        return f"In {cells[0].simulator}, no rollout counts yet."
    nearest = min(counting, key=lambda cell: (len(cell.missing) + len(cell.other), -cell.n))
    other = f", and {len(nearest.other)} are outside the grid" if nearest.other else ""
    return (
        f"In {nearest.simulator}, no cell is complete, so no system leads. The most complete is "
        f"{display_name(nearest.system)} under {named(nearest.condition)}: {len(nearest.missing)} "
        f"of {nearest.expected} episodes are missing{other}."
    )


def _from_start(score: Score, fall: Contrast) -> str:
    """State the leader's rate under a condition, and its fall among the falls of all systems."""
    key = (fall.simulator, fall.condition, "effects")
    falls = [
        one
        for one in score.contrasts
        if (one.simulator, one.condition, one.table) == key
        and one.against == (one.system, START)
        and (one is fall or one.complete)
        and not (score.is_reference(one.simulator, one.system) and one is not fall)
    ]
    k, pairs = parse_condition(fall.condition).k, fall.pairs
    sessions = "distractor session" + ("s" if k > 1 else "")
    over = "" if fall.complete else f", incomplete, over its {pairs.n} episodes"
    counts = f"{pairs.gained} episodes gained, {pairs.lost} lost"
    return (
        f"and in {percent(pairs.second)} with {k} {sessions} after it ({fall.condition}{over}): "
        f"{shown(fall, falls, 'the falls of {} systems', counts)}."
    )


def _hurting(score: Score, leader: Cell) -> list[str]:
    """Name the largest loss of the leader under conditions beyond the paper's."""
    key = ("interference", leader.simulator, leader.system)
    found = [c for c in score.contrasts if (c.table, c.simulator, c.system) == key and c.complete]
    worst = min(found, key=lambda one: one.pairs.change.value, default=None)
    if worst is None or worst.pairs.change.value >= 0:
        return []
    p = holm([one.pairs.p for one in found])[found.index(worst)]
    loss = "largest loss is by" if p < ALPHA else "largest loss, which is not significant, is by"
    return [
        f"Under the conditions beyond the paper's, its {loss} {worst.asks}: {worst.condition} "
        f"minus {named(worst.against[1])} is {shown(worst, found, '{} comparisons')}."
    ]


def _equal(score: Score, fall: Contrast) -> list[str]:
    """State whether the leader's rate under a condition is equivalent to that at k0."""
    if "equivalence" not in score.tables:
        return []
    sentences = []
    key = {"simulator": fall.simulator, "system": fall.system, "condition": fall.condition}
    for one in score.tables["equivalence"].records():
        if key.items() <= one.items() and one["against_condition"] == START:
            margin = f"{100 * one['margin']:g}"
            bounds = f"90% interval {points(one['low_90'])} to {points(one['high_90'])}"
            whose = "its own" if one["against_system"] == fall.system else ""
            whose = whose or f"{display_name(one['against_system'])}'s"
            whose += " published" * (one["against_rows"] == "published")
            shown = {
                EQUIVALENT: f"is equivalent to {whose} {START} within ±{margin} points",
                BEYOND: f"is more than {margin} points from {whose} {START}",
                OPEN: f"is not shown to be within ±{margin} points of {whose} {START}",
            }[one["verdict"].rstrip("†")]
            early = ", provisional" * one["verdict"].endswith("†")
            sentences.append(f"Its {fall.condition} {shown} ({bounds}{early}).")
    return sentences


def _beside_base(score: Score, contrast: Contrast) -> list[str]:
    """State the published fall of the system without retrieval."""
    base = published_base(contrast.system)
    key = (contrast.simulator, base)
    rates = {c.condition: c.rate for c in score.published if (c.simulator, c.system) == key}
    if not {START, contrast.condition} <= {*rates}:
        return []
    return [
        f"Without retrieval, {display_name(base or '')} falls from {percent(rates[START])} to "
        f"{percent(rates[contrast.condition])} (published)."
    ]


def _best(cells: Sequence[Cell], condition: str | None = None) -> list[Cell]:
    """Return the cells of the highest rate, in the order of tables, under one condition or all."""
    found = [cell for cell in cells if condition in (None, cell.condition)]
    highest = max((cell.rate for cell in found), default=math.nan)
    return [cell for cell in found if cell.rate == highest]
