"""The stored values of several datasets, one after another.

A *row* is a frame of any dataset of the buffer set: rows of the datasets follow one another. Rows
of one session are read together, from one file of the cache of decoded frames.
"""

import os
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor, as_completed
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import CAMERA_PREFIX, DEMONSTRATIONS, STATE
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.frame_reader import cached_session, check_session
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.schema.other_states import OtherStates, fit_states
from robomme_interference_data.storage.arrays import FeatureDigests
from robomme_interference_data.storage.cache import DecodedCache
from robomme_interference_data.storage.resize import resize

PADDING = -1
"""The row of a place without a frame."""


class _Span(NamedTuple):
    """Rows that are read together: a session, or the query frame after it."""

    dataset: str
    episode: int
    start: int
    stop: int


class _Vectors(NamedTuple):
    """Vectors of all rows, `(R + 1, D) float32`, and of which spans they are read."""

    values: NDArray[np.float32]
    known: NDArray[np.bool_]


class StoredRows:
    """The stored values of several datasets, by row; opened, and stored, when first used.

    Args:
        datasets: The datasets by name, in the order of their rows.
        cache: Where decoded and resized frames are.
        size: Side of resized images in pixels; None for no change of size.
        other_states: What takes the place of states of units of another robot, see `other_states`
            in the schema.

    Attributes:
        datasets: The datasets by name.
    """

    def __init__(
        self,
        datasets: Mapping[str, Dataset],
        cache: DecodedCache,
        size: int | None,
        other_states: OtherStates = "refuse",
    ):
        self.datasets, self._cache, self._size = dict(datasets), cache, size
        self._other_states = other_states
        self._first: dict[str, list[int]] = {}
        self._spans: list[_Span] = []
        starts, self._total = [], 0
        for name, dataset in self.datasets.items():
            self._first[name] = []
            for record in dataset.records():
                self._first[name].append(self._total)
                stop = record.session[1]
                for span in ((0, stop), (stop, record.length)):
                    if span[0] < span[1]:
                        self._spans.append(_Span(name, record.episode_index, *span))
                        starts.append(self._total + span[0])
                self._total += record.length
        self._starts = np.array(starts)
        self._frames: defaultdict[str, list[NDArray[np.uint8] | None]]
        self._frames = defaultdict(lambda: [None] * len(self._spans))
        self._vectors: dict[str, _Vectors] = {}

    def first(self, dataset: str, episode: int) -> int:
        """Return the row of an episode's first frame."""
        return self._first[dataset][episode]

    def prepare(self, features: Iterable[str], rows: NDArray[np.int64], *, quiet: bool) -> None:
        """Open features of the sessions of some rows, on several threads, with a progress bar.

        Raises:
            InvalidOptionError: They do not fit into the cache.
            HashMismatchError: Frames or vectors differ from the recorded ones.
            OSError: The disk is full.
        """
        features, used = list(features), np.unique(self._owner(rows)).tolist()
        cameras = [feature for feature in features if _is_camera(feature)]
        self._check_fits(cameras, used)
        episodes: dict[str, list[int]] = {}
        for number in used:
            episodes.setdefault(self._spans[number].dataset, []).append(self._spans[number].episode)
        for name, dataset in self.datasets.items():
            files = (dataset.files_of(episode, cameras) for episode in episodes.get(name, ()))
            dataset.files.fetch(path for paths in files for path in paths)
        with (
            WorkProgress(unit="sessions", quiet=quiet) as progress,
            ThreadPoolExecutor(os.cpu_count()) as pool,
        ):
            try:
                for feature in features:
                    progress.start(feature.rpartition(".")[2], len(used))
                    open_span: Callable[[str, int], object] = self._open
                    if not _is_camera(feature):
                        self._table(feature, np.array(used))
                        open_span = self._read
                    opening = [pool.submit(open_span, feature, number) for number in used]
                    for opened in as_completed(opening):
                        opened.result()
                        progress.advance(1)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def of_same_sessions(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return all rows, in order, of the sessions and executions that some rows belong to."""
        spans = [self._spans[number] for number in np.unique(self._owner(rows)).tolist()]
        first = [self.first(span.dataset, span.episode) for span in spans]
        ranges = [np.arange(span.start, span.stop) for span in spans]
        return np.concatenate([a + b for a, b in zip(first, ranges, strict=True)])

    def take(self, feature: str, rows: NDArray[np.int64]) -> NDArray[Any]:
        """Return the values of rows, `(*rows.shape, …)`; 0 for `PADDING`.

        Images are `(3, H, W) uint8`, vectors `(D,) float32`.
        """
        if not _is_camera(feature):
            return self._vectors_of(feature, rows)
        flat = rows.ravel()
        owner = self._owner(flat)
        local = flat - self._starts[owner]
        # Run by run of rows of the same span; PADDING belongs to none, number -1.
        bounds = [*np.diff(owner, prepend=len(self._spans)).nonzero()[0].tolist(), len(flat)]
        numbers, opened = owner[bounds[:-1]].tolist(), self._frames[feature]
        shape = self._shape(self.datasets[self._spans[max(numbers)].dataset], feature)
        out = np.empty((len(flat), *shape), np.uint8)
        for number, (start, stop) in zip(numbers, pairwise(bounds), strict=True):
            if number < 0:
                out[start:stop] = 0
                continue
            frames = opened[number]
            if frames is None:
                frames = self._open(feature, number)
            # The mode lets numpy write into `out` without a copy in between.
            frames.take(local[start:stop], axis=0, out=out[start:stop], mode="clip")
        return out.reshape(*rows.shape, *shape)

    def _vectors_of(self, feature: str, rows: NDArray[np.int64]) -> NDArray[np.float32]:
        """Return the vectors of rows; they are few bytes, so all that are used are in memory."""
        numbers = np.unique(self._owner(rows))
        numbers = numbers[numbers >= 0]
        vectors = self._table(feature, numbers)
        for number in numbers[~vectors.known[numbers]].tolist():
            self._read(feature, number)
        return vectors.values[rows]  # the last one, that of PADDING, is 0

    def _table(self, feature: str, numbers: NDArray[np.int64]) -> _Vectors:
        if feature not in self._vectors:
            dataset = self.datasets[self._spans[int(numbers.max(initial=0))].dataset]
            values = np.zeros((self._total + 1, *self._shape(dataset, feature)), np.float32)
            self._vectors[feature] = _Vectors(values, np.zeros(len(self._spans), bool))
        return self._vectors[feature]

    def _owner(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the numbers of the spans that rows belong to; -1 for `PADDING`."""
        return self._starts.searchsorted(rows, "right") - 1

    def _open(self, feature: str, number: int) -> NDArray[np.uint8]:
        """Open the images of a span, and return them."""
        frames = self._frames[feature][number] = self._images(feature, self._spans[number])
        return frames

    def _read(self, feature: str, number: int) -> None:
        """Read the vectors of a span."""
        first, span = int(self._starts[number]), self._spans[number]
        vectors = self._vectors[feature]
        vectors.values[first : first + span.stop - span.start] = self._stored(feature, span)
        vectors.known[number] = True

    def _images(self, feature: str, span: _Span) -> NDArray[np.uint8]:
        dataset = self.datasets[span.dataset]
        if span.start == 0:
            shape = self._shape(dataset, feature)
            return cached_session(
                self._cache, dataset, span.episode, feature, shape, self._converted
            )
        # One frame, of which no digest of its own is recorded: not worth a file.
        frames = dataset.iter_frames(span.episode, feature, span.start, span.stop)
        return np.stack([self._converted(frame) for frame in frames])

    def _stored(self, feature: str, span: _Span) -> NDArray[np.float32]:
        dataset, digests = self.datasets[span.dataset], FeatureDigests()
        record = dataset.record(span.episode)
        values = dataset.read_vectors(span.episode, feature, 0, record.length)
        digests.update(feature, values[slice(*record.session)])
        check_session(dataset, record, feature, digests)
        values = values[span.start : span.stop]
        if feature != STATE:
            return values
        (size,) = self._shape(dataset, STATE)
        return fit_states(values, size, self._other_states)

    def _converted(self, frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return resize(frame[None], self._size)[0]

    def _shape(self, dataset: Dataset, feature: str) -> tuple[int, ...]:
        if feature == STATE:  # the query's number of values, also of units of another robot
            return self.datasets.get(DEMONSTRATIONS, dataset).features[STATE]
        if not _is_camera(feature):
            return dataset.features[feature]
        height, width, _ = dataset.shape(feature)
        return 3, self._size or height, self._size or width

    def _check_fits(self, cameras: list[str], used: list[int]) -> None:
        """Check that the cache can hold everything at once: else each start would decode again."""
        size = 0
        for number in used:
            span = self._spans[number]
            for camera in cameras:
                frame = self._shape(self.datasets[span.dataset], camera)
                size += (span.stop - span.start) * int(np.prod(frame))
        if size > self._cache.max_bytes:
            bound = self._cache.max_bytes
            raise InvalidOptionError(
                f"the used frames have {size / 1e9:,.1f} GB, the cache {bound / 1e9:,.1f} GB",
                "Use smaller images, fewer episodes or conditions, or a larger cache: "
                f"cache=DecodedCache(max_bytes={size * 11 // 10})",
                option="cache",
            )


def _is_camera(feature: str) -> bool:
    return feature.startswith(CAMERA_PREFIX)
