"""The sentences of a headline on falls, and on episodes that are missing or broke."""

from collections.abc import Sequence

from robomme_interference_data.evaluate.score.tables.contrast import Verdict
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.conditions import NO_HISTORY

from .falls import Fall, Finding
from .quotes import Sentence, TableRow, joined, number_of, say

FEW = 2
"""The most systems, or cells, that a sentence names one by one with their numbers."""


def named(condition: str) -> str:
    """Return a condition in words."""
    return "no history" if condition == NO_HISTORY else condition


def episodes(row: TableRow) -> str:
    """Return the noun for the n of a row."""
    return "episode" if row["n"] == 1 else "episodes"


def sentence(clauses: Sequence[Sentence]) -> Sentence:
    """Return clauses as a sentence; an empty one without any."""
    if not clauses:
        return Sentence("")
    whole = joined(clauses, "; ")
    return Sentence(f"{whole.text[0].upper()}{whole.text[1:]}.", whole.quotes)


# --- falls -----------------------------------------------------------------------------------


def findings(falls: Sequence[Fall], compared: int) -> Sentence:
    """State what is concluded about falls; empty without any.

    `compared` is the number of comparisons that were corrected together.
    """
    clauses = list[Sentence]()
    for finding in Finding:
        own = [fall for fall in falls if fall.finding is finding]
        if own and len(falls) <= FEW:
            clauses += [_finding(fall, compared) for fall in own]
        elif own:
            clauses.append(_several(own, finding, falls))
    concluded = [fall for fall in falls if fall.finding is not Finding.ERRORS]
    if any(not fall.complete for fall in concluded):
        clauses.append(Sentence("provisional, because rollouts are missing"))
    return sentence(clauses)


def _finding(fall: Fall, compared: int) -> Sentence:
    """State what is concluded about one system, with its numbers."""
    row, name = fall.row, display_name(fall.system)
    match fall.finding:
        # Holm's p can be below 0.05 where Bonferroni's interval, which is wider, holds 0.
        case Finding.FALL | Finding.RISE if not _excludes_zero(row):
            text = (
                "{finding}: {name}'s {condition} minus its own {against_condition} is {difference} "
                "points ({interval}{p})"
            )
        case Finding.FALL:
            text = (
                "a fall is shown: {name}'s {condition} is {joint_high:size} to {joint_low:size} "
                "points below its own {against_condition} ({level} interval, {p})"
            )
        case Finding.RISE:
            text = (
                "a rise is shown: {name}'s {condition} is {joint_low:size} to {joint_high:size} "
                "points above its own {against_condition} ({level} interval, {p})"
            )
        case Finding.EXCLUDED:
            assert fall.equivalence is not None
            return say(
                "a fall of {name} of more than {margin:size} points is excluded (90% interval of "
                "{condition} − {against_condition}: {low_90} to {high_90})",
                fall.equivalence,
                name=name,
            )
        case Finding.ERRORS:
            text = (
                "no conclusion on {name} before its broken rollouts are run again: {condition} − "
                "{against_condition} is {if_failures} points if all of them are failures, and "
                "{if_successes} if all are successes"
            )
        case Finding.OPEN:
            text = "no fall of {name} from {against_condition} to {condition} is shown"
            # Without an interval, or where it excludes 0 although p does not, this is all.
            if row["joint_low"] is not None and row["joint_low"] < 0:
                text += ", and up to {joint_low:size} points is not excluded"
            text += " ({interval}{p})"
    level = _level(compared)
    words = {"finding": fall.finding, "name": name, "level": level}
    return say(text, row, p=p_of(row), interval=_interval(row, level), **words)


def _excludes_zero(row: TableRow) -> bool:
    low, high = row["joint_low"], row["joint_high"]
    return low is not None and (low > 0 or high < 0)


def _level(compared: int) -> str:
    return "corrected 95%" if compared > 1 else "95%"


def _interval(row: TableRow, level: str) -> Sentence:
    """State an interval before a p; empty without one."""
    if row["joint_low"] is None:
        return Sentence("")
    return say("{level} interval {joint_low} to {joint_high}, ", row, level=level)


def _several(own: Sequence[Fall], finding: Finding, falls: Sequence[Fall]) -> Sentence:
    """Name the systems, among many, of which one finding is concluded."""
    return say(
        "{finding} for {count} of {of}: {names}",
        finding=finding,
        count=number_of([fall.row for fall in own]),
        of=number_of([fall.row for fall in falls]),
        names=joined([Sentence(display_name(fall.system)) for fall in own], ", ", " and "),
    )


def p_of(row: TableRow) -> Sentence:
    """State the corrected p of a row."""
    quote = row.quote("p_holm")
    # Small ones are shown as `< 0.001`.
    equals = "" if quote.text.startswith("<") else "= "
    return say("p {equals}{p}", equals=equals, p=quote)


def falls_apart(rows: Sequence[TableRow]) -> Sentence:
    """State whether two systems fall differently, or in how many pairs; empty without any."""
    if len(rows) <= 1:
        return sentence([_apart(row) for row in rows])
    shown = [row for row in rows if row["verdict"] == Verdict.SHOWN]
    of = number_of(rows)
    if not shown:
        text = "in none of {of} pairs of systems is a difference of falls shown"
        return sentence([say(text, of=of)])
    text = "the falls of two systems are shown to differ in {count} of {of} pairs"
    return sentence([say(text, count=number_of(shown), of=of)])


def _apart(row: TableRow) -> Sentence:
    """State the difference of two falls, in points for each doubling of the sessions."""
    names = [display_name(row[column]) for column in ("system", "against_system")]
    match row["verdict"]:
        case Verdict.SHOWN:
            text = (
                "the falls differ: each time that the sessions double, {a} changes by {slope} "
                "points and {b} by {against_slope} ({p})"
            )
        case Verdict.DEPENDS:
            text = "no conclusion on the falls of {a} and {b} before errors are run again"
        case _:
            text = "no difference between the falls of {a} and {b} is shown ({p})"
    return say(text, row, a=names[0], b=names[1], p=p_of(row))


# --- what is missing ---------------------------------------------------------------------------


def lacks(cells: Sequence[TableRow], apart: Sequence[Fall] = ()) -> Sentence:
    """State which rollouts broke or are missing in some cells with rows; empty if none.

    `apart` are the falls over fewer episodes than those of the first sentence.
    """
    # An episode that broke is missing, too.
    short = [row for row in cells if row["missing"] > row["errors"]]
    clauses = [
        *_each(
            [row for row in cells if row["errors"]],
            "of {name}'s rollouts under {under}, {errors} broke{bound}",
            "rollouts broke in {count} cells",
        ),
        *_each(
            short,
            "of {name}'s episodes under {under}, the rows lack {missing}",
            "the rows lack episodes in {count} cells",
        ),
        *_each(
            [row for row in cells if not row["complete"] and not row["missing"]],
            "episodes of {name} under {under} are outside the grid",
            "episodes are outside the grid in {count} cells",
        ),
    ]
    return sentence([*clauses, *map(over_both, apart[:FEW])])


def over_both(fall: Fall) -> Sentence:
    """State the rates of a system over the episodes that count under k0 and at the end."""
    return say(
        "over the {n} {episodes} that finished under both, {name} succeeds in {against_rate} at "
        "{against_condition} and in {rate} at {condition}",
        fall.row,
        episodes=episodes(fall.row),
        name=display_name(fall.system),
    )


def _each(rows: Sequence[TableRow], text: str, several: str) -> list[Sentence]:
    """Fill a text for each of a few rows, or state the number of many."""
    if len(rows) > FEW:
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
