"""Where the demonstration of a LeRobot episode ends, by the columns that mark it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.sources.columns import ColumnMap
from robomme_interference_data.build_dataset.sources.tables import RowSpan
from robomme_interference_data.errors import SourceError

__all__ = ["Marks", "check_start", "marked_start", "read_marks"]

_MEND = "Correct the dataset, or leave the episode out."


class Marks:
    """What the marking columns say of some rows.

    Attributes:
        flags: By column: whether a frame belongs to the demonstration, `(T,) bool`.
        starts: By column: how many frames the demonstration has, `(T,) int64`, one value.
    """

    def __init__(self, flags: dict[str, NDArray[np.bool_]], starts: dict[str, NDArray[np.int64]]):
        self.flags = flags
        self.starts = starts

    def of(self, chosen: NDArray[np.bool_]) -> "Marks":
        """Return the marks of the chosen rows."""
        return Marks(
            {name: values[chosen] for name, values in self.flags.items()},
            {name: values[chosen] for name, values in self.starts.items()},
        )


def read_marks(rows: RowSpan, columns: ColumnMap) -> Marks:
    """Read the columns that mark demonstrations; other columns are not touched.

    Raises:
        FormatError: A column is missing or of another type.
    """
    flag, start = columns.is_demo, columns.exec_start_idx
    return Marks(
        {flag: rows.scalars(flag) != 0} if flag else {},
        {start: rows.scalars(start)} if start else {},
    )


def marked_start(marks: Marks) -> int:
    """Return the number of demonstration frames of an episode.

    Args:
        marks: Of the rows of that episode, by at least one column.

    Raises:
        SourceError: A column is not as it should be, or the two do not agree.
    """
    found = _starts(marks)
    if len(set(found.values())) != 1:
        raise _unclear(found)
    return next(iter(found.values()))


def check_start(marks: Marks, expected: int | None) -> None:
    """Hold the marks of an episode against what was said before.

    Raises:
        SourceError: They do not agree, or a column is not as it should be.
    """
    found = _starts(marks)
    if any(start != expected for start in found.values()):
        raise _unclear({**found, "meta/": expected})


def _starts(marks: Marks) -> dict[str, int]:
    """Return the number of demonstration frames by each column that marks them."""
    found = {}
    for name, flags in marks.flags.items():
        found[name] = int(flags.sum())
        if flags[found[name] :].any():
            raise SourceError(
                f"column {name!r} is true in {found[name]} frames, not all of them at the "
                "beginning; a demonstration comes first and in one piece",
                _MEND,
            )
    for name, starts in marks.starts.items():
        values = np.unique(starts)
        if len(values) != 1 or not 0 <= values[0] <= len(starts):
            raise SourceError(
                f"column {name!r} holds {', '.join(map(str, values[:5])) or 'nothing'}; expected "
                f"one number from 0 to {len(starts)} in all frames",
                _MEND,
            )
        found[name] = int(values[0])
    return found


def _unclear(found: Mapping[str, Any]) -> SourceError:
    said = " and ".join(f"{start} by {name}" for name, start in found.items())
    return SourceError(f"the number of demonstration frames is not clear: {said}", _MEND)
