"""The stored values of several datasets, one after another.

A *row* is a frame of any dataset of the buffer set: rows of the datasets follow one another.
"""

from collections.abc import Collection, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.runtime.progress import WorkProgress

from .frame_store import first_rows, stored_values

PADDING = -1
"""The row of a place without a frame."""


class StoredRows:
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
        some = next(array for array in arrays if array is not None)
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
