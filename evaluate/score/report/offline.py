"""The main finding of offline runs, in a few sentences."""

from collections.abc import Sequence

from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.action_error import ErrorCell
from robomme_interference_data.evaluate.score.tables.contrast import Measure
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.conditions import NO_HISTORY, parse_condition

from .strongest import named


def offline_headline(score: Score) -> str:
    """Return the lowest action error with history, and what is better without any.

    Only complete cells are compared. A system is called lowest only if nothing without history,
    such as a baseline, has a lower error; what has one is named, for each system.
    """
    cells = [cell for cell in score.error_cells if not cell.part]
    complete = [cell for cell in cells if cell.complete]
    sentences = list[str]()
    # The least history is where systems are compared: k0, where there is one.
    seen = sorted((c.condition for c in complete if c.condition != NO_HISTORY), key=_place)
    starts = [cell for cell in complete if seen and cell.condition == seen[0]]
    if complete:
        sentences.append(_first(starts or complete, complete))
    sentences += [text for cell in starts if (text := _better_without(score, cell))]
    with_history = {cell.system for cell in cells if cell.condition != NO_HISTORY}
    lone = [cell for cell in complete if cell.system not in with_history]
    if lone and with_history:
        listed = ", ".join(f"{display_name(cell.system)} {cell.error.value:.4f}" for cell in lone)
        sentences.append(f"Without history: {listed}.")
    if len(complete) < len(cells):
        sentences.append(f"{len(complete)} of {len(cells)} cells are complete.")
    if errors := sum(cell.errors for cell in cells):
        sentences.append(f"Errors, which do not count: {errors}.")
    return " ".join(sentences)


def _place(condition: str) -> tuple[int, ...]:
    return parse_condition(condition).sort_key


def _first(starts: Sequence[ErrorCell], complete: Sequence[ErrorCell]) -> str:
    """State the lowest error under one condition, and whether anything is lower without history."""
    first = min(starts, key=lambda cell: cell.error.value)
    others = [
        cell
        for cell in complete
        if cell is not first and (cell in starts or cell.condition == NO_HISTORY)
    ]
    rivals = {cell.system for cell in others} - {first.system}
    lowest = rivals and all(first.error.value <= cell.error.value for cell in others)
    error = f"{first.error.value:.4f} under {named(first.condition)}"
    has = f"the lowest action error, {error}" if lowest else f"an action error of {error}"
    return f"Offline, {display_name(first.system)} has {has}, over {first.n} recordings."


def _better_without(score: Score, cell: ErrorCell) -> str:
    """Name the baselines that a system is worse than, and itself without history; or nothing."""
    better = list[str]()
    for contrast in score.contrasts:
        (against, condition), pairs = contrast.against, contrast.pairs
        if (
            contrast.measure is Measure.ACTION_ERROR
            and (contrast.system, contrast.condition) == (cell.system, cell.condition)
            and condition == NO_HISTORY
            and contrast.complete
            and pairs.change.value > 0
        ):
            own = against == cell.system
            name = "itself without history" if own else display_name(against)
            better.append(f"{name} ({pairs.first:.4f})")
    if not better:
        return ""
    name, under = display_name(cell.system), named(cell.condition)
    return (
        f"{name} is worse under {under} ({cell.error.value:.4f}) than {' and than '.join(better)}."
    )
