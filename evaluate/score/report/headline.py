"""The main finding of each simulator's rows: at most four sentences, with one claim each."""

from collections.abc import Sequence

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.contrast import LESSON_ONLY, Scope
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.conditions import in_order

from .claims import FEW, episodes, falls_apart, findings, lacks, named, over_both
from .falls import Fall, falls_of
from .quotes import Sentence, TableRow, joined, number_of, rows_of, say
from .steps import next_step


def headline(score: Score, simulator: str) -> list[Sentence]:
    """Return the main finding of one simulator's rows, or of recordings.

    First rates, then whether they fall from k0 to the most sessions, then what is missing or broke,
    then what to run next. All numbers are those of the tables.
    """
    if score.recordings is not None and simulator == score.recordings.simulator:
        from .offline import offline_headline  # few scores have any

        return offline_headline(score)
    cells = rows_of(score.tables["main"], simulator=simulator)
    if not any(row["n"] for row in cells):
        return [
            say("In {simulator}, no rollout counts yet.", cells[0]),
            next_step(score, simulator, []),
        ]
    falls = falls_of(score, simulator)
    complete = [fall for fall in falls if fall.complete]
    apart = rows_of(score.tables.get("interaction"), simulator=simulator, primary=True)
    # Rates of different episodes say nothing about a fall: then they are over those of both cells.
    if complete or (falls and all(fall.same_episodes for fall in falls)):
        rates = _fall_rates(score, complete or falls)
    elif falls:
        rates = joined([over_both(fall) for fall in falls[:FEW]], "; ")
    else:
        counting = [row for row in cells if row["n"]]
        ranked = [row for row in counting if not score.is_reference(simulator, row["system"])]
        rates = _rates(score, ranked or counting)
    lacking = lacks(
        [row for row in cells if row["n"] or row["errors"]],
        apart=[fall for fall in falls if not fall.complete] if complete else [],
    )
    sentences = [
        say("In {simulator}, {rates}.", simulator=simulator, rates=rates),
        findings(complete or falls, compared=len(falls) + len(apart)),
        # Four sentences at most: what is missing comes before a finer comparison.
        lacking if lacking.text else falls_apart(apart),
        next_step(score, simulator, falls),
    ]
    return [stated for stated in sentences if stated.text]


def headlines(score: Score) -> dict[str, str]:
    """Return the main finding of each simulator, and of recordings, as text."""
    return {
        outcomes.simulator: " ".join(map(str, headline(score, outcomes.simulator)))
        for outcomes in score.all_outcomes
    }


def _fall_rates(score: Score, falls: Sequence[Fall]) -> Sentence:
    """State the rates of complete falls under k0 and at their ends."""
    of = _episodes(score, falls[0].start)
    if len(falls) > FEW:
        lasts = dict.fromkeys(fall.condition for fall in falls)
        rates = say(
            "{count} systems succeed in {start} of {of} at {k0} and in {end} at {last}",
            count=number_of([fall.row for fall in falls]),
            start=_range([fall.start for fall in falls]),
            of=of,
            k0=LESSON_ONLY,
            end=_range([fall.end for fall in falls]),
            last=" or ".join(lasts),
        )
    else:
        parts = []
        for place, fall in enumerate(falls):
            text = "{name} in {start} at {k0} and in {end} at {last}"
            if not place:
                text = "{name} succeeds in {start} of {of} at {k0} and in {end} at {last}"
            parts.append(
                say(
                    text,
                    name=display_name(fall.system),
                    start=_rate(fall.start),
                    of=of,
                    k0=LESSON_ONLY,
                    end=_rate(fall.end),
                    last=fall.condition,
                )
            )
        rates = joined(parts, ", and ")
    cells = [cell for fall in falls for cell in (fall.start, fall.end)]
    return say("{rates} (95% intervals, {scope})", rates=rates, scope=_scope(cells))


def _scope(cells: Sequence[TableRow]) -> str:
    """State what intervals hold for: one training run says nothing about the next one."""
    systems = dict.fromkeys(str(cell["system"]) for cell in cells)
    lone = dict.fromkeys(str(cell["system"]) for cell in cells if cell["scope"] == Scope.CHECKPOINT)
    if not lone:
        return "for other training runs, too"
    if len(lone) < len(systems):
        names = " and ".join(map(display_name, lone))
        return f"for other training runs, too, except those of {names}"
    single = len(lone) == 1 and all(cell["runs"] == 1 for cell in cells)
    return "for this checkpoint" if single else "for these checkpoints"


def _rate(row: TableRow) -> Sentence:
    return say("{rate} ({low:size} to {high:size})", row)


def _range(rows: Sequence[TableRow]) -> Sentence:
    """State the lowest and the highest rate of some systems under one condition."""
    ordered = sorted(rows, key=lambda row: float(row["rate"]))
    lowest, highest = (
        say("{rate} ({low:size} to {high:size}, {name})", row, name=display_name(row["system"]))
        for row in (ordered[0], ordered[-1])
    )
    return joined([lowest, highest], " to ")


def _episodes(score: Score, row: TableRow) -> Sentence:
    """State the number of episodes of a cell, and of the benchmark's families if not of all."""
    key = {name: row[name] for name in ("simulator", "system", "condition")}
    parts = rows_of(score.tables.get("parts"), **key, by="family")
    parts = [part for part in parts if part["n"]]
    if len(parts) < len(FAMILIES) and all(part["part"] in FAMILIES for part in parts):
        text = "{n} {episodes} of {count} of the nine families"
        return say(text, row, episodes=episodes(row), count=number_of(parts))
    return say("{n} {episodes}", row, episodes=episodes(row))


def _rates(score: Score, cells: Sequence[TableRow]) -> Sentence:
    """State the rates of the first and the last condition that any system ran, by system."""
    conditions = [each.name for each in in_order({str(row["condition"]) for row in cells})]
    first = LESSON_ONLY if LESSON_ONLY in conditions else conditions[0]
    shown = dict.fromkeys([first, conditions[-1]])
    parts = []
    for condition in shown:
        rows = [row for row in cells if row["condition"] == condition]
        of = _episodes(score, rows[0])
        words: dict[str, str | Sentence] = {"of": of, "under": named(condition)}
        if len(rows) > FEW:
            text = "{count} systems succeed in {rates} of {of} under {under}"
            parts.append(say(text, count=number_of(rows), rates=_range(rows), **words))
            continue
        each = [
            say("{name} succeeds in {rate}", name=display_name(row["system"]), rate=_rate(row))
            for row in rows
        ]
        listed = joined(each, ", ", " and ")
        parts.append(say("{listed} of {of} under {under}", listed=listed, **words))
    rates = joined(parts, "; ")
    return say("{rates} (95% intervals, {scope})", rates=rates, scope=_scope(cells))
