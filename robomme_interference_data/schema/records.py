"""What is written down, each declared once: datasets and their episodes.

The columns of every table and the fields of every header follow from these, and from
`manifest.py` and `rollouts.py` (see `rows.py`); `docs/format.md` describes them to readers.
"""

from dataclasses import dataclass
from typing import Annotated, Any

from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId

_MOST_FRAMES = 1 << 22
"""Frames of an episode, at most: days at the recorded rate."""

_MOST_GOALS = 1 << 16
"""Characters of all wordings of a goal, at most: they are shown, and handed to policies."""

_MOST_PARTS = 1 << 10
"""Parts of an answer, at most; the embedded suite's longest has six."""

_MOST_SPANS = 1 << 12
"""Evidence spans of a lesson, at most."""

_MOST_TEXT = 1 << 10
"""Characters of a part in words, at most: they are shown."""


@dataclass(frozen=True)
class SpanDigests:
    """SHA-256 over spans of a demonstration, all features but actions together."""

    first: Annotated[str, "The first half of the lesson."]
    second: Annotated[str, "The second half, which has a frame more where their number is odd."]
    last: Annotated[str, "The lesson's last frame."]
    query: Annotated[str, "The query frame."]


@dataclass(frozen=True)
class EvidenceSpan:
    """Stored frames of a lesson that show a part of the hidden answer."""

    part: Annotated[int, "Number of the part, from 0."]
    text: Annotated[str, "The part in words, such as `lifts cube 2`."]
    start: Annotated[int, "First frame that shows it."]
    stop: Annotated[int, "Frame after the last one."]

    def __post_init__(self) -> None:
        if not 0 <= self.part < _MOST_PARTS or not 0 <= self.start < self.stop:
            raise FormatError(
                f"evidence of part {self.part} in frames [{self.start}, {self.stop}); expected "
                f"part 0 to {_MOST_PARTS - 1}, and frames"
            )
        if not 0 < len(self.text) <= _MOST_TEXT:
            raise FormatError(
                f"evidence of part {self.part} has {len(self.text)} letters; expected 1 to "
                f"{_MOST_TEXT}"
            )


@dataclass(frozen=True)
class EpisodeRecord:
    """An episode of a dataset, with what its source recorded of it."""

    episode_index: Annotated[int, "Number of the episode in the dataset, from 0."]
    episode_id: Annotated[
        EpisodeId,
        "Id of the episode that was recorded; of a unit, the one it was made of.",
    ]
    length: Annotated[int, "Stored frames. A demonstration's last one is the query frame."]
    goals: Annotated[
        tuple[str, ...],
        "Wordings of the goal; at least one. The first is the dataset's task text.",
    ]
    seed: Annotated[int | None, "Seed of the simulator, or None."]
    difficulty: Annotated[str | None, "`easy`, `medium`, `hard`, or None."]
    simulator: Annotated[str | None, "`robomme`, `tabletop`, …, or None."]
    exec_start_idx: Annotated[
        int | None,
        "Index of the query frame, which is the number of lesson frames; None where there is "
        "no lesson.",
    ]
    exact: Annotated[bool, "False if a frame was ever lossily compressed."]
    feature_sha256: Annotated[
        dict[str, str],
        "Digest by feature over the session that the episode is: the lesson, or all frames "
        "where there is none.",
    ]
    span_sha256: Annotated[
        SpanDigests | None,
        "Digests of the spans that parts of a lesson are, and of the query frame, by name, "
        "see `spans`; None where there is no lesson.",
    ]
    evidence: Annotated[
        tuple[EvidenceSpan, ...] | None,
        "Frames of the lesson that show the hidden answer, part by part; None where that is "
        "unknown, and where there is no lesson.",
    ] = None

    def __post_init__(self) -> None:
        if not self.goals or sum(map(len, self.goals)) > _MOST_GOALS:
            raise FormatError(
                f"{self.episode_id} has no goal, or one of over {_MOST_GOALS} letters"
            )
        start = self.exec_start_idx
        fits = start is None or 0 < start < self.length
        if not 0 < self.length <= _MOST_FRAMES or not fits:
            raise FormatError(
                f"{self.episode_id} has length {self.length} and exec_start_idx {start}"
            )
        spans = self.evidence or ()
        if (start is None and self.evidence is not None) or len(spans) > _MOST_SPANS:
            raise FormatError(
                f"{self.episode_id} has {len(spans)} evidence spans; expected none in a unit, and "
                f"at most {_MOST_SPANS} in a lesson"
            )
        for span in spans:
            if start is None or span.stop > start:
                raise FormatError(
                    f"{self.episode_id} has evidence in frames [{span.start}, {span.stop}) of a "
                    f"lesson of {start}"
                )

    @property
    def goal(self) -> str:
        """The goal in words: the first of its wordings."""
        return self.goals[0]

    @property
    def session(self) -> tuple[int, int]:
        """The stored frames, end excluded, of the session that it is: a lesson, or a unit."""
        return 0, self.length if self.exec_start_idx is None else self.exec_start_idx

    @property
    def spans(self) -> dict[str, tuple[int, int]]:
        """The stored frames, end excluded, of the spans of `SpanDigests`; a unit has none."""
        if self.exec_start_idx is None:
            return {}
        return lesson_spans(self.exec_start_idx)

    def digests(self, start: int, stop: int) -> dict[str, str] | None:
        """Return the recorded digests of a span by feature; None if none are recorded for it."""
        return self.feature_sha256 if (start, stop) == self.session else None


def lesson_spans(frames: int) -> dict[str, tuple[int, int]]:
    """Return the spans of a demonstration of so many lesson frames; see `EpisodeRecord.spans`."""
    half = frames // 2
    return {
        "first": (0, half),
        "second": (half, frames),
        "last": (frames - 1, frames),
        "query": (frames, frames + 1),
    }


@dataclass(frozen=True)
class Counts:
    """How much a dataset holds: episodes, stored frames, and episodes by family."""

    episodes: int
    frames: int
    families: dict[str, int]


@dataclass(frozen=True)
class DatasetIdentity:
    """`meta/interference.json`: what a dataset is."""

    format_version: Annotated[int, "Of the files."]
    kind: Annotated[str, "Name of the dataset in a buffer set, such as `demonstrations`."]
    version: Annotated[str, "Such as `1.0.0`."]
    revision: Annotated[str, "Identity of the content: SHA-256 over all episode records."]
    exact: Annotated[bool, "Whether all episodes are."]
    codec: Annotated[str, "Name of the video settings."]
    cameras: Annotated[tuple[str, ...], "Names of the cameras, sorted."]
    unit: Annotated[
        dict[str, int] | None,
        "`frames` and `stride` of a unit; None in demonstrations.",
    ]
    simulators: Annotated[tuple[str, ...], "That the episodes come from."]
    sources: Annotated[tuple[dict[str, Any], ...], "What the sources say of themselves."]
    counts: Annotated[Counts, "How much there is."]
    sums: Annotated[str, "SHA-256 of `meta/SHA256SUMS`, which lists every other file."]
