"""Settings of a score."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.settings import setting


class Against(StrEnum):
    """Published rates that a score can be compared with."""

    PAPER = "paper"


class Expected(StrEnum):
    """The expected cells, and the episodes of a complete cell.

    `benchmark`: the paper's five conditions, each with nine families × test episodes 0 to 49;
    `observed`: the conditions and episodes that occur in any row of the simulator.
    """

    BENCHMARK = "benchmark"
    OBSERVED = "observed"


@dataclass(frozen=True)
class Settings:
    """What is scored, and how.

    Attributes:
        rows: Folders of runs, or files of rows.
        system: System of files that state none: for all, or for each in their order.
        model_seed: Model seed of files that state none, likewise.
        against: Published rates to compare with.
        expected: Episodes of a complete cell.
        margin: Margin of equivalence tests, in points; None for none.
        lenient: Whether bad rows are left out.
    """

    rows: tuple[Path, ...] = setting(
        name="-",
        whole=True,
        metavar="ROWS",
        help="Folders of runs, files of rows, or results of lerobot-eval or vla-eval.",
    )
    system: tuple[str, ...] = setting(
        (),
        whole=True,
        metavar="NAME",
        help="Name of the system in files that state none: once for all, or once for each such "
        "file in order.",
        group="Rows",
    )
    model_seed: tuple[int, ...] = setting(
        (),
        whole=True,
        metavar="SEED",
        help="Seed of the rollouts in files that state none, such as lerobot-eval's --seed: once "
        "for all, or once for each such file in order.",
        group="Rows",
    )
    against: Against | None = setting(
        None, help="Compare with the published rates.", group="Statistics"
    )
    expected: Expected = setting(
        Expected.BENCHMARK,
        help="Episodes of a complete cell: the benchmark's (nine families, test episodes 0 to 49), "
        "or those that occur in any row.",
        group="Statistics",
    )
    margin: float | None = setting(
        None,
        metavar="POINTS",
        help="Test whether differences are smaller than this many points: of k1, k2, … from k0, "
        "and of a system with retrieval from the same one without.",
        group="Statistics",
    )
    lenient: bool = setting(False, help="Leave out bad rows and count them.", group="Rows")

    def __post_init__(self) -> None:
        if self.margin is not None and not 0 < self.margin <= 100:
            raise InvalidOptionError.expected(
                "margin", self.margin, "points, more than 0 up to 100"
            )
