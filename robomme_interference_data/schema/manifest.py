"""What manifests hold, each declared once: sessions, buffers, and the header.

The columns of `buffers.parquet` and the fields of `manifest.json` follow from these (see
`rows.py`); `docs/format.md` describes them to readers of the files.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId

ROLES = ("lesson", "distractor", "filler", "contradiction")
"""What a session is to its query: its own demonstration (or a part of it), a distractor unit,
material without content, or a lesson that contradicts its own. The paper's conditions use the first
two."""

_MOST_HISTORY = 1 << 18
"""Frames of a buffer, at most: seven hours; the paper's longest have some thousand."""

_MOST_SESSIONS = 1 << 12
"""Sessions of a buffer, at most."""


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
