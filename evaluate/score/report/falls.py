"""What a score concludes about the fall of each system from k0 to the most sessions."""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from robomme_interference_data.evaluate.score.quotes import TableRow, rows_of
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.contrast import START, Effect
from robomme_interference_data.evaluate.score.tables.equivalence import EQUIVALENT
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.stats.significance import ALPHA


class Verdict(StrEnum):
    """What is concluded about a fall."""

    FALL = "a fall is shown"
    RISE = "a rise is shown"
    EXCLUDED = "a fall beyond the margin is excluded"
    OPEN = "no fall is shown"
    NONE = "no conclusion"  # another one if the errors were failures, or successes


@dataclass(frozen=True)
class Fall:
    """The fall of a system: rows of tables.

    Attributes:
        row: The comparison of its last condition with its own k0.
        equivalence: The same with the margin, if one was stated.
        start: Its rate under k0.
        end: Its rate under the last condition.
    """

    row: TableRow
    equivalence: TableRow | None
    start: TableRow
    end: TableRow

    @property
    def system(self) -> str:
        """The system."""
        return str(self.row["system"])

    @property
    def condition(self) -> str:
        """The condition that is compared with k0."""
        return str(self.row["condition"])

    @property
    def complete(self) -> bool:
        """Whether both cells are complete."""
        return bool(self.row["complete"])

    @property
    def verdict(self) -> Verdict:
        """What is concluded."""
        if self.row["p_holm"] is not None and self.row["p_holm"] < ALPHA:
            return Verdict.FALL if self.row["difference"] < 0 else Verdict.RISE
        if self.equivalence is not None and self.equivalence["verdict"] == EQUIVALENT:
            return Verdict.EXCLUDED
        return Verdict.OPEN


def falls_of(score: Score, simulator: str) -> list[Fall]:
    """Return the fall of each system that ran k0 and a condition after it.

    References are left out where other systems have rows. All falls are to one condition: the most
    sessions that any system ran.
    """
    sessions = rows_of(score.tables.get("effects"), simulator=simulator, effect=Effect.SESSIONS)
    sessions = ranked(score, simulator, sessions)
    last = max((str(row["condition"]) for row in sessions), key=_sessions, default="")
    return [_fall(score, row) for row in sessions if row["condition"] == last and row["n"]]


def ranked(score: Score, simulator: str, rows: Sequence[TableRow]) -> list[TableRow]:
    """Return rows without those of references, or all where there are no others."""
    kept = [row for row in rows if not score.is_reference(simulator, row["system"])]
    return kept or [*rows]


def _sessions(condition: str) -> int:
    return parse_condition(condition).k


def _fall(score: Score, row: TableRow) -> Fall:
    key = {"simulator": row["simulator"], "system": row["system"]}
    start, end = (
        rows_of(score.tables["main"], **key, condition=name)[0]
        for name in (START, row["condition"])
    )
    equivalence = rows_of(
        score.tables.get("equivalence"),
        **key,
        condition=row["condition"],
        against_system=row["system"],
        against_condition=START,
        against_rows="rows",
    )
    return Fall(row, equivalence[0] if equivalence else None, start, end)
