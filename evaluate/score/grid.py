"""Which cells are expected, and which episodes a complete one has."""

from enum import StrEnum

__all__ = ["Grid"]


class Grid(StrEnum):
    """Which cells are expected, and which episodes a complete one has.

    `benchmark`: the paper's five conditions, each with its nine families × test episodes 0 to 49;
    `given`: those conditions and episodes that any of the rows of the simulator is of. A condition
    that does not apply to a system is not expected of it.
    """

    BENCHMARK = "benchmark"
    GIVEN = "given"
