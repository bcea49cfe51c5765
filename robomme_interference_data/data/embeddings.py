"""Image features stored beside a dataset (its index), and the embeddings computed from them.

`robomme-interference index` writes an index; reading one needs only numpy. An index depends on its
dataset, encoder and camera. Every episode has its own file (`docs/reference/file-layout.md`).
Only this module turns features into embeddings, both of stored frames and of live images.
"""

import shlex
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import CAMERA_PREFIX, DATASETS, DISTRACTORS, INDEX_HEADER
from robomme_interference_data.errors import (
    FormatError,
    InvalidOptionError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.storage.arrays import read_array
from robomme_interference_data.storage.files import Files, LocalFiles, read_sums, sha256_file
from robomme_interference_data.storage.text import read_header

from .dataset import Dataset
from .index_layout import (
    CENTER_FILE,
    INDEX_SUMS,
    IndexHeader,
    encoder_id,
    episode_file,
    index_folder,
)


def center_of(episodes: Iterable[NDArray[np.float16]]) -> NDArray[np.float32]:
    """Return the mean of each episode's mean, `(D,) float32`, of features `(T, D) float16`."""
    # Sums of float16 would lose most digits, and depend on the order of the values.
    means = [features.mean(axis=0, dtype=np.float64) for features in episodes if len(features)]
    return np.asarray(sum(means) / max(len(means), 1), np.float32)


def normalized(
    features: NDArray[Any], center: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Turn features `(T, D)` into embeddings of length 1, `(T, D) float32`, less a center `(D,)`.

    Features are first rounded as an index stores them, so that equal images have equal embeddings,
    stored or live. A row that is zero after centering stays zero.
    """
    values = features.astype(np.float16, copy=False).astype(np.float32)
    if center is not None:
        values -= center
    lengths = np.sqrt(np.einsum("td,td->t", values, values))
    values /= np.where(lengths > 0, lengths, 1)[:, None]
    return values


class EmbeddingIndex:
    """The features of every stored frame of a dataset, for one camera and one encoder.

    `remedy` is the hint and the command of errors: how to make the index.
    """

    def __init__(self, files: Files, revision: str, encoder: str, camera: str):
        self._files = files
        self._checked: set[str] = set()
        self._folder = index_folder(encoder, camera)
        self._path_shown = f"{files.describe()}/{self._folder}"
        camera = camera.removeprefix(CAMERA_PREFIX)
        self.remedy = _remedy(files, encoder, camera)
        try:
            path = files.path(f"{self._folder}/{INDEX_HEADER}")
        except MissingFileError:
            raise MissingFileError(
                f"{files.describe()} has no embeddings of encoder {encoder!r} and camera "
                f"{camera!r}",
                *self.remedy,
            ) from None
        try:
            self.header = read_header(path, IndexHeader)
        except FormatError as error:
            raise FormatError(error.message, *self.remedy) from None
        recorded = self.header.encoder.name, self.header.camera, self.header.revision
        expected = encoder_id(encoder), camera, revision
        if recorded != expected:
            shown = "encoder {!r}, camera {!r}, data with revision {:.12}…"
            raise MissingFileError(
                f"the embeddings in {self._path_shown} are of {shown.format(*recorded)}; expected "
                f"{shown.format(*expected)}",
                *self.remedy,
            )

    @property
    def key(self) -> tuple[str, int]:
        """Only the embeddings of indexes with equal keys are compared."""
        return self.header.encoder.sha256, self.header.size

    @cached_property
    def center(self) -> NDArray[np.float32] | None:
        """What is subtracted from features before they are normalized, see `center_of`.

        None except in an index of distractor units by an encoder that is centered.
        """
        if CENTER_FILE not in self._sums:
            return None
        return self._array(CENTER_FILE, (self.header.size,), np.float32)

    @property
    def typical_cosine(self) -> float:
        """`IndexHeader.typical_cosine` of distractor units."""
        if self.header.typical_cosine is None:
            raise self._damaged(f"{INDEX_HEADER} has no typical cosine")
        return self.header.typical_cosine

    def span(self, episode_index: int, start: int, stop: int) -> NDArray[np.float16]:
        """Return the features of stored frames `start` to `stop` (excluded), `(T, D) float16`."""
        name = episode_file(episode_index)
        features: NDArray[np.float16] = np.empty((0, self.header.size), np.float16)
        if name in self._sums:
            features = self._array(name, (-1, self.header.size), np.float16)
        if not 0 <= start <= stop <= len(features):
            raise UnknownNameError(
                f"frames {start} to {stop - 1} of episode {episode_index} are not in "
                f"{self._path_shown}, which has {len(features)} frames of that episode",
                *self.remedy,
            )
        return features[start:stop].copy()

    def check(
        self, lengths: dict[int, int], *, units: bool, held: Iterable[int] | None = None
    ) -> None:
        """Check every file against its SHA-256, and the number of frames of every episode.

        Args:
            lengths: The stored frames by episode.
            units: Whether they are distractor units.
            held: The episodes whose files are there, in a partial copy; None for all.
        """
        header, typical = self.header, self.header.typical_cosine
        finite = typical is None or np.isfinite(typical)
        if not finite or header.sha256 != header.digest():
            raise self._damaged(f"{INDEX_HEADER} does not have the SHA-256 that it records")
        if (typical is not None) != units:
            raise self._damaged(f"the typical cosine is {typical}")
        present = [*lengths] if held is None else [*held]
        center_files = {CENTER_FILE} if units else set[str]()
        expected = {*map(episode_file, lengths)} | center_files
        listed = {name.removeprefix(f"{self._folder}/") for name in self._files.list(self._folder)}
        absent = {episode_file(episode) for episode in lengths.keys() - {*present}}
        known = {*self._sums, INDEX_HEADER, INDEX_SUMS}
        if extra := sorted((listed ^ known) - absent | (self._sums.keys() - expected)):
            raise self._damaged(f"{extra[0]} is missing, or too many")
        spans = [self.span(episode, 0, lengths[episode]) for episode in present]
        whole = len(present) == len(lengths)
        if whole and self.center is not None and not np.array_equal(self.center, center_of(spans)):
            raise self._damaged(f"{CENTER_FILE} is not the mean of the episodes")
        if header.frames != sum(lengths.values()):
            raise self._damaged(f"{header.frames} frames; the dataset has {sum(lengths.values())}")

    @cached_property
    def _sums(self) -> dict[str, str]:
        path = self._path(INDEX_SUMS)
        if sha256_file(path) != self.header.sums:
            raise self._damaged(f"{INDEX_SUMS} does not have the SHA-256 in {INDEX_HEADER}")
        return read_sums(path)

    def _array(self, name: str, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        path, first = self._path(name), name not in self._checked
        if first and sha256_file(path) != self._sums[name]:
            raise self._damaged(f"{name} does not have the SHA-256 in {INDEX_SUMS}")
        try:
            array = read_array(path, dtype, shape)
        except FormatError as error:
            raise self._damaged(error.message) from None
        # One value that is no number would make every cosine with it none.
        if first and not np.isfinite(array).all():
            raise self._damaged(f"{name} holds numbers that are not finite")
        self._checked.add(name)
        return array

    def _path(self, name: str) -> Path:
        try:
            return self._files.path(f"{self._folder}/{name}")
        except MissingFileError as error:
            raise self._damaged(error.message) from None

    def _damaged(self, what: str) -> FormatError:
        return FormatError(f"{self._path_shown}: {what}", *self.remedy)


_opened: WeakKeyDictionary[Dataset, dict[tuple[str, str], EmbeddingIndex]] = WeakKeyDictionary()
"""The indexes that were opened: a file that was checked is not hashed again."""


def open_index(dataset: Dataset, encoder: str, camera: str | None = None) -> EmbeddingIndex:
    """Return the embeddings of a dataset's stored frames, opened once.

    Args:
        dataset: The dataset.
        encoder: Name of the encoder, such as `thumbnail`.
        camera: Name of the camera; None for the first.

    Raises:
        UnknownNameError: There is no such camera.
        MissingFileError: The dataset has no embeddings of this encoder and camera, or they were
            made of other data or with another encoder.
        FormatError: They are of an unknown version, or damaged.
    """
    if not isinstance(encoder, str):
        raise InvalidOptionError.expected("encoder", encoder, "its name, such as 'thumbnail'")
    key = encoder, dataset.camera(camera)
    indexes = _opened.setdefault(dataset, {})
    if key not in indexes:
        indexes[key] = EmbeddingIndex(dataset.files, dataset.revision, *key)
    return indexes[key]


class BufferSetIndex:
    """The indexes of a buffer set's datasets, for one encoder and camera.

    Args:
        datasets: The datasets that are needed, among them the distractor units, whose index
            (`units`) has the center and the typical cosine of all.
        encoder: Name of the encoder, such as `thumbnail`.
        camera: Name of the camera; None for the first.
    """

    def __init__(self, datasets: Mapping[str, Dataset], encoder: str, camera: str | None):
        if DISTRACTORS not in datasets:
            raise MissingFileError(f"embeddings need the {DISTRACTORS}, which are missing")
        self._indexes = {
            name: open_index(dataset, encoder, camera) for name, dataset in datasets.items()
        }
        self.units = self._indexes[DISTRACTORS]
        for name, index in self._indexes.items():
            if index.key != self.units.key:
                locations = (datasets[kind].files.describe() for kind in (name, DISTRACTORS))
                raise MissingFileError(
                    f"the embeddings of encoder {encoder!r} were made differently in "
                    f"{' and in '.join(locations)}",
                    *index.remedy,
                )

    @property
    def size(self) -> int:
        """Values in an embedding."""
        return self.units.header.size

    def embed(self, features: NDArray[Any]) -> NDArray[np.float32]:
        """Return the embeddings, `(T, size) float32`, of features that the encoder computed."""
        return normalized(features, self.units.center)

    def span(self, dataset: str, episode_index: int, start: int, stop: int) -> NDArray[np.float32]:
        """Return the embeddings of stored frames `start` to `stop` (excluded), `(T, size)`."""
        return self.embed(self._indexes[dataset].span(episode_index, start, stop))


def _remedy(files: Files, encoder: str, camera: str) -> tuple[str, str]:
    """Return how a dataset gets an index; those of a buffer set are indexed together."""
    hint, folder = "Embed the frames of all its datasets (again).", "FOLDER"
    if isinstance(files, LocalFiles):
        folder = str(files.root.parent if files.root.name in DATASETS else files.root)
    else:
        hint = f"Fetch {files.describe()} and embed its frames, or ask its publisher to."
    option = "" if camera == "front" else f" --camera {camera}"
    return hint, f"index {shlex.quote(str(folder))} --encoder {encoder}{option}"
