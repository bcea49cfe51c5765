"""The sentences of a headline on falls, and on episodes that are missing or broke."""

from collections.abc import Sequence

from robomme_interference_data.evaluate.score.quotes import (
    Sentence,
    TableRow,
    joined,
    number_of,
    say,
)
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.conditions import NO_HISTORY

from .falls import Fall, Verdict

_ALONE = 2
"""The most systems with a verdict that are stated with their numbers."""


def named(condition: str) -> str:
    """Return a condition in words."""
    return "no history" if condition == NO_HISTORY else condition


def verdicts(falls: Sequence[Fall]) -> Sentence:
    """State what is concluded about falls; empty without any."""
    parts = []
    for verdict in Verdict:
        own = [fall for fall in falls if fall.verdict is verdict]
        if own:
            few = len(falls) <= _ALONE
            parts += [_one(fall) for fall in own] if few else [_several(own, verdict)]
    if not parts:
        return Sentence("")
    if not all(fall.complete for fall in falls):
        parts.append(Sentence("all provisional"))
    return _capital(joined(parts, "; "))


def _one(fall: Fall) -> Sentence:
    """State the verdict of one system with its numbers."""
    row, name = fall.row, display_name(fall.system)
    match fall.verdict:
        case Verdict.FALL:
            return say(
                "a fall is shown: {name}'s {condition} is {joint_high:size} to {joint_low:size} "
                "points below its own {against_condition} (95% interval, {p})",
                row,
                name=name,
                p=p_of(row),
            )
        case Verdict.RISE:
            return say(
                "a rise is shown: {name}'s {condition} is {joint_low:size} to {joint_high:size} "
                "points above its own {against_condition} (95% interval, {p})",
                row,
                name=name,
                p=p_of(row),
            )
        case Verdict.EXCLUDED:
            assert fall.equivalence is not None
            return say(
                "a fall of more than {margin:size} points is excluded: {name}'s {condition} minus "
                "its own {against_condition} is {low_90} to {high_90} points (90% interval)",
                fall.equivalence,
                name=name,
            )
        case _:
            excluded = ""
            if row["joint_low"] is not None and row["joint_low"] < 0:
                excluded = say(", and one of up to {joint_low:size} points is not excluded", row)
            return say(
                "no fall of {name} from {against_condition} to {condition} is shown{excluded} (95% "
                "interval {joint_low} to {joint_high}, {p})",
                row,
                name=name,
                excluded=excluded,
                p=p_of(row),
            )


def _several(falls: Sequence[Fall], verdict: Verdict) -> Sentence:
    names = joined([Sentence(display_name(fall.system)) for fall in falls], ", ", " and ")
    count = number_of([fall.row for fall in falls])
    return say("{verdict} for {count}: {names}", verdict=verdict, count=count, names=names)


def p_of(row: TableRow) -> Sentence:
    """State the corrected p of a row."""
    quote = row.quote("p_holm")
    # Small ones are shown as `< 0.001`.
    equals = "" if quote.text.startswith("<") else "= "
    return say("p {equals}{p}", equals=equals, p=quote)


def lacks(cells: Sequence[TableRow], apart: Sequence[Fall] = ()) -> Sentence:
    """State which rollouts broke or are missing in some cells with rows; empty if none.

    `apart` are the falls over fewer episodes than those of the first sentence.
    """
    broken = [row for row in cells if row["errors"]]
    # An episode that broke is missing, too.
    short = [row for row in cells if row["missing"] > row["errors"]]
    outside = [row for row in cells if not row["complete"] and not row["missing"]]
    parts = [
        *_each(
            broken,
            "{errors} rollouts of {name} under {under} broke{bound}",
            "rollouts broke in {count} cells",
        ),
        *_each(
            short,
            "{missing} episodes of {name} under {under} are missing",
            "episodes are missing in {count} cells",
        ),
        *_each(
            outside,
            "episodes of {name} under {under} are outside the grid",
            "episodes are outside the grid in {count} cells",
        ),
    ]
    parts += [over_both(fall) for fall in apart[:_ALONE]]
    return _capital(joined(parts, "; "))


def over_both(fall: Fall) -> Sentence:
    """State the rates of a system over the episodes that count under k0 and at the end."""
    return say(
        "over the {n} episodes that finished under both, {name} succeeds in {against_rate} at "
        "{against_condition} and in {rate} at {condition}",
        fall.row,
        name=display_name(fall.system),
    )


def _each(rows: Sequence[TableRow], text: str, several: str) -> list[Sentence]:
    """Fill a text for each of a few rows, or state the number of many."""
    if len(rows) > _ALONE:
        return [say(several, count=number_of(rows))]
    return [
        say(
            text,
            row,
            name=display_name(row["system"]),
            under=named(row["condition"]),
            bound=_bound(row),
        )
        for row in rows
    ]


def _bound(row: TableRow) -> Sentence:
    """State the least that a success rate can be; empty for action errors."""
    if "if_errors_fail" not in row.table.columns:
        return Sentence("")
    return say(", and its rate is {if_errors_fail} if they count as failures", row)


def _capital(clause: Sentence) -> Sentence:
    """Return a clause as a sentence of its own; an empty one stays empty."""
    if not clause.text:
        return clause
    return Sentence(f"{clause.text[0].upper()}{clause.text[1:]}.", clause.quotes)
