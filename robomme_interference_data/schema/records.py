"""Records of datasets and their episodes.

The columns of tables and the fields of headers follow from these dataclasses and from those in
`manifest.py` and `rollouts.py` (see `codec.py`); files: `docs/reference/file-layout.md`.
"""

from dataclasses import dataclass
from typing import Annotated, Any

from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId

MAX_GOAL = 1 << 16
"""Characters of all wordings of a goal."""

# Upper bounds, so that an untrusted file cannot exhaust memory.
_MAX_FRAMES = 1 << 22  # of an episode: days at the recorded rate
_MAX_PARTS = 1 << 10  # of an answer; the embedded suite has at most six
_MAX_SPANS = 1 << 12  # of evidence in a lesson
_MAX_SCENE = 1 << 16  # characters
_MAX_TEXT = 1 << 10  # characters of a part of an answer


@dataclass(frozen=True)
class SpanDigests:
    """SHA-256 over spans of a demonstration, over all features except actions."""

    first: Annotated[str, "First half of the lesson."]
    second: Annotated[str, "Second half, one frame longer if the number of frames is odd."]
    last: Annotated[str, "Last frame of the lesson."]
    query: Annotated[str, "The first live observation."]


@dataclass(frozen=True)
class EvidenceSpan:
    """Stored frames of a lesson that show a part of the hidden answer."""

    part: Annotated[int, "Number of the part, from 0."]
    text: Annotated[str, "The part in words, such as `lifts cube 2`."]
    start: Annotated[int, "First frame that shows it."]
    stop: Annotated[int, "Frame after the last one."]

    def __post_init__(self) -> None:
        if not 0 <= self.part < _MAX_PARTS or not 0 <= self.start < self.stop:
            raise FormatError(
                f"evidence of part {self.part} in frames [{self.start}, {self.stop}); expected "
                f"part 0 to {_MAX_PARTS - 1} and at least one frame"
            )
        if not 0 < len(self.text) <= _MAX_TEXT:
            raise FormatError(
                f"text of evidence has {len(self.text)} characters; expected 1 to {_MAX_TEXT}"
            )


@dataclass(frozen=True)
class DaySpan:
    """Stored frames of a day: a task, a piece of one, or a transition between tasks."""

    source: Annotated[EpisodeId, "The episode that is played; otherwise the day."]
    part: Annotated[str, "One of `lesson`, `first`, `second`, `idle`, `transition`."]
    shift: Annotated[
        str,
        "How the table looks, of a transition at its end: `none`, or a shift such as `light:2`.",
    ]
    start: Annotated[int, "First frame."]
    stop: Annotated[int, "Frame after the last one."]
    sha256: Annotated[str, "Digest over the span."]
    evidence: Annotated[
        tuple[EvidenceSpan, ...], "Frames of the day that show parts of the episode's answer."
    ]


@dataclass(frozen=True)
class DayQuery:
    """A query of a day, and when it can be asked first."""

    episode: Annotated[EpisodeId, "The query episode."]
    task: Annotated[int, "Number of the task, from 0, after which it can be asked."]


@dataclass(frozen=True)
class Day:
    """What a recorded day holds: all its frames in spans, and its queries."""

    spans: Annotated[tuple[DaySpan, ...], "The spans, one after the other."]
    queries: Annotated[tuple[DayQuery, ...], "The queries, in canonical order."]


@dataclass(frozen=True)
class EpisodeRecord:
    """An episode of a dataset, with the metadata of its source."""

    episode_index: Annotated[int, "Number of the episode in the dataset, from 0."]
    episode_id: Annotated[
        EpisodeId, "Id of the recorded episode; of a unit from within it, with the first raw frame."
    ]
    length: Annotated[
        int, "Stored frames. A demonstration's last one is the first live observation."
    ]
    goals: Annotated[
        tuple[str, ...], "Wordings of the goal, at least one; the first is LeRobot's task."
    ]
    seed: Annotated[int | None, "Seed of the simulator, or None."]
    difficulty: Annotated[str | None, "`easy`, `medium`, `hard`, or None."]
    simulator: Annotated[str | None, "`robomme`, `tabletop`, …, or None."]
    exec_start_idx: Annotated[
        int | None,
        "Index of the first live observation = number of lesson frames; None without a lesson.",
    ]
    exact: Annotated[bool, "False if a frame was ever lossily compressed."]
    feature_sha256: Annotated[
        dict[str, str], "Digest by feature over the lesson, or over all frames without a lesson."
    ]
    span_sha256: Annotated[
        SpanDigests | None,
        "Digests of parts of the lesson and of the first live observation, or None.",
    ]
    evidence: Annotated[
        tuple[EvidenceSpan, ...] | None,
        "Lesson frames that show parts of the hidden answer; None if unknown or without a lesson.",
    ] = None
    scene: Annotated[
        str | None,
        "What the scene allows and hides, as JSON of the simulator; None if it follows from the "
        "seed, or is unknown.",
    ] = None
    ability: Annotated[
        str | None,
        "What a query of a day needs of a memory: one of `constants.ABILITIES`; None for others.",
    ] = None
    day: Annotated[Day | None, "The tasks and queries of a day; None for other episodes."] = None

    def __post_init__(self) -> None:
        name, start, spans = self.episode_id, self.exec_start_idx, self.evidence or ()
        if not self.goals or sum(map(len, self.goals)) > MAX_GOAL:
            raise FormatError(f"{name} has no goal, or one of over {MAX_GOAL} characters")
        fits = start is None or 0 < start < self.length
        if not 0 < self.length <= _MAX_FRAMES or not fits:
            raise FormatError(f"{name} has length {self.length} and exec_start_idx {start}")
        if (start is None and self.evidence is not None) or len(spans) > _MAX_SPANS:
            raise FormatError(
                f"{name} has {len(spans)} evidence spans; expected none in a unit, and at most "
                f"{_MAX_SPANS} in a lesson"
            )
        if len(self.scene or "") > _MAX_SCENE:
            raise FormatError(
                f"{name} has a scene of {len(self.scene or '')} characters; expected at most "
                f"{_MAX_SCENE}"
            )
        for span in spans:
            if start is None or span.stop > start:
                raise FormatError(
                    f"{name} has evidence in frames [{span.start}, {span.stop}), but its lesson "
                    f"has {start} frames"
                )

    @property
    def goal(self) -> str:
        """The goal in words: the first of its wordings."""
        return self.goals[0]

    @property
    def session(self) -> tuple[int, int]:
        """Start and stop (excluded) of its session in the stored frames: the lesson or unit."""
        return 0, self.length if self.exec_start_idx is None else self.exec_start_idx

    @property
    def spans(self) -> dict[str, tuple[int, int]]:
        """Start and stop (excluded) of the spans of `SpanDigests`; empty without a lesson."""
        if self.exec_start_idx is None:
            return {}
        return lesson_spans(self.exec_start_idx)

    def digests(self, start: int, stop: int) -> dict[str, str] | None:
        """Return the recorded digests of a span by feature, or None."""
        return self.feature_sha256 if (start, stop) == self.session else None


def lesson_spans(frames: int) -> dict[str, tuple[int, int]]:
    """Return `EpisodeRecord.spans` of a demonstration with that many lesson frames."""
    half = frames // 2
    return {
        "first": (0, half),
        "second": (half, frames),
        "last": (frames - 1, frames),
        "query": (frames, frames + 1),
    }


@dataclass(frozen=True)
class Counts:
    """Size of a dataset."""

    episodes: Annotated[int, "Episodes."]
    frames: Annotated[int, "Stored frames."]
    families: Annotated[dict[str, int], "Episodes by family."]


@dataclass(frozen=True)
class DatasetIdentity:
    """Content of `meta/interference.json`."""

    format_version: Annotated[int, "Version of the file format."]
    kind: Annotated[str, "Name of the dataset in a buffer set, such as `demonstrations`."]
    version: Annotated[str, "Version of the data, such as `1.0.0`."]
    revision: Annotated[
        str, "Identity of the content: SHA-256 over what describes it and all episode records."
    ]
    exact: Annotated[bool, "Whether all episodes are exact."]
    codec: Annotated[str, "Name of the video settings."]
    cameras: Annotated[tuple[str, ...], "Names of the cameras, sorted."]
    unit: Annotated[
        dict[str, int] | None,
        "`frames` and `stride` of a unit, and `per_episode`, the most units of a recorded episode, "
        "if that is not 1; None for other datasets.",
    ]
    simulators: Annotated[tuple[str, ...], "Simulators of the episodes."]
    sources: Annotated[tuple[dict[str, Any], ...], "Metadata of the sources."]
    counts: Annotated[Counts, "Numbers of episodes and frames."]
    sums: Annotated[str, "SHA-256 of `meta/SHA256SUMS`, which lists every other file."]
