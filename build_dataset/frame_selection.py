"""Select the frames of a recorded episode that a dataset stores, while they are read.

A demonstration is every raw frame of the demonstration section and then the first live
observation. A distractor unit is the first 256 raw frames of an episode subsampled at stride 8:
32 frames, raw indices 0, 8, …, 248 (paper, section "The history buffer", footnote); a raw unit has
all of them, 249 at least, so that every unit has a raw one. No frame after the last needed one is
read.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial

from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DEMONSTRATIONS,
    SHIFTED,
    UNIT_MIN_RAW_FRAMES,
    UNITS,
    Unit,
)
from robomme_interference_data.errors import SourceError

from .sources.base import Frame


class NothingToStore(Exception):
    """An episode yields nothing; the message is the reason."""


def unmarked_error() -> SourceError:
    """Return the error for an episode whose demonstration has no known end."""
    return SourceError(
        "the source does not mark which frames are the demonstration",
        "Demonstrations need a column is_demo or exec_start_idx in the source, or exec_start_idx "
        "in `families_file`; `columns` names another column, as in is_demo=NAME. Distractor units "
        "can be built without.",
    )


def select_demonstration(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield the frames of the demonstration, and then the first live observation."""
    for lesson, frame in enumerate(frames):
        if frame.is_demonstration is None:
            raise unmarked_error()
        if not frame.is_demonstration and lesson == 0:
            raise NothingToStore("no demonstration frame")
        yield frame
        if not frame.is_demonstration:
            return
    raise NothingToStore("no live observation after the demonstration")


def select_unit(frames: Iterable[Frame], unit: Unit) -> Iterator[Frame]:
    """Yield the frames of a unit."""
    count, most = 0, (unit.frames - 1) * unit.stride + 1
    for frame in frames:
        if count % unit.stride == 0:
            yield frame
        count += 1
        if count == most:
            return
    if count < UNIT_MIN_RAW_FRAMES:
        raise NothingToStore(f"{count} raw frames; a unit needs {UNIT_MIN_RAW_FRAMES}")


FRAME_SELECTORS: dict[str, Callable[[Iterable[Frame]], Iterator[Frame]]] = {
    DEMONSTRATIONS: select_demonstration,
    CONTRADICTIONS: select_demonstration,
    SHIFTED: iter,
    **{kind: partial(select_unit, unit=unit) for kind, unit in UNITS.items()},
}
"""Kind of dataset to the frames that it stores of an episode."""
