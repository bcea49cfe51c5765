"""Select the frames of a recorded episode that a dataset stores, while they are read.

A demonstration is every raw frame of the demonstration section and then the first live
observation. A distractor unit is the first 256 raw frames of an episode subsampled at stride 8:
32 frames, raw indices 0, 8, …, 248 (paper, section "The history buffer", footnote); a raw unit has
all of them, 249 at least, so that every unit has a raw one. A builder may choose another number of
frames, another stride, and several units of an episode. No frame after the last needed one is read.
An execution is every live frame: its first one is the first live observation of the demonstration.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import islice, pairwise

from robomme_interference_data.build_dataset.sources.base import Frame, Recording
from robomme_interference_data.constants import EXECUTIONS, LESSONS, PAPER_UNIT, UNITS, Unit
from robomme_interference_data.errors import InvalidOptionError, SourceError, counted, named


class NothingToStore(Exception):
    """An episode yields nothing; the message is the reason."""


def too_short(length: int, unit: Unit) -> NothingToStore:
    """Return why an episode of so many raw frames yields no unit."""
    return NothingToStore(f"{length} raw frames; a unit needs {unit.raw_frames}")


def unmarked_error() -> SourceError:
    """Return the error for an episode whose demonstration has no known end."""
    return SourceError(
        "the source does not mark which frames are the demonstration",
        "Demonstrations and executions need it. Source frames: the column is_demo. Source lerobot: "
        f"a column is_demo, or another one with {named('columns', 'is_demo=NAME')}, or "
        f"exec_start_idx in {named('families_from')}. Distractor units can be built without.",
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


def unit_starts(length: int, unit: Unit) -> list[int]:
    """Return the first raw frames of the units of an episode of `length` raw frames, ascending.

    They are evenly spaced from 0 to the last possible one, rounded down. There are at most
    `unit.per_episode`, and fewer where two of them would be closer than the raw frames of a unit at
    full rate, 256 in the paper: no two units overlap, in the distractors or at full rate. Without
    room for one the list is empty.

    For the paper's units, which need 249 raw frames, an episode of 1000 leaves room for starts from
    0 to 751: two units start at 0 and 751; three at 0, 375 and 751. A fourth would be 250 frames
    away, so there are never more than three. 504 frames leave room for 0 to 255: one unit, at 0;
    505 for two, at 0 and 256.
    """
    last = length - unit.raw_frames
    if last < 0:
        return []
    count = min(unit.per_episode, 1 + last // (unit.frames * unit.stride))
    return [number * last // max(1, count - 1) for number in range(count)]


def select_unit(
    frames: Iterable[Frame], kind: str, unit: Unit = PAPER_UNIT, skip: int = 0
) -> Iterator[Frame]:
    """Yield the frames of a unit in a dataset of a kind, given the one in the distractors.

    `skip` is the number of frames before it.
    """
    stored, count = unit.in_dataset(kind), 0
    most = stored.raw_frames
    for frame in islice(frames, skip, None):
        if count % stored.stride == 0:
            yield frame
        count += 1
        if count == most:
            return
    if count < unit.raw_frames:
        raise too_short(count, unit)


def select_execution(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Yield the live frames, which need actions."""
    lesson = live = 0
    for frame in frames:
        if frame.is_demonstration is None:
            raise unmarked_error()
        if frame.is_demonstration:
            lesson += 1
            continue
        if not lesson:
            raise NothingToStore("no demonstration frame")
        if frame.action is None:
            raise InvalidOptionError(
                "the source has no actions of its live frames, which executions need",
                f"Record actions, name their column with {named('columns', 'action=NAME')}, or "
                "build without executions.",
                option="source",
            )
        live += 1
        yield frame
    if live < 2:
        raise NothingToStore(f"{counted(live, 'live frame')}; an execution needs 2")


def select_frames(
    kind: str, recording: Recording, unit: Unit = PAPER_UNIT, skip: int = 0
) -> Iterator[Frame]:
    """Yield the frames that a kind of dataset stores of a recording; `unit` is the distractors'.

    `skip` is the number of frames before a unit.

    Each frame of an execution has the action that was executed after it, so that policies can be
    trained and tested on it; an observation after the last action is left out.
    """
    frames: Iterator[Frame] = recording.frames
    if kind == EXECUTIONS:
        frames = select_execution(frames)
        if not recording.action_first:
            return frames
        return (replace(frame, action=after.action) for frame, after in pairwise(frames))
    if kind in UNITS:
        frames = select_unit(frames, kind, unit, skip)
    elif kind in LESSONS:
        frames = select_demonstration(frames)
    return _with_actions_of_all(frames)


def select_episodes(
    kind: str, recording: Recording, unit: Unit, starts: Sequence[int]
) -> Iterator[tuple[int, Iterator[Frame]]]:
    """Yield what a kind of dataset stores of a recording: an episode, or a unit from each start.

    Args:
        kind: Name of the dataset.
        recording: The recording.
        unit: The unit in the distractors.
        starts: First raw frames of the units, see `unit_starts`; 0 for other datasets.

    Yields:
        The start, and the frames; all of them are to be read before the next ones.
    """
    position = 0
    for start in starts:
        yield start, select_frames(kind, recording, unit, start - position)
        position = start + unit.in_dataset(kind).raw_frames


def _with_actions_of_all(frames: Iterable[Frame]) -> Iterator[Frame]:
    """Drop actions if the first frame has none: RoboMME returns those of live frames only."""
    known: bool | None = None
    for frame in frames:
        known = frame.action is not None if known is None else known
        yield frame if known else replace(frame, action=None)
