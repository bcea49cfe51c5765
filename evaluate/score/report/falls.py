"""What the primary analysis concludes about the fall of each system."""

from dataclasses import dataclass
from enum import StrEnum

from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.contrast import LESSON_ONLY, Verdict
from robomme_interference_data.evaluate.score.tables.equivalence import EQUIVALENT

from .quotes import TableRow, rows_of


class Finding(StrEnum):
    """What is concluded about a fall, in the order of sentences."""

    FALL = "a fall is shown"
    RISE = "a rise is shown"
    EXCLUDED = "a fall beyond the margin is excluded"
    OPEN = "no fall is shown"
    ERRORS = "no conclusion before broken rollouts are run again"


@dataclass(frozen=True)
class Fall:
    """The fall of a system: rows of tables.

    Attributes:
        row: The primary comparison with its own k0, in `effects`.
        equivalence: The same with a margin, if one was stated.
        start: Its rate under k0, in `main`.
        end: Its rate under the condition that is compared.
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
    def same_episodes(self) -> bool:
        """Whether its cells are over the episodes, and training runs, that it is paired over."""
        cells = (self.start, self.end)
        return all(self.row[name] == cell[name] for cell in cells for name in ("n", "runs"))

    @property
    def finding(self) -> Finding:
        """What is concluded."""
        match self.row["verdict"]:
            case Verdict.SHOWN:
                return Finding.FALL if self.row["difference"] < 0 else Finding.RISE
            case Verdict.DEPENDS:
                return Finding.ERRORS
        if self.equivalence is not None and self.equivalence["verdict"] == EQUIVALENT:
            return Finding.EXCLUDED
        return Finding.OPEN


def falls_of(score: Score, simulator: str) -> list[Fall]:
    """Return the fall of each system that ran k0 and a condition after it.

    A reference has none: it is no part of the primary analysis.
    """
    rows = rows_of(score.tables.get("effects"), simulator=simulator, primary=True)
    return [_fall(score, row) for row in rows if row["n"]]


def _fall(score: Score, row: TableRow) -> Fall:
    key = {"simulator": row["simulator"], "system": row["system"]}
    start, end = (
        rows_of(score.tables["main"], **key, condition=name)[0]
        for name in (LESSON_ONLY, row["condition"])
    )
    equivalence = rows_of(
        score.tables.get("equivalence"),
        **key,
        condition=row["condition"],
        against_system=row["system"],
        against_condition=LESSON_ONLY,
        against_rows="rows",
    )
    return Fall(row, equivalence[0] if equivalence else None, start, end)
