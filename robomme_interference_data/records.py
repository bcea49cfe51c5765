"""What is written down, each declared once: episodes and buffers.

The columns of every table and the fields of every header follow from these and from
`rollouts.py` (see `rows.py`); `docs/format.md` describes them to readers of the files.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any

from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId

ROLES = ("lesson", "distractor", "filler", "contradiction")
"""What a session is to its query: its own demonstration (or a part of it), a distractor unit,
material without content, or a lesson that contradicts its own. The paper's conditions use the first
two."""


_MOST_FRAMES = 1 << 22
"""Frames of an episode, at most: days at the recorded rate."""

_MOST_HISTORY = 1 << 18
"""Frames of a buffer, at most: seven hours; the paper's longest have some thousand."""

_MOST_SESSIONS = 1 << 12
"""Sessions of a buffer, at most."""

_MOST_GOALS = 1 << 16
"""Characters of all wordings of a goal, at most: they are shown, and handed to policies."""

_MOST_PARTS = 1 << 10
"""Parts of an answer, at most; the embedded suite's longest has six."""

_MOST_SPANS = 1 << 12
"""Evidence spans of a lesson, at most."""

_MOST_TEXT = 1 << 10
"""Characters of a part in words, at most: they are shown."""


# --- datasets ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class SpanDigests:
    """SHA-256 over spans of a demonstration, all features but actions together.

    Attributes:
        first: The first half of the lesson.
        second: The second half, which has a frame more where their number is odd.
        last: The lesson's last frame.
        query: The query frame.
    """

    first: str
    second: str
    last: str
    query: str


@dataclass(frozen=True)
class EvidenceSpan:
    """Stored frames of a lesson that show a part of the hidden answer.

    Attributes:
        part: Number of the part, from 0.
        text: The part in words, such as `lifts cube 2`.
        start: First frame that shows it.
        stop: Frame after the last one.
    """

    part: int
    text: str
    start: int
    stop: int

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
    """An episode of a dataset, with what its source recorded of it.

    Attributes:
        episode_index: Number of the episode in the dataset, from 0.
        episode_id: Id of the episode that was recorded; of a unit, the one it was made of.
        length: Stored frames. A demonstration's last one is the query frame.
        goals: Wordings of the goal; at least one. The first is the dataset's task text.
        seed: Seed of the simulator, or None.
        difficulty: `easy`, `medium`, `hard`, or None.
        simulator: `robomme`, `tabletop`, …, or None.
        exec_start_idx: Index of the query frame, which is the number of lesson frames; None where
            there is no lesson.
        exact: False if a frame was ever lossily compressed.
        feature_sha256: Digest by feature over the session that the episode is: the lesson, or all
            frames where there is none; see `digest.py`.
        span_sha256: Digests of the spans that parts of a lesson are, and of the query frame, by
            name, see `spans`; None where there is no lesson.
        evidence: Frames of the lesson that show the hidden answer, part by part; None where that
            is unknown, and where there is no lesson.
    """

    episode_index: int
    episode_id: EpisodeId
    length: int
    goals: tuple[str, ...]
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exec_start_idx: int | None
    exact: bool
    feature_sha256: dict[str, str]
    span_sha256: SpanDigests | None
    evidence: tuple[EvidenceSpan, ...] | None = None

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
    """`meta/interference.json`: what a dataset is.

    Attributes:
        format_version: Of the files.
        kind: Name of the dataset in a split, such as `demonstrations`.
        version: Such as `1.0.0`.
        revision: Identity of the content: SHA-256 over all episode records.
        exact: Whether all episodes are.
        codec: Name of the video settings.
        cameras: Names of the cameras, sorted.
        unit: `frames` and `stride` of a unit; None in demonstrations.
        simulators: That the episodes come from.
        sources: What the sources say of themselves.
        counts: How much there is.
        sums: SHA-256 of `meta/SHA256SUMS`, which lists every other file.
    """

    format_version: int
    kind: str
    version: str
    revision: str
    exact: bool
    codec: str
    cameras: tuple[str, ...]
    unit: dict[str, int] | None
    simulators: tuple[str, ...]
    sources: tuple[dict[str, Any], ...]
    counts: Counts
    sums: str


# --- buffers -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class SessionEntry:
    """One session of a history buffer: where its frames lie and what they must hash to.

    Attributes:
        role: One of `ROLES`.
        family: Family of the recorded episode.
        source: Id of the recorded episode.
        dataset: Name of the dataset in the split, such as `demonstrations`.
        revision: Identity of that dataset.
        episode_index: Number of the episode in that dataset.
        start: First stored frame of the span.
        stop: Frame after the last one.
        repeat: How often each frame is shown in a row; 1 but for held frames.
        sha256: Digest over the span, each frame once, see `digest.py`.
    """

    role: str
    family: str
    source: EpisodeId
    dataset: str
    revision: str
    episode_index: int
    start: int
    stop: int
    repeat: int
    sha256: str

    def __post_init__(self) -> None:
        if self.role not in ROLES:
            raise FormatError(f"session role {self.role!r} is none of {', '.join(ROLES)}")
        if not 0 <= self.start < self.stop or self.repeat < 1 or self.num_frames > _MOST_HISTORY:
            raise FormatError(
                f"session span [{self.start}, {self.stop}) × {self.repeat} of {self.source} is "
                f"empty, negative, or of over {_MOST_HISTORY} frames"
            )

    @property
    def num_frames(self) -> int:
        """Frames that the session adds to the buffer."""
        return (self.stop - self.start) * self.repeat


@dataclass(frozen=True)
class Session:
    """A session in its place in a buffer.

    Attributes:
        start: First frame of the session in the buffer.
        stop: Frame after its last one.
        entry: What it is, and where its frames are stored.
    """

    start: int
    stop: int
    entry: SessionEntry

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def role(self) -> str:
        """`lesson`, `distractor`, … (see `ROLES`)."""
        return self.entry.role

    @property
    def family(self) -> str:
        """Family of the recorded episode."""
        return self.entry.family

    @property
    def source(self) -> EpisodeId:
        """Id of the recorded episode."""
        return self.entry.source


def place_sessions(entries: Sequence[SessionEntry], role: str | None = None) -> tuple[Session, ...]:
    """Return sessions in their places, one after the other: all, or those of a role."""
    stops = [0, *accumulate(entry.num_frames for entry in entries)]
    placed = zip(stops, stops[1:], entries, strict=False)
    return tuple(Session(*one) for one in placed if role in (None, one[2].role))


@dataclass(frozen=True)
class QueryFrame:
    """Where the first live observation of a query episode is stored.

    Attributes:
        dataset: Name of the dataset in the split.
        revision: Identity of that dataset.
        episode_index: Number of the episode in that dataset.
        frame: The stored frame.
    """

    dataset: str
    revision: str
    episode_index: int
    frame: int


@dataclass(frozen=True)
class BufferManifest:
    """A history buffer by name: what it holds, without the frames.

    Attributes:
        episode_id: The query episode.
        condition: Name of the condition: with `episode_id`, the buffer's key.
        k: Number of sessions that the condition adds.
        goals: Wordings of the query's goal; at least one.
        seed: Seed of the query episode in its simulator, or None.
        difficulty: `easy`, `medium`, `hard`, or None.
        simulator: Simulator that the query episode belongs to, or None.
        exact: Whether all frames are the recorded ones, bit for bit.
        lesson_frames: Frames of the lesson in the buffer.
        history_frames: Frames of the whole buffer: the `exec_start_idx` of the policy servers.
        lesson_share: Share of lesson frames in an even 32-frame sample of history and first live
            observation at the first step, see `sampling.lesson_share`.
        query: Where the first live observation is stored; never part of the buffer.
        sessions: The sessions in order.
    """

    episode_id: EpisodeId
    condition: str
    k: int
    goals: tuple[str, ...]
    seed: int | None
    difficulty: str | None
    simulator: str | None
    exact: bool
    lesson_frames: int
    history_frames: int
    lesson_share: float
    query: QueryFrame
    sessions: tuple[SessionEntry, ...]

    def __post_init__(self) -> None:
        frames = sum(session.num_frames for session in self.sessions)
        if frames > _MOST_HISTORY or len(self.sessions) > _MOST_SESSIONS:
            raise FormatError(
                f"{self}: {frames} frames in {len(self.sessions)} sessions; expected at most "
                f"{_MOST_HISTORY} in {_MOST_SESSIONS}"
            )
        if frames != self.history_frames:
            raise FormatError(
                f"{self}: the sessions hold {frames} frames, history_frames says "
                f"{self.history_frames}"
            )

    def __str__(self) -> str:
        return f"{self.episode_id} under {self.condition}"

    @property
    def goal(self) -> str:
        """The goal in words: the first of its wordings."""
        return self.goals[0]


@dataclass(frozen=True)
class ManifestDataset:
    """A dataset that manifests name.

    Attributes:
        kind: Name of the dataset in a split, such as `demonstrations`.
        version: Its version.
        revision: Its revision: sessions name it.
        identity: SHA-256 of its `meta/interference.json`.
        place: Where it lies: None for the folder of its name in the split, `.` for the split's own
            root, `namespace/name@commit` for a repository on the Hub.
    """

    kind: str
    version: str
    revision: str
    identity: str
    place: str | None = None


@dataclass(frozen=True)
class ManifestHeader:
    """`manifests/manifest.json`: how the buffers of a split were planned.

    Attributes:
        format_version: Of the files.
        rule_version: Of the draw.
        seed: Of the draw.
        conditions: Names of the planned conditions, in order.
        position_limit: Longest history and rollout together, or None.
        datasets: The datasets by name, which are folders of the split.
        counts: Numbers of `queries`, `buffers` and `sessions`.
        rows: SHA-256 of `buffers.parquet`.
    """

    format_version: int
    rule_version: int
    seed: int
    conditions: tuple[str, ...]
    position_limit: int | None
    datasets: dict[str, ManifestDataset]
    counts: dict[str, int]
    rows: str
