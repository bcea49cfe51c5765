"""Records of manifests: sessions, buffers, and the header.

The columns of `buffers.parquet` and the fields of `manifest.json` follow from these dataclasses
(see `codec.py`); `docs/reference/file-layout.md` describes the files.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Annotated

from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId

ROLES = ("lesson", "distractor", "filler", "contradiction", "transition")
"""Roles of a session: the query's demonstration or a part of it; a distractor unit, or another task
of a day; frames without content; a lesson with another answer; the time between two tasks of a day.
The paper's conditions use the first two."""

TEACHING = ("lesson", "contradiction")
"""Roles of sessions whose evidence must be known."""

_MAX_HISTORY = 1 << 18  # frames of a buffer: seven hours; the paper's longest have some thousand
_MAX_SESSIONS = 1 << 12  # of a buffer


@dataclass(frozen=True)
class SessionEntry:
    """One session of a history buffer: where its frames are stored, and their digest."""

    role: Annotated[str, "One of `lesson`, `distractor`, `filler`, `contradiction`, `transition`."]
    family: Annotated[str, "Family of the recorded episode."]
    source: Annotated[EpisodeId, "Id of the recorded episode."]
    dataset: Annotated[str, "Name of the dataset in the buffer set, such as `demonstrations`."]
    revision: Annotated[str, "Identity of that dataset."]
    episode_index: Annotated[int, "Number of the episode in that dataset."]
    start: Annotated[int, "First stored frame of the span."]
    stop: Annotated[int, "Frame after the last one."]
    repeat: Annotated[int, "How often each frame repeats; 1 except for held frames."]
    sha256: Annotated[str, "Digest over the span, without repetitions."]

    def __post_init__(self) -> None:
        if self.role not in ROLES:
            raise FormatError(f"session role {self.role!r} is none of {', '.join(ROLES)}")
        if not 0 <= self.start < self.stop or self.repeat < 1 or self.num_frames > _MAX_HISTORY:
            raise FormatError(
                f"session span [{self.start}, {self.stop}) × {self.repeat} of {self.source} is "
                f"empty, negative, or of over {_MAX_HISTORY} frames"
            )

    @property
    def num_frames(self) -> int:
        """Frames that the session adds to the buffer."""
        return (self.stop - self.start) * self.repeat


@dataclass(frozen=True)
class Session:
    """A session with its frame range in a buffer.

    Attributes:
        start: Index of its first frame in the buffer.
        stop: Index after its last frame.
        entry: Its role, and where its frames are stored.
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


def layout_sessions(
    entries: Sequence[SessionEntry], role: str | None = None
) -> tuple[Session, ...]:
    """Return sessions with their frame ranges in a buffer: all, or those of a role."""
    stops = [0, *accumulate(entry.num_frames for entry in entries)]
    sessions = zip(stops, stops[1:], entries, strict=False)
    return tuple(Session(*placed) for placed in sessions if role in (None, placed[2].role))


@dataclass(frozen=True)
class QueryFrame:
    """Where the first live observation of a query episode is stored."""

    dataset: Annotated[str, "Name of the dataset in the buffer set."]
    revision: Annotated[str, "Identity of that dataset."]
    episode_index: Annotated[int, "Number of the episode in that dataset."]
    frame: Annotated[int, "The stored frame."]


@dataclass(frozen=True)
class BufferManifest:
    """Description of a history buffer, without the frames."""

    episode_id: Annotated[EpisodeId, "The query episode."]
    condition: Annotated[str, "Name of the condition; with `episode_id`, the buffer's key."]
    k: Annotated[int, "Number of sessions, of a day tasks, that the condition adds."]
    goals: Annotated[tuple[str, ...], "Wordings of the query's goal; at least one."]
    seed: Annotated[int | None, "Seed of the query episode in its simulator, or None."]
    difficulty: Annotated[str | None, "`easy`, `medium`, `hard`, or None."]
    simulator: Annotated[str | None, "Simulator of the query episode, or None."]
    exact: Annotated[bool, "Whether all frames equal the recorded ones bit for bit."]
    lesson_frames: Annotated[int, "Frames of the lesson in the buffer."]
    history_frames: Annotated[int, "Frames of the buffer: `exec_start_idx` of the policy servers."]
    lesson_share: Annotated[
        float, "Share of lesson frames in an even 32-frame sample at the first step."
    ]
    query: Annotated[QueryFrame, "Where the first live observation is stored."]
    sessions: Annotated[tuple[SessionEntry, ...], "The sessions in order."]

    def __post_init__(self) -> None:
        frames = sum(session.num_frames for session in self.sessions)
        if frames > _MAX_HISTORY or len(self.sessions) > _MAX_SESSIONS:
            raise FormatError(
                f"{self}: {frames} frames in {len(self.sessions)} sessions; expected at most "
                f"{_MAX_HISTORY} in {_MAX_SESSIONS}"
            )
        if frames != self.history_frames:
            raise FormatError(
                f"{self}: the sessions hold {frames} frames; expected history_frames, "
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
    """A dataset that manifests refer to."""

    kind: Annotated[str, "Name of the dataset in a buffer set, such as `demonstrations`."]
    version: Annotated[str, "Its version."]
    revision: Annotated[str, "Its revision, to which sessions refer."]
    identity: Annotated[str, "SHA-256 of its `meta/interference.json`."]
    location: Annotated[
        str | None,
        "Folder or repository: None for the buffer set's folder of its name, `.` for the buffer "
        "set's root, `namespace/name@commit` for a repository on the Hub.",
    ] = None


@dataclass(frozen=True)
class FetchRecord:
    """`manifests/fetched.json`: which files of a published buffer set a copy of it holds."""

    format_version: Annotated[int, "Of the files."]
    location: Annotated[str, "The repository with its commit, `namespace/name@…`."]
    files: Annotated[tuple[str, ...], "Paths of the files, sorted."]


@dataclass(frozen=True)
class ManifestHeader:
    """Content of `manifests/manifest.json`: how the buffers of a buffer set were planned."""

    format_version: Annotated[int, "Version of the file format."]
    rule_version: Annotated[int, "Version of the rule of the draw."]
    seed: Annotated[int, "Seed of the draw."]
    conditions: Annotated[tuple[str, ...], "Names of the planned conditions, in order."]
    position_limit: Annotated[int | None, "Most frames of history and rollout together, or None."]
    datasets: Annotated[dict[str, ManifestDataset], "The datasets by name."]
    counts: Annotated[dict[str, int], "Numbers of `queries`, `buffers` and `sessions`."]
    rows: Annotated[str, "SHA-256 of `buffers.parquet`."]
    questions: Annotated[str | None, "SHA-256 of `questions.parquet`; None without one."] = None
