"""Which stored frames the history of each query holds under each condition.

A *row* is a frame of any dataset of the buffer set: rows of the datasets follow one another.
"""

import hashlib
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DEMONSTRATIONS
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.query_sessions import QuerySessions, SessionSource
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.retrieval.selector import StoredSelector
from robomme_interference_data.runtime.progress import WorkProgress
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.shifts import Shift

from .frame_store import first_rows, stored_values


@dataclass(frozen=True)
class History:
    """The history of a query that a memory gets, which a retrieval step may have shortened.

    Attributes:
        rows: The rows of its frames in order, `(T,) int64`.
        evidence: Which parts of the answer each frame shows, `(T, P) bool`; None if unknown.
    """

    rows: NDArray[np.int64]
    evidence: NDArray[np.bool_] | None


PADDING = -1
"""The row of a place without a frame."""


class Rows:
    """The stored values of several datasets, by row."""

    def __init__(self, datasets: Mapping[str, Dataset]):
        self._datasets = dict(datasets)
        self._first: dict[str, NDArray[np.int64]] = {}
        starts, total = [], 0
        for name, dataset in self._datasets.items():
            self._first[name] = total + first_rows(dataset)
            starts.append(total)
            total = int(self._first[name][-1])
        self._starts = np.array(starts)
        self._values: dict[str, list[NDArray[Any] | None]] = {}

    def first(self, dataset: str, episode: int) -> int:
        """Return the row of an episode's first frame."""
        return int(self._first[dataset][episode])

    def load(
        self,
        feature: str,
        folder: Path,
        size: int | None,
        progress: WorkProgress,
        names: Collection[str] | None = None,
    ) -> None:
        """Open a feature of all datasets, or of those with these names; see `stored_values`."""
        self._values[feature] = [
            np.asarray(stored_values(dataset, feature, folder, size, progress))
            if names is None or name in names
            else None
            for name, dataset in self._datasets.items()
        ]

    def take(self, feature: str, rows: NDArray[np.int64]) -> NDArray[Any]:
        """Return the values of rows, `(*rows.shape, …)`; 0 for `PADDING`."""
        arrays, flat = self._values[feature], rows.ravel()
        some = next(one for one in arrays if one is not None)
        out = np.empty((len(flat), *some.shape[1:]), some.dtype)
        # Run by run of rows of the same dataset; PADDING belongs to none, number -1.
        owner = self._starts.searchsorted(flat, "right") - 1
        local = flat - self._starts[owner]
        bounds = [*np.diff(owner, prepend=len(arrays)).nonzero()[0].tolist(), len(flat)]
        for start, stop in pairwise(bounds):
            if (number := owner[start]) < 0:
                out[start:stop] = 0
                continue
            values = arrays[number]
            assert values is not None
            # The mode lets numpy write into `out` without a copy in between.
            values.take(local[start:stop], axis=0, out=out[start:stop], mode="clip")
        return out.reshape(*rows.shape, *out.shape[1:])


class Histories:
    """The histories of buffers: of planned ones, or with units drawn anew.

    Args:
        buffer_set: The buffer set.
        rows: The rows of its datasets.
        retrieval: A retrieval step, or None.

    Attributes:
        parts: Most parts P of an answer, at least 1.
    """

    def __init__(self, buffer_set: BufferSet, rows: Rows, retrieval: StoredSelector | None):
        self._set, self._rows, self._retrieval = buffer_set, rows, retrieval
        spans = (
            span
            for record in buffer_set.datasets[DEMONSTRATIONS].records()
            for span in record.evidence or ()
        )
        self.parts = max((span.part + 1 for span in spans), default=1)

    def draw(
        self, source: SessionSource, episode: EpisodeId, condition: str, shift: Shift | None
    ) -> History:
        """Return the history of a query with sessions of another source than the manifests."""
        query = self._set.query(episode)
        manifest = QuerySessions(source, query.record).buffer(parse_condition(condition))
        return self.of(Buffer(manifest, query, self._set.datasets), shift)

    def of(self, buffer: Buffer, shift: Shift | None) -> History:
        """Return the history of a buffer's query, as the retrieval step leaves it."""
        rows = buffer.gather(
            lambda one: self._rows.first(one.dataset, one.episode_index)
            + np.arange(one.start, one.stop),
            np.empty(0, np.int64),
        )
        evidence: NDArray[np.bool_] | None = None
        if buffer.evidence is not None:
            evidence = np.zeros((len(rows), self.parts), bool)
            for one in buffer.evidence:
                if one.session.role != "contradiction":
                    evidence[one.start : one.stop, one.span.part] = True
        if self._retrieval is not None and len(rows):
            chosen = self._retrieval.select(self._set, buffer, shift)
            rows, evidence = rows[chosen], evidence if evidence is None else evidence[chosen]
        return History(rows, evidence)


@dataclass(frozen=True)
class Weights:
    """Names with the probabilities with which they are drawn."""

    names: tuple[str, ...]
    cumulative: tuple[float, ...]

    @classmethod
    def parse(cls, option: str, given: Mapping[str, float] | Sequence[str] | str) -> "Weights":
        """Read weights by name, or names with equal weights."""
        if isinstance(given, str):
            given = (given,)
        weights = dict(given) if isinstance(given, Mapping) else dict.fromkeys(given, 1.0)
        numbers = [one for one in weights.values() if isinstance(one, Real)]
        if len(numbers) < len(weights) or not all(0 < one < math.inf for one in numbers):
            expected = "a positive weight for each name, such as {'k0': 1, 'k7': 2}"
            raise InvalidOptionError.expected(option, given, expected)
        if not weights:
            raise InvalidOptionError.expected(option, given, "at least one name")
        sums = np.cumsum(numbers) / sum(numbers)
        return cls(tuple(weights), tuple(sums.tolist()))

    def draw(self, *key: int | str) -> str:
        """Return the name that a key draws, the same on every machine."""
        if len(self.names) == 1:
            return self.names[0]
        lot = (number_from(*key) >> 11) / 2**53
        numbers = (n for n, stop in enumerate(self.cumulative) if lot < stop)
        return self.names[next(numbers, len(self.names) - 1)]


def number_from(*key: int | str) -> int:
    """Return an integer of 64 bits that follows from a key, evenly distributed."""
    text = "\n".join(map(str, key))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest())
