"""Where the episodes of a LeRobot dataset lie in its files. Pure rules.

Video files of v3.0 hold several episodes, and the episode table states the time at which each
begins, `from_timestamp`. LeRobot's decoder looks for the frame nearest to that time, on the clock
of the file. So does this package: a start may miss its frame by less than half a frame, since
sums of rounded seconds drift. What LeRobot's tools write is accepted, gaps between episodes
included; frames that the table does not account for are an error, because then nothing states
which frame belongs to which row.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

from robomme_interference_data.errors import FormatError, counted

_FIELD = re.compile(r"\{(\w+)(?::0(\d)d)?\}")

_MAX_FRAME = 1 << 40  # number of a frame in its file: a container's timestamp has 64 bits
_LATEST_S = 1e9


@dataclass(frozen=True)
class EpisodeLocation:
    """Frames of an episode, and its rows' file."""

    length: int
    data: str


@dataclass(frozen=True)
class VideoLocation:
    """A camera's video file of an episode, and the number of the episode's first frame there."""

    path: str
    first: int


@dataclass(frozen=True)
class VideoSpan:
    """An episode in a video file, as the episode table has it.

    Attributes:
        episode: Number of the episode.
        length: Its frames.
        start: Where it begins in the file, in frames, not rounded; NaN if that is unknown.
        stop: Where it ends, not rounded; NaN if that is unknown.
    """

    episode: int
    length: int
    start: float
    stop: float

    @property
    def first(self) -> int:
        """The number of the first frame; -1 if it is not within half a frame of one."""
        return nearest_frame(self.start)


def has_own_files(info: Mapping[str, Any]) -> bool:
    """Return whether every episode has files and a line of text of its own, as before v3.0."""
    return bool(info["codebase_version"] != "v3.0")


def nearest_frame(position: float) -> int:
    """Return the frame that is less than half a frame away from a position, or -1."""
    if not -0.5 < position <= _MAX_FRAME:  # false for NaN, too
        return -1
    frame = round(position)
    return frame if abs(frame - position) < 0.5 else -1


def fill_template(template: str, where: object, **values: str | int) -> str:
    """Fill in a path template of `info.json`: `{name}` and `{name:03d}`, nothing else."""
    invalid = FormatError.damaged(where, f"the path template {template!r} cannot be filled in")

    def fill(match: re.Match[str]) -> str:
        value = values.get(match[1])
        if value is None or (match[2] and not isinstance(value, int)):
            raise invalid
        return f"{value:0{match[2]}d}" if match[2] else str(value)

    # Not by `str.format`, with which a template can reach attributes of the values.
    filled = _FIELD.sub(fill, template)
    if "{" in filled or "}" in filled:
        raise invalid
    return filled


def locate_episode(
    info: Mapping[str, Any], index: int, row: Mapping[str, Any], where: str
) -> EpisodeLocation:
    """Return where the rows of an episode lie, given its per-episode columns.

    Raises:
        FormatError: The columns do not state it.
    """
    length = _whole(row, "length", index, where)
    return EpisodeLocation(length, _path(info, info["data_path"], "data", index, row, where))


def locate_video(
    info: Mapping[str, Any], feature: str, index: int, row: Mapping[str, Any], where: str
) -> VideoLocation:
    """Return where the frames of an episode lie in a video feature's files.

    Raises:
        FormatError: The per-episode columns do not state it, or its first frame is not less than
            half a frame away from the stated time.
    """
    key = f"videos/{feature}"
    path = _path(info, info["video_path"], key, index, row, where, video_key=feature)
    if has_own_files(info):
        return VideoLocation(path, 0)
    name = f"{key}/from_timestamp"
    start = row.get(name)
    valid = isinstance(start, int | float) and abs(start) < _LATEST_S
    first = nearest_frame(start * info["fps"]) if valid else -1
    if first < 0:
        what = f"{name} of episode {index} is {start!r}"
        if valid:
            what += f", between two frames at {info['fps']:g} frames per second"
        raise FormatError(
            f"{where}: {what}; expected the time of its first frame in seconds",
            "Correct the episode table in meta/episodes, or leave the episode out.",
        )
    return VideoLocation(path, first)


def span_problems(spans: Sequence[VideoSpan], first: int, count: int) -> dict[int, str]:
    """Return what is wrong with the episodes of a video file, by number; empty if nothing is.

    Args:
        spans: All episodes that the table places in the file, in the order of their numbers.
        first: Number of the file's first frame; its other frames have the next numbers.
        count: The file's frames.
    """
    if _is_explained(spans, first, first + count):
        return {}
    rows = sum(span.length for span in spans)
    if rows == count:
        # Each frame is one row, so that the episodes follow one another: which ones start elsewhere
        # than stated?
        starts = accumulate((span.length for span in spans), initial=first)
        return {
            span.episode: (
                f"episode {span.episode} begins at frame {span.start:.2f} according to the "
                f"episode table, but at frame {start} in the video, after the episodes before it"
            )
            for span, start in zip(spans, starts, strict=False)
            if span.first != start
        }
    stated = ", ".join(_stated(span) for span in spans[:3]) + (", …" if len(spans) > 3 else "")
    problem = (
        f"the video holds {counted(count, 'frame')}, {first} to {first + count - 1}, but the table "
        f"has {counted(rows, 'row')} for it ({stated}), and does not explain the difference"
    )
    return {span.episode: f"episode {span.episode}: {problem}" for span in spans}


def _stated(span: VideoSpan) -> str:
    if span.first < 0:
        return f"episode {span.episode} somewhere"
    return f"episode {span.episode} at {span.first} to {span.first + span.length - 1}"


def _is_explained(spans: Sequence[VideoSpan], first: int, stop: int) -> bool:
    """Return whether episodes are where the table states, and it explains all other frames.

    It explains frames before an episode by its start, and frames after the last one by its end; or
    if there are as many after each episode: then the recorder wrote some more frames than rows.
    """
    ordered = sorted(spans, key=lambda span: span.first)
    if not ordered or ordered[0].first < first:
        return False
    gaps = [after.first - before.first - before.length for before, after in pairwise(ordered)]
    rest = stop - ordered[-1].first - ordered[-1].length
    if min([*gaps, rest]) < 0:
        return False
    if rest == 0 or nearest_frame(ordered[-1].stop) == stop:
        return True
    return bool(gaps) and set(gaps) == {rest}


def _path(
    info: Mapping[str, Any],
    template: str,
    key: str,
    index: int,
    row: Mapping[str, Any],
    where: str,
    **more: str,
) -> str:
    if has_own_files(info):
        chunk = index // info.get("chunks_size", 1000)
        return fill_template(template, where, episode_chunk=chunk, episode_index=index, **more)
    chunk = _whole(row, f"{key}/chunk_index", index, where)
    file = _whole(row, f"{key}/file_index", index, where)
    return fill_template(template, where, chunk_index=chunk, file_index=file, **more)


def _whole(row: Mapping[str, Any], name: str, index: int, where: str) -> int:
    value = row.get(name)
    if not isinstance(value, int) or not 0 <= value <= _MAX_FRAME:
        raise FormatError(
            f"{where}: {name} of episode {index} is {value!r}; expected a whole number",
            "Correct the episode table in meta/, or leave the episode or the camera out.",
        )
    return value
