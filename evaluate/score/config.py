"""What can be asked of a scoring."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.settings import setting


class Against(StrEnum):
    """What rates can be compared with."""

    PAPER = "paper"


class Expected(StrEnum):
    """Which cells are expected, and which episodes a complete one has.

    `benchmark`: the paper's five conditions, each with its nine families × test episodes 0 to 49;
    `given`: the conditions and episodes that occur in any row of the simulator. A condition
    that does not apply to a system is not expected of it.
    """

    BENCHMARK = "benchmark"
    OBSERVED = "observed"


@dataclass(frozen=True)
class Settings:
    """What is scored, and how."""

    rows: tuple[Path, ...] = setting(
        name="-",
        whole=True,
        metavar="ROWS",
        help="Folders of runs, or CSV, parquet or jsonl files.",
    )
    system: str | None = setting(None, help="Name of the system of rows that name none.")
    against: Against | None = setting(None, help="Put the published rates beside these.")
    expected: Expected = setting(
        Expected.BENCHMARK,
        help="Episodes of a complete cell: the benchmark's (nine families, test episodes 0 to 49 "
        "each), or those that any of the given rows is of.",
    )
    margin: float | None = setting(
        None,
        metavar="POINTS",
        help="Test whether differences are within this many points: k against k0, and a system "
        "with retrieval against the one without.",
    )
    lenient: bool = setting(False, help="Leave bad rows out, and count them.")

    def __post_init__(self) -> None:
        if self.margin is not None and not 0 < self.margin <= 100:
            raise InvalidOptionError.expected(
                "margin", self.margin, "points, more than 0 up to 100"
            )
