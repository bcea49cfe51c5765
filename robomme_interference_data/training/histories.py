"""Which stored frames the history of each query holds under each condition.

See `rows` for what a row is.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    CONTRADICTIONS,
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    SHIFTED,
)
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.query_sessions import QuerySessions, SessionSource
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.retrieval.stored_selector import StoredSelector
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.manifest import SessionEntry
from robomme_interference_data.schema.shifts import Shift

from .draws import number_from
from .rows import StoredRows

_HistoryKey = tuple[EpisodeId, str, Shift | None]
"""Query episode, condition, and the shift of what a retrieval step matches, see `get`."""


@dataclass(frozen=True)
class DrawnHistory:
    """The history of a query that a memory gets, which a retrieval step may have shortened.

    Attributes:
        rows: The rows of its frames in order, `(T,) int64`.
        evidence: Which parts of the answer each frame shows, `(T, P) bool`; None if unknown.
    """

    rows: NDArray[np.int64]
    evidence: NDArray[np.bool_] | None


class Histories:
    """The histories of queries: the planned ones, or with units drawn anew in every epoch.

    Args:
        buffer_set: The buffer set.
        rows: The rows of its datasets.
        retrieval: A retrieval step, or None.
        redraw: The seed of the draws, and the train episodes whose units may be drawn (None for
            all); None for the planned histories.

    Attributes:
        parts: Most parts P of an answer, at least 1.
    """

    def __init__(
        self,
        buffer_set: BufferSet,
        rows: StoredRows,
        retrieval: StoredSelector | None,
        redraw: tuple[int, frozenset[int] | None] | None,
    ):
        self._set, self._rows, self._retrieval = buffer_set, rows, retrieval
        self._redraw, self._known = redraw, dict[_HistoryKey, DrawnHistory]()
        self._drawing: tuple[int, SessionSource] | None = None  # epoch, and what its draws are of
        spans = (
            span
            for record in buffer_set.datasets[DEMONSTRATIONS].records()
            for span in record.evidence or ()
        )
        self.parts = max((span.part + 1 for span in spans), default=1)

    def longest(self, conditions: Sequence[str], episodes: Collection[EpisodeId]) -> int:
        """Return the most frames of a history, planned or drawn in any epoch."""
        if self._redraw is None:
            return max(len(history.rows) for history in self._known.values())
        source = SessionSource(self._set.datasets, 0, self._redraw[1])
        return max(
            sum(
                session.num_frames
                for session in parse_condition(name).sessions(
                    _LongestSessions(source, self._set.query(episode).record)
                )
            )
            for name in conditions
            for episode in episodes
        )

    def rows_in_use(self, episodes: Collection[EpisodeId]) -> NDArray[np.int64]:
        """Return rows, at least one of each session that histories of these episodes may have."""
        if self._redraw is None:
            return self.rows
        queries, units = frozenset(episodes), self._redraw[1]
        first = []
        for name, dataset in self._rows.datasets.items():
            if name in (EXECUTIONS, SHIFTED):  # of which no history has a session
                continue
            for record in dataset.records():
                episode = record.episode_id
                if name in (DEMONSTRATIONS, CONTRADICTIONS):
                    used = episode.scene in queries
                else:
                    used = units is None or episode.index in units
                if used:
                    first.append(self._rows.first(name, record.episode_index))
        return np.array(first, np.int64)

    @property
    def rows(self) -> NDArray[np.int64]:
        """The rows of all planned histories; none if they are drawn anew."""
        if self._redraw is not None:
            return np.empty(0, np.int64)
        return np.concatenate([history.rows for history in self._known.values()])

    def plan(
        self,
        conditions: Sequence[str],
        episodes: Collection[EpisodeId],
        shifts: Collection[Shift | None],
        *,
        quiet: bool,
    ) -> None:
        """Lay out the planned histories of some query episodes, with a progress bar."""
        used = frozenset(episodes)
        with WorkProgress(quiet=quiet) as progress, progress.status("Laying out histories"):
            for buffer in self._set.buffers(condition=conditions):
                if buffer.episode_id in used:
                    for shift in shifts if self._retrieval else [None]:
                        key = buffer.episode_id, buffer.condition, shift
                        self._known[key] = self._of(buffer, shift)

    def get(
        self, epoch: int, episode: EpisodeId, condition: str, shift: Shift | None
    ) -> DrawnHistory:
        """Return the history of a query, planned or drawn in this epoch.

        `shift` is that of the first live observation, on which the choice of a retrieval step
        depends.
        """
        key = episode, condition, shift if self._retrieval else None
        if self._redraw is None:
            return self._known[key]
        if self._drawing is None or self._drawing[0] != epoch:
            seed, units = self._redraw
            source = SessionSource(self._set.datasets, number_from("draw", seed, epoch), units)
            # Those of an earlier epoch are not drawn again.
            self._drawing, self._known = (epoch, source), {}
        if key not in self._known:
            query, source = self._set.query(episode), self._drawing[1]
            manifest = QuerySessions(source, query.record).buffer(parse_condition(condition))
            self._known[key] = self._of(Buffer(manifest, query, self._set.datasets), shift)
        return self._known[key]

    def _of(self, buffer: Buffer, shift: Shift | None) -> DrawnHistory:
        """Return the history of a buffer's query, as the retrieval step leaves it."""
        rows = buffer.gather(
            lambda session: (
                self._rows.first(session.dataset, session.episode_index)
                + np.arange(session.start, session.stop)
            ),
            np.empty(0, np.int64),
        )
        evidence: NDArray[np.bool_] | None = None
        if buffer.evidence is not None:
            evidence = np.zeros((len(rows), self.parts), bool)
            for entry in buffer.evidence:
                # A contradicting lesson shows parts of another answer.
                if entry.session.role != "contradiction":
                    evidence[entry.start : entry.stop, entry.span.part] = True
        if self._retrieval is not None and len(rows):
            chosen = self._retrieval.select(self._set, buffer, shift)
            rows, evidence = rows[chosen], evidence if evidence is None else evidence[chosen]
        return DrawnHistory(rows, evidence)


class _LongestSessions(QuerySessions):
    """The sessions of a query, with the longest unit in the place of any that may be drawn."""

    def units(self, k: int, dataset: str = DISTRACTORS) -> Sequence[SessionEntry]:
        longest = self._source.longest(dataset)
        return [longest for _ in range(k)]

    def own_units(self, k: int) -> Sequence[SessionEntry]:
        return self.units(k)
