"""The main finding of each simulator's rows, in a few sentences."""

import math
from collections.abc import Sequence

from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.cells import SuccessCell
from robomme_interference_data.evaluate.score.tables.contrast import START, Contrast, Effect
from robomme_interference_data.evaluate.systems import display_name, published_base
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.intervals import wilson
from robomme_interference_data.stats.significance import ALPHA, holm
from robomme_interference_data.stats.signs import simultaneous
from robomme_interference_data.viz.tables import percent, points

from .strongest import difference_text, named


def headline(score: Score, simulator: str) -> str:
    """Return the main finding of one simulator's rows, or of recordings.

    Only complete cells are compared. The leader has the highest rate at k0; systems that are not
    distinguishable from the best are named, and intervals and p-values are corrected for the choice
    of the leader. A reference leads only if there is no other system.
    """
    if score.recordings is not None and simulator == score.recordings.simulator:
        from .offline import offline_headline  # few scores have any

        return offline_headline(score)
    own = [cell for cell in score.cells if cell.simulator == simulator and not cell.part]
    cells = [cell for cell in own if not cell.reference] or own
    complete = [cell for cell in cells if cell.complete]
    if complete:
        # Where only references have rows, none is left out.
        left_out = [cell for cell in own if cell.complete and cell not in complete]
        sentences = _leading(score, complete, left_out)
    else:
        sentences = [_nothing_complete(cells)]
    if not all(cell.complete for cell in own):
        done = sum(cell.complete for cell in own)
        sentences.append(f"{done} of {len(own)} cells are complete.")
    return " ".join(sentences)


def _leading(
    score: Score, complete: Sequence[SuccessCell], references: Sequence[SuccessCell]
) -> list[str]:
    """State the best rate at k0 and how far it falls, or else the best rate."""
    best = _best(complete, START) or _best(complete, _best(complete)[0].condition)
    leader = best[0]
    falls = [
        contrast
        for contrast in score.contrasts
        if contrast.effect is Effect.SESSIONS
        and (contrast.simulator, contrast.system) == (leader.simulator, leader.system)
        and contrast.pairs.n
    ]
    rate = (
        f"In {leader.simulator}, {display_name(leader.system)} succeeds in {percent(leader.rate)} "
        f"of {leader.n} episodes "
    )
    interval = _chosen_interval(leader, complete)
    if leader.condition != START or not falls:
        first = f"{rate}under {named(leader.condition)} ({interval})."
        return [first, *_tied(complete, leader), *_hurting(score, leader)]
    fall = max(falls, key=lambda contrast: parse_condition(contrast.condition).k)
    first = f"{rate}if the history holds only the lesson ({START}, {interval}), "
    sentences = [first + _from_start(score, fall), *_tied(complete, leader)]
    if fall.complete:
        highest = _best(complete, fall.condition)[0]
        if highest.system != leader.system:
            sentences.append(_highest(highest, references))
        sentences += _tied(complete, highest)
    sentences += _equal(score, fall) + _beside_base(score, fall)
    return sentences + _hurting(score, leader)


def _highest(highest: SuccessCell, references: Sequence[SuccessCell]) -> str:
    """State the highest rate of a condition, and which references it leaves out."""
    rate = f"{percent(highest.rate)}, of {display_name(highest.system)}"
    text = f"The highest rate at {highest.condition} is {rate}"
    higher = [
        cell
        for cell in references
        if cell.condition == highest.condition and cell.rate > highest.rate
    ]
    if not higher:
        return f"{text}."
    names = _listed(higher)
    be = "is" if len(higher) == 1 else "are"
    return f"{text}, without the references, of which {names} {be} higher."


def _chosen_interval(leader: SuccessCell, complete: Sequence[SuccessCell]) -> str:
    """Return the interval of the leader's rate, corrected for its choice among all systems."""
    systems = sum(cell.condition == leader.condition for cell in complete)
    low, high = wilson(leader.rate * leader.trials, leader.trials, simultaneous(systems))
    interval = f"95% interval {100 * low:.1f} to {100 * high:.1f}"
    if systems > 1:
        interval += f", corrected for the choice among {systems} systems"
    return interval


def _tied(complete: Sequence[SuccessCell], first: SuccessCell) -> list[str]:
    """Name the other systems that are not distinguishable from the best of a condition."""
    cells = [
        cell
        for cell in complete
        if cell.best and cell.condition == first.condition and cell is not first
    ]
    if not cells:
        return []
    be = "is" if len(cells) == 1 else "are"
    names = f"{_listed(cells)} {be} not distinguishable from the best"
    return [f"Under {named(first.condition)}, {names}."]


def _listed(cells: Sequence[SuccessCell]) -> str:
    *names, last = (display_name(cell.system) for cell in cells)
    return f"{', '.join(names)} and {last}" if names else last


def _nothing_complete(cells: Sequence[SuccessCell]) -> str:
    counting = [cell for cell in cells if cell.n]
    if not counting:
        return f"In {cells[0].simulator}, no rollout counts yet."
    nearest = min(counting, key=lambda cell: (len(cell.missing) + len(cell.unexpected), -cell.n))
    outside = ""
    if nearest.unexpected:
        outside = f", and {len(nearest.unexpected)} are outside the grid"
    return (
        f"In {nearest.simulator}, no cell is complete, so no system leads. The most complete is "
        f"{display_name(nearest.system)} under {named(nearest.condition)}: {len(nearest.missing)} "
        f"of {nearest.expected} episodes are missing{outside}."
    )


def _from_start(score: Score, fall: Contrast) -> str:
    """State the leader's rate under a condition, and its fall among the falls of all systems."""
    falls = [
        contrast
        for contrast in score.contrasts
        if contrast.effect is Effect.SESSIONS
        and (contrast.simulator, contrast.condition) == (fall.simulator, fall.condition)
        and (contrast is fall or contrast.complete)
        and (contrast is fall or not score.is_reference(contrast.simulator, contrast.system))
    ]
    k, pairs = parse_condition(fall.condition).k, fall.pairs
    sessions = "distractor session" if k == 1 else "distractor sessions"
    over = "" if fall.complete else f", incomplete, over its {pairs.n} episodes"
    counts = f"{pairs.gained} episodes gained, {pairs.lost} lost"
    return (
        f"and in {percent(pairs.second)} with {k} {sessions} after it ({fall.condition}{over}): "
        f"{difference_text(fall, falls, 'the falls of {} systems', counts)}."
    )


def _hurting(score: Score, leader: SuccessCell) -> list[str]:
    """Name the largest loss of the leader under conditions beyond the paper's."""
    effects = [
        contrast
        for contrast in score.contrasts
        if contrast.effect is Effect.INTERFERENCE
        and (contrast.simulator, contrast.system) == (leader.simulator, leader.system)
        and contrast.complete
    ]
    worst = min(effects, key=lambda effect: effect.pairs.change.value, default=None)
    if worst is None or worst.pairs.change.value >= 0:
        return []
    p = holm([effect.pairs.p for effect in effects])[effects.index(worst)]
    loss = "largest loss is by" if p < ALPHA else "largest loss, which is not significant, is by"
    change = difference_text(worst, effects, "{} comparisons")
    return [
        f"Under the conditions beyond the paper's, its {loss} {worst.asks}: {worst.condition} "
        f"minus {named(worst.against[1])} is {change}."
    ]


def _equal(score: Score, fall: Contrast) -> list[str]:
    """State whether the leader's rate under a condition is equivalent to that at k0."""
    if "equivalence" not in score.tables:
        return []
    from robomme_interference_data.evaluate.score.tables.equivalence import BEYOND, EQUIVALENT, OPEN

    sentences = []
    key = {"simulator": fall.simulator, "system": fall.system, "condition": fall.condition}
    for record in score.tables["equivalence"].records():
        if not (key.items() <= record.items() and record["against_condition"] == START):
            continue
        margin = f"{100 * record['margin']:g}"
        bounds = f"90% interval {points(record['low_90'])} to {points(record['high_90'])}"
        if record["against_system"] == fall.system:
            whose = "its own"
        else:
            whose = f"{display_name(record['against_system'])}'s"
        if record["against_rows"] == "published":
            whose += " published"
        verdict = {
            EQUIVALENT: f"is equivalent to {whose} {START} within ±{margin} points",
            BEYOND: f"is more than {margin} points from {whose} {START}",
            OPEN: f"is not shown to be within ±{margin} points of {whose} {START}",
        }[record["verdict"].rstrip("†")]
        if record["verdict"].endswith("†"):
            bounds += ", provisional"
        sentences.append(f"Its {fall.condition} {verdict} ({bounds}).")
    return sentences


def _beside_base(score: Score, contrast: Contrast) -> list[str]:
    """State the published fall of the system without retrieval."""
    base = published_base(contrast.system)
    rates = {
        cell.condition: cell.rate
        for cell in score.published
        if (cell.simulator, cell.system) == (contrast.simulator, base)
    }
    if not {START, contrast.condition} <= {*rates}:
        return []
    return [
        f"Without retrieval, {display_name(base or '')} falls from {percent(rates[START])} to "
        f"{percent(rates[contrast.condition])} (published)."
    ]


def _best(cells: Sequence[SuccessCell], condition: str | None = None) -> list[SuccessCell]:
    """Return the cells of the highest rate, in the order of tables, under one condition or all."""
    candidates = [cell for cell in cells if condition in (None, cell.condition)]
    highest = max((cell.rate for cell in candidates), default=math.nan)
    return [cell for cell in candidates if cell.rate == highest]
