"""The main finding of each simulator's rows, in a few sentences."""

import math
from collections.abc import Sequence

from robomme_interference_data.evaluate.score.comparisons.contrast import START, Contrast
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.cells import Cell
from robomme_interference_data.evaluate.score.tables.equivalence import BEYOND, EQUIVALENT, OPEN
from robomme_interference_data.evaluate.systems import base_of, display_name, is_bound
from robomme_interference_data.schema.conditions import NO_HISTORY, parse_condition
from robomme_interference_data.stats.significance import holm
from robomme_interference_data.viz.tables import percent, points


def headline(score: Score, simulator: str) -> str:
    """Return the main finding of one simulator's rows.

    Only complete cells are compared. Of equal rates the first in the order of tables leads, and the
    others are named. A reference leads only if there is no other system.
    """
    found = [one for one in score.cells if one.simulator == simulator and not one.part]
    cells = [cell for cell in found if not is_bound(cell.system)] or found
    complete = [cell for cell in cells if cell.complete]
    sentences = _leading(score, complete) if complete else [_nothing_complete(cells)]
    if not all(cell.complete for cell in found):
        done = sum(cell.complete for cell in found)
        sentences.append(f"{done} of {len(found)} cells are complete.")
    return " ".join(sentences)


def _leading(score: Score, complete: Sequence[Cell]) -> list[str]:
    """State the best rate at k0 and how far it falls, or else the best rate."""
    best = _best(complete, START) or _best(complete, _best(complete)[0].condition)
    leader, others = best[0], best[1:]
    key = ("effects", leader.simulator, leader.system, (leader.system, START))
    falls = [
        c
        for c in score.contrasts
        if (c.table, c.simulator, c.system, c.against) == key and c.pairs.n
    ]
    if leader.condition != START or not falls:
        first = (
            f"In {leader.simulator}, {display_name(leader.system)} succeeds in "
            f"{percent(leader.rate)} of {leader.n} episodes under {_named(leader.condition)} "
            f"(95% interval {_interval(leader)})."
        )
        return [first, *_alike(others), *_hurting(score, leader)]
    fall = max(falls, key=lambda one: parse_condition(one.condition).k)
    sentences = [_from_start(leader, fall, _corrected(score, fall)), *_alike(others)]
    if fall.complete:
        best = _best(complete, fall.condition)
        if all(cell.system != leader.system for cell in best):
            rate = percent(best[0].rate)
            sentences.append(f"The highest rate at {fall.condition} is {rate}, of {_listed(best)}.")
        else:
            sentences += _alike([cell for cell in best if cell.system != leader.system])
    sentences += _equal(score, fall) + _beside_base(score, fall)
    return sentences + _hurting(score, leader)


def _alike(others: Sequence[Cell]) -> list[str]:
    if not others:
        return []
    have = "has" if len(others) == 1 else "have"
    return [f"Under {_named(others[0].condition)}, {_listed(others)} {have} the same rate."]


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
        f"{display_name(nearest.system)} under {_named(nearest.condition)}: {len(nearest.missing)} "
        f"of {nearest.expected} episodes are missing{other}."
    )


def _corrected(score: Score, fall: Contrast) -> str:
    """Return the p of the leader's fall, corrected over all systems' falls.

    Choosing the leader by its rate at k0 overstates its fall, so it is tested among all falls.
    """
    key = (fall.simulator, fall.condition, "effects")
    falls = [
        one
        for one in score.contrasts
        if (one.simulator, one.condition, one.table) == key
        and one.against == (one.system, START)
        and (one is fall or one.complete)
        and not (is_bound(one.system) and one is not fall)
    ]
    p = holm([one.pairs.p for one in falls])[falls.index(fall)]
    among = f", corrected for the falls of {len(falls)} systems" * (len(falls) > 1)
    return f"{_test(fall)} p = {_p(p)}{among}{'' if fall.complete else ', provisional'}"


def _test(contrast: Contrast) -> str:
    return "McNemar" if contrast.pairs.interval == "newcombe" else "sign-flip"


def _hurting(score: Score, leader: Cell) -> list[str]:
    """Name the kind of condition beyond the paper that lowers the leader's rate most."""
    key = ("interference", leader.simulator, leader.system)
    found = [c for c in score.contrasts if (c.table, c.simulator, c.system) == key and c.complete]
    worst = min(found, key=lambda one: one.pairs.change.value, default=None)
    if worst is None or worst.pairs.change.value >= 0:
        return []
    change = worst.pairs.change
    p = holm([one.pairs.p for one in found])[found.index(worst)]
    among = f", corrected for {len(found)} comparisons" * (len(found) > 1)
    return [
        f"Of the conditions beyond the paper's, {worst.asks} costs it most: {worst.condition} "
        f"minus {_named(worst.against[1])} is {points(change.value)} points "
        f"({points(change.low)} to {points(change.high)}; {_test(worst)} p = {_p(p)}{among})."
    ]


def _from_start(leader: Cell, contrast: Contrast, tested: str) -> str:
    k = parse_condition(contrast.condition).k
    sessions = "distractor session" + ("s" if k > 1 else "")
    pairs, change = contrast.pairs, contrast.pairs.change
    over = "" if contrast.complete else f", incomplete, over its {pairs.n} episodes"
    return (
        f"In {leader.simulator}, {display_name(leader.system)} succeeds in {percent(leader.rate)} "
        f"of {leader.n} episodes if the history holds only the lesson ({START}, 95% interval "
        f"{_interval(leader)}), and in {percent(pairs.second)} with {k} {sessions} after it "
        f"({contrast.condition}{over}): {points(change.value)} points "
        f"({points(change.low)} to {points(change.high)}; {pairs.gained} episodes gained, "
        f"{pairs.lost} lost, {tested})."
    )


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
    base = base_of(contrast.system)
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


def _interval(cell: Cell) -> str:
    low, high = cell.interval
    return f"{100 * low:.1f} to {100 * high:.1f}"


def _named(condition: str) -> str:
    return "no history" if condition == NO_HISTORY else condition


def _p(value: float) -> str:
    return "1" if value == 1 else f"{value:.2g}" if value >= 0.001 else f"{value:.1e}"
