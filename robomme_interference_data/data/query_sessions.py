"""The sessions of history buffers, drawn from datasets: no manifest is needed.

Rules 1 to 5 of the protocol; the draw itself is `schema/draw.py`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DEMONSTRATIONS,
    DISTRACTORS,
    RAW_DISTRACTORS,
    UNIT_FRAMES,
)
from robomme_interference_data.errors import FormatError, SourceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import Condition
from robomme_interference_data.schema.draw import UnitPool
from robomme_interference_data.schema.manifest import BufferManifest, SessionEntry
from robomme_interference_data.schema.records import EpisodeRecord

from .dataset import Dataset
from .query import Query

_ROLES = {
    DEMONSTRATIONS: "lesson",
    DISTRACTORS: "distractor",
    RAW_DISTRACTORS: "distractor",
    CONTRADICTIONS: "contradiction",
}
"""What a session is to a query, by the dataset that it is of."""


@dataclass(frozen=True)
class SessionSource:
    """Datasets that sessions are drawn from.

    Attributes:
        datasets: The datasets of a buffer set by name: the query episodes, and what sessions are of.
        seed: Seed of the draw.
    """

    datasets: Mapping[str, Dataset]
    seed: int = 0

    @cached_property
    def pool(self) -> UnitPool:
        """The units, to be drawn."""
        return UnitPool((one.episode_id for one in self.datasets[DISTRACTORS].records()), self.seed)

    def session(self, dataset: str, episode: EpisodeId) -> SessionEntry:
        """Return the session that an episode of a dataset is; contradictions by their query."""
        if dataset not in self._sessions:
            one = self.datasets[dataset]
            self._sessions[dataset] = {
                record.episode_id.scene: one.session(_ROLES[dataset], record)
                for record in one.records()
            }
        found = self._sessions[dataset].get(episode)
        if found is None:
            raise SourceError(
                f"{self.datasets[dataset].files.describe()} does not hold {episode}, of which a "
                "session is needed",
                "Build it of the same episodes.",
                f"build {dataset}",
            )
        return found

    @cached_property
    def _sessions(self) -> dict[str, dict[EpisodeId, SessionEntry]]:
        return {}


class QuerySessions:
    """The sessions that conditions give one query; see `conditions.SessionProvider`.

    Args:
        source: What they are drawn from.
        record: Record of the query episode.
    """

    def __init__(self, source: SessionSource, record: EpisodeRecord):
        self._source = source
        self._record = record
        self._drawn: dict[bool, list[EpisodeId]] = {False: [], True: []}

    def buffer(self, condition: Condition) -> BufferManifest:
        """Return the buffer of the query under a condition."""
        datasets, record = self._source.datasets, self._record
        sessions = condition.sessions(self)
        exact = record.exact and all(
            datasets[one.dataset].record(one.episode_index).exact for one in sessions
        )
        return Query(datasets[DEMONSTRATIONS], record).manifest(condition, sessions, exact=exact)

    def lesson(self, part: str = "lesson") -> SessionEntry:
        """Return the lesson, or a part of it."""
        record = self._record
        whole = self._source.session(DEMONSTRATIONS, record.episode_id)
        if part == "lesson":
            return whole
        if part not in record.spans or record.span_sha256 is None:
            where = self._source.datasets[DEMONSTRATIONS].files.describe()
            raise FormatError.damaged(where, f"{record.episode_id}: no digests of its parts")
        start, stop = record.spans[part]
        sha256 = getattr(record.span_sha256, part)
        found = replace(whole, start=start, stop=stop, sha256=sha256)
        return replace(found, role="filler", repeat=UNIT_FRAMES) if part == "last" else found

    def units(self, k: int, dataset: str = DISTRACTORS) -> Sequence[SessionEntry]:
        """Return the units that are drawn for the query, or the raw ones of the same episodes."""
        return [self._source.session(dataset, unit) for unit in self._draw(k, own=False)]

    def own_units(self, k: int) -> Sequence[SessionEntry]:
        """Return the units of the query's own family that are drawn for it."""
        return [self._source.session(DISTRACTORS, unit) for unit in self._draw(k, own=True)]

    def contradiction(self) -> SessionEntry:
        """Return the lesson in the query's scene with another answer."""
        return self._source.session(CONTRADICTIONS, self._record.episode_id)

    def _draw(self, k: int, *, own: bool) -> Sequence[EpisodeId]:
        if k > len(self._drawn[own]):  # fewer begin those that are drawn
            draw = self._source.pool.draw_own if own else self._source.pool.draw
            self._drawn[own] = draw(self._record.episode_id, k)
        return self._drawn[own][:k]
