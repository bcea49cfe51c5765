"""The main finding of offline runs: at most four sentences."""

from collections.abc import Sequence

from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.contrast import Effect
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.conditions import NO_HISTORY, parse_condition

from .claims import lacks, named, sentence
from .quotes import Sentence, TableRow, joined, rows_of, say
from .steps import AGAIN


def offline_headline(score: Score) -> list[Sentence]:
    """Return the lowest action error with history, and what is better without any.

    Only complete cells are compared. A system is called lowest only if nothing without history,
    such as a baseline, has a lower error; what has one is named, for each system.
    """
    cells = rows_of(score.tables["action_error"], family="all")
    complete = [cell for cell in cells if cell["complete"]]
    # The least history is where systems are compared: k0, where there is one.
    seen = sorted((c["condition"] for c in complete if c["condition"] != NO_HISTORY), key=_place)
    starts = [cell for cell in complete if seen and cell["condition"] == seen[0]]
    # Without a complete cell, nothing is called the lowest.
    shown = starts or complete or [cell for cell in cells if cell["n"]]
    ran = [cell for cell in cells if cell["n"] or cell["errors"]]
    step = "Next: run rollouts, because an action error is no success rate."
    if len(complete) < len(cells):
        step = f"Next: {AGAIN}."
    sentences = [
        _first(shown, complete),
        _better_without(score, starts),
        lacks(ran),
        Sentence(step),
    ]
    return [stated for stated in sentences if stated.text]


def _place(condition: str) -> tuple[int, ...]:
    return parse_condition(condition).sort_key


def _first(starts: Sequence[TableRow], complete: Sequence[TableRow]) -> Sentence:
    """State the lowest error under one condition, if nothing is lower without history."""
    first = min(starts, key=lambda cell: float(cell["action_l1"]))
    others = [
        cell
        for cell in complete
        if cell.place != first.place and (cell in starts or cell["condition"] == NO_HISTORY)
    ]
    rivals = {cell["system"] for cell in others} - {first["system"]}
    lowest = rivals and all(first["action_l1"] <= cell["action_l1"] for cell in others)
    bounds = "" if first["low"] is None else say(" (95% interval {low} to {high})", first)
    return say(
        "Offline, {name} has {what} action error of {action_l1}{bounds} under {under}, over {n} "
        "recordings.",
        first,
        name=display_name(first["system"]),
        what="the lowest" if lowest else "an",
        bounds=bounds,
        under=named(first["condition"]),
    )


def _better_without(score: Score, starts: Sequence[TableRow]) -> Sentence:
    """Name what systems are worse than without history: themselves, and baselines."""
    parts = []
    for cell in starts:
        compared = rows_of(
            score.tables.get("action_error_effects"),
            system=cell["system"],
            condition=cell["condition"],
            against_condition=NO_HISTORY,
            complete=True,
        )
        better = [
            say("{name} ({against_action_l1})", row, name=_against(row))
            for row in compared
            if row["difference"] > 0 and row["effect"] in (Effect.HISTORY, Effect.SYSTEMS)
        ]
        if better:
            listed = joined(better, " and than ")
            name, under = display_name(cell["system"]), named(cell["condition"])
            parts.append(
                say(
                    "under {under}, {name} ({action_l1}) is worse than {listed}",
                    cell,
                    name=name,
                    under=under,
                    listed=listed,
                )
            )
    return sentence(parts)


def _against(row: TableRow) -> str:
    if row["against_system"] == row["system"]:
        return "itself without history"
    return display_name(row["against_system"])
