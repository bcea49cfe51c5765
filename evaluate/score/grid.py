"""Which episodes a complete cell has."""

from enum import StrEnum

__all__ = ["Grid"]


class Grid(StrEnum):
    """Which episodes a complete cell has.

    `benchmark`: the paper's nine families × test episodes 0 to 49; `given`: those episodes that
    any of the rows of the simulator is of.
    """

    BENCHMARK = "benchmark"
    GIVEN = "given"
