"""What the rows say, in a sentence or two for each simulator."""

import math

from robomme_interference_data.evaluate.rows import NO_HISTORY, condition_rank
from robomme_interference_data.evaluate.score.cells import Cell
from robomme_interference_data.evaluate.score.effects import START, Contrast, base_of
from robomme_interference_data.evaluate.score.paper import published
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import display_name, is_bound
from robomme_interference_data.tables import percent, points

__all__ = ["headline"]


def headline(score: Score, simulator: str) -> str:
    """Return the main finding of one simulator's rows, computed from them.

    Only complete cells are compared with each other; how many there are is said as well. A
    system that only bounds what a memory can reach leads where there is no other.
    """
    found = [cell for cell in score.cells if cell.simulator == simulator]
    cells = [cell for cell in found if not is_bound(cell.system)] or found
    complete = [cell for cell in cells if cell.complete]
    sentences = []
    leader = _best(complete, START) or _best(cells, START)
    contrast = _last_contrast(score, leader) if leader else None
    if leader and contrast:
        sentences.append(_from_start(leader, contrast))
        last = _best(complete, contrast.condition)
        if last and last.system != leader.system:
            sentences.append(
                f"The highest rate at {last.condition} is {percent(last.rate)}, of "
                f"{display_name(last.system)}."
            )
        sentences += _beside_base(score, contrast)
    elif best := (leader or _best(complete, None) or _best(cells, None)):
        sentences.append(
            f"{display_name(best.system)} succeeds in {percent(best.rate)} of {best.n} episodes "
            f"under {_named(best.condition)} (95% interval {_interval(best)})."
        )
    else:
        sentences.append("No rollout counts yet.")
    if not all(cell.complete for cell in found):
        done = sum(cell.complete for cell in found)
        sentences.append(f"{done} of {len(found)} cells are complete.")
    return " ".join(sentences)


def _from_start(leader: Cell, contrast: Contrast) -> str:
    k = condition_rank(contrast.condition)
    sessions = "distractor session" + ("s" if k > 1 else "")
    test, p = contrast.test, contrast.test.p
    tested = "" if math.isnan(p) else f", McNemar p = {_p(p)}"
    change = contrast.change
    # Not every difference has an interval.
    bounds = "" if math.isnan(change.low) else f"{points(change.low)} to {points(change.high)}; "
    return (
        f"{display_name(leader.system)} succeeds in {percent(leader.rate)} of {leader.n} episodes "
        f"when the history holds the lesson alone ({START}, 95% interval {_interval(leader)}), and "
        f"in {percent(contrast.rate)} with {k} {sessions} behind it ({contrast.condition}): "
        f"{points(change.value)} points ({bounds}{test.gained} episodes gained, "
        f"{test.lost} lost{tested})."
    )


def _beside_base(score: Score, contrast: Contrast) -> list[str]:
    """Say how a system with retrieval stands to the published one without, if that is wanted."""
    base = base_of(contrast.system)
    known = {(o.simulator, o.system, o.condition): o for o in published()}
    end = known.get((contrast.simulator, base or "", contrast.condition))
    start = known.get((contrast.simulator, base or "", START))
    if not score.against_paper or start is None or end is None:
        return []
    return [
        f"Without retrieval, {display_name(end.system)} falls from {percent(start.rate)} to "
        f"{percent(end.rate)} (published)."
    ]


def _last_contrast(score: Score, leader: Cell) -> Contrast | None:
    found = [
        contrast
        for effects in score.effects
        for contrast in effects.contrasts
        if (contrast.simulator, contrast.system) == (leader.simulator, leader.system)
        and contrast.against == (leader.system, START)
        and contrast.n
    ]
    return max(found, key=lambda contrast: condition_rank(contrast.condition), default=None)


def _best(cells: list[Cell], condition: str | None) -> Cell | None:
    found = [c for c in cells if c.n and (condition is None or c.condition == condition)]
    return max(found, key=lambda cell: cell.rate, default=None)


def _interval(cell: Cell) -> str:
    low, high = cell.interval
    return f"{100 * low:.1f} to {100 * high:.1f}"


def _named(condition: str) -> str:
    return "no history" if condition == NO_HISTORY else condition


def _p(value: float) -> str:
    return "1" if value == 1 else f"{value:.2g}" if value >= 0.001 else f"{value:.1e}"
