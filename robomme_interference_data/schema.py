"""Frozen records of what a split holds; each checks itself.

`docs/format.md` lists the columns that they are read from.
"""

from dataclasses import asdict, dataclass
from typing import Any

from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS
from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId, condition_name

__all__ = ["ROLES", "BufferManifest", "EpisodeRecord", "QueryFrame", "SessionEntry"]

ROLES = ("lesson", "distractor", "filler", "contradiction")
"""What a session is to its query: its own demonstration (or a part of it), a session of another
family, material without content, or one that contradicts the lesson. The paper's splits use the
first two."""

_DATASETS = (DEMONSTRATIONS, DISTRACTORS)


@dataclass(frozen=True)
class EpisodeRecord:
    """An episode of a dataset, with what its source recorded of it.

    Attributes:
        episode_index: Number of the episode in the dataset, from 0.
        id: Id of the episode that was recorded; of a distractor unit, the one it was made of.
        length: Stored frames. A demonstration's last one is the query frame.
        goals: Wordings of the goal; the first is the dataset's task text.
        seed: Seed of the simulator, or None.
        difficulty: `easy`, `medium`, `hard`, or None.
        simulator: `robomme`, `tabletop`, …, or None.
        raw_length: Frames of the recorded episode.
        exec_start_idx: Index of the query frame, which is the number of lesson frames; None in a
            distractor unit.
        exact: False if a frame was ever lossily compressed.
        sha256: Digest over all frames, see `digest.py`.
        feature_sha256: Digest over all frames by feature.
        lesson_sha256: Digest over the lesson, without the query frame; None in a unit.
        lesson_feature_sha256: The same by feature; empty in a unit.
    """

    episode_index: int
    id: EpisodeId
    length: int
    goals: tuple[str, ...]
    seed: int | None
    difficulty: str | None
    simulator: str | None
    raw_length: int
    exec_start_idx: int | None
    exact: bool
    sha256: str
    feature_sha256: dict[str, str]
    lesson_sha256: str | None
    lesson_feature_sha256: dict[str, str]


@dataclass(frozen=True)
class SessionEntry:
    """One session of a history buffer: where its frames lie and what they must hash to.

    Attributes:
        role: One of `ROLES`.
        family: Family of the recorded episode.
        source: Id of the recorded episode.
        dataset: `demonstrations` or `distractors`.
        revision: Identity of that dataset, see `manifest.json`.
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
        if self.dataset not in _DATASETS:
            raise FormatError(f"session dataset {self.dataset!r} is none of {', '.join(_DATASETS)}")
        if not 0 <= self.start < self.stop or self.repeat < 1:
            raise FormatError(
                f"session span [{self.start}, {self.stop}) × {self.repeat} of {self.source} is "
                "empty or negative"
            )

    @property
    def num_frames(self) -> int:
        """Frames that the session adds to the buffer."""
        return (self.stop - self.start) * self.repeat


@dataclass(frozen=True)
class QueryFrame:
    """Where the first live observation of a query episode is stored."""

    dataset: str
    revision: str
    episode_index: int
    frame: int


@dataclass(frozen=True)
class BufferManifest:
    """A history buffer by name: what it holds, without the frames.

    Attributes:
        episode_id: The query episode.
        k: Number of sessions that are not the lesson.
        goals: Wordings of the query's goal; at least one.
        seed: Seed of the query episode in its simulator, or None.
        difficulty: `easy`, `medium`, `hard`, or None.
        simulator: Simulator that the query episode belongs to, or None.
        exact: Whether all frames are the recorded ones, bit for bit.
        lesson_frames: Frames of the lesson in the buffer.
        history_frames: Frames of the whole buffer: the `exec_start_idx` of the policy servers.
        lesson_share: Expected share of lesson frames in an even 32-frame sample at the first
            step, see `draw.lesson_share`.
        query: Where the first live observation is stored; never part of the buffer.
        sessions: The sessions in order.
    """

    episode_id: EpisodeId
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
        if frames != self.history_frames:
            raise FormatError(
                f"{self.episode_id} at k={self.k}: the sessions hold {frames} frames, "
                f"history_frames says {self.history_frames}"
            )

    @property
    def condition(self) -> str:
        """Name of the condition, such as `k3`."""
        return condition_name(self.k)

    @property
    def family(self) -> str:
        """Family of the query episode."""
        return self.episode_id.family

    @property
    def goal(self) -> str:
        """The goal in words: the first of its wordings."""
        return self.goals[0]

    def as_dict(self) -> dict[str, Any]:
        """Return the manifest as plain values: the object of a line of `buffers.jsonl`."""
        value = asdict(self)
        value["episode_id"] = str(self.episode_id)
        for name in ("family", "split", "index"):
            value[name] = getattr(self.episode_id, name)
        value["condition"] = self.condition
        value["goals"] = list(self.goals)
        value["sessions"] = [
            {**session, "source": str(entry.source)}
            for session, entry in zip(value["sessions"], self.sessions, strict=True)
        ]
        return value
