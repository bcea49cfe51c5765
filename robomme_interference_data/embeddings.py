"""Look up the embeddings of stored frames: the index that lies beside a dataset's frames.

An index is made by `robomme-interference index` (the retrieval area); reading it needs numpy and
pyarrow only. `docs/format.md` lists its files.
"""

import re
from functools import cached_property
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from numpy.typing import NDArray

from robomme_interference_data import parquet
from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    DEMONSTRATIONS,
    DISTRACTORS,
    FORMAT_VERSION,
    INDEX_CENTRE,
    INDEX_DIR,
    INDEX_EMBEDDINGS,
    INDEX_HEADER,
    INDEX_ROWS,
    PAPER_ENCODER,
)
from robomme_interference_data.errors import (
    FormatError,
    MissingFileError,
    MissingIndexError,
    StaleIndexError,
    UnknownNameError,
)
from robomme_interference_data.files import Files, LocalFiles, check_names, read_json, sha256_file

__all__ = ["EmbeddingIndex", "encoder_id", "index_folder", "normalised"]

_BLOCK = 4096
"""Embeddings that are looked through at a time."""

_HEADER_KEYS = (
    *("encoder", "computed", "camera", "revision", "pool"),
    *("frames", "size", "typical_cosine", "files"),
)


def encoder_id(encoder: str) -> str:
    """Return what an encoder is called wherever its model lies, without a revision.

    Args:
        encoder: Name of the encoder: `thumbnail`, `siglip`, or `siglip:` and the id of a model,
            with `@revision` or without, or its folder.

    Returns:
        `thumbnail`; `siglip` for the paper's model; `siglip:google/siglip2-base-patch16-224`;
        `siglip:NAME` for a folder of that name.
    """
    kind, _, model = encoder.partition(":")
    if not model:
        return kind
    if Path(model).is_dir():
        return f"{kind}:{Path(model).resolve().name}"
    model = model.partition("@")[0]
    return kind if model == PAPER_ENCODER else f"{kind}:{model}"


def index_folder(encoder: str, camera: str = "front") -> str:
    """Return where the index of an encoder and a camera lies inside a dataset.

    Args:
        encoder: Name of the encoder, see `encoder_id`; the last part of a model's id becomes part
            of the folder's name.
        camera: Camera, with or without `observation.images.`.

    Returns:
        `index/thumbnail`, `index/siglip`, `index/siglip-siglip2-base-patch16-224`,
        `index/thumbnail@wrist`, …
    """
    kind, colon, model = encoder_id(encoder).partition(":")
    name = f"{kind}-{PurePath(model).name}" if colon else kind
    camera = camera.removeprefix(CAMERA_PREFIX)
    parts = [name] if camera == "front" else [name, camera]
    return f"{INDEX_DIR}/{'@'.join(re.sub(r'[^A-Za-z0-9._-]+', '-', part) for part in parts)}"


def normalised(
    features: NDArray[Any], centre: NDArray[np.float32] | None = None
) -> NDArray[np.float16]:
    """Turn what an encoder makes of images into embeddings of length 1.

    Args:
        features: `(T, D)` float.
        centre: `(D,) float32`, taken off first, or None.

    Returns:
        `(T, D) float16`; a row of noughts, which resembles nothing, where nothing is left.
    """
    values = features.astype(np.float64)
    if centre is not None:
        values -= centre
    lengths = np.sqrt((values * values).sum(axis=1, keepdims=True))
    return (values / np.where(lengths > 0, lengths, 1)).astype(np.float16)


class EmbeddingIndex:
    """The embeddings of every stored frame of a dataset, of one camera and one encoder.

    Args:
        files: The dataset's files.
        revision: The dataset's identity, `Dataset.revision`.
        encoder: Name of the encoder, see `encoder_id`.
        camera: Camera, with or without `observation.images.`.

    Raises:
        MissingIndexError: The dataset has no index of this encoder and camera.
        StaleIndexError: The index was made of other data, or with another encoder.
        FormatError: It is of an unknown version, or damaged.
    """

    def __init__(self, files: Files, revision: str, encoder: str, camera: str = "front"):
        self._files = files
        self._folder = index_folder(encoder, camera)
        camera = camera.removeprefix(CAMERA_PREFIX)
        of = f"encoder {encoder!r}" + ("" if camera == "front" else f" and camera {camera!r}")
        option = "" if camera == "front" else f" --camera {camera}"
        self._remedy = (
            f"Type: robomme-interference index --data {_data_of(files)} --encoder {encoder}{option}"
        )
        try:
            path = files.path(f"{self._folder}/{INDEX_HEADER}")
        except MissingFileError:
            raise MissingIndexError(
                f"{self._root} has no embeddings of {of}", self._remedy
            ) from None
        try:
            self.header = read_json(path)
        except FormatError as error:
            raise self._damaged(error.message) from None
        if self.header.get("format_version") != FORMAT_VERSION:
            raise FormatError(
                f"{path} has format version {self.header.get('format_version')!r}; this package "
                f"reads {FORMAT_VERSION}",
                "Install the version of robomme-interference-data that wrote it, or make it "
                f"again. {self._remedy}",
            )
        try:
            check_names(path, self.header, _HEADER_KEYS)
        except FormatError as error:
            raise self._damaged(error.message) from None
        made = self.header["encoder"]["name"], self.camera.removeprefix(CAMERA_PREFIX)
        if made != (encoder_id(encoder), camera):
            raise StaleIndexError(
                f"the embeddings in {self._root}/{self._folder} are of encoder {made[0]!r} and "
                f"camera {made[1]!r}; expected {encoder_id(encoder)!r} and {camera!r}",
                f"Give the encoder as {made[0]!r}, or make them anew. {self._remedy}",
            )
        if self.header["revision"] != revision:
            raise StaleIndexError(
                f"the embeddings of {of} in {self._root} were made of data with "
                f"revision {str(self.header['revision'])[:12]}…; the data now has {revision[:12]}…",
                f"Make them again. {self._remedy}",
            )

    @property
    def _root(self) -> str:
        return self._files.describe()

    @property
    def camera(self) -> str:
        """Feature name of the camera that was embedded."""
        return str(self.header["camera"])

    @property
    def fingerprint(self) -> str:
        """SHA-256 over what determines the encoder's output; equal ones may be compared."""
        return str(self.header["encoder"]["sha256"])

    @property
    def made(self) -> tuple[str, str, str]:
        """What embeddings that are compared with each other share: encoder, camera and pool."""
        return self.fingerprint, self.camera, self.pool

    @property
    def pool(self) -> str:
        """Revision of the distractor units that `centre` and `typical_cosine` are of."""
        return str(self.header["pool"])

    @property
    def size(self) -> int:
        """Values in an embedding."""
        return int(self.header["size"])

    @property
    def typical_cosine(self) -> float:
        """Median cosine of two frames of different distractor units of the pool."""
        return float(self.header["typical_cosine"])

    @cached_property
    def centre(self) -> NDArray[np.float32] | None:
        """What is taken off the encoder's output before it is normalised, or None."""
        if INDEX_CENTRE not in self.header["files"]:
            return None
        centre = self._array(INDEX_CENTRE, (self.size,), np.float32)
        return np.array(centre)

    @cached_property
    def embeddings(self) -> NDArray[np.float16]:
        """All embeddings, `(frames, size) float16`, each of length 1; a read-only memory map.

        Their file is compared with its SHA-256 first, once.
        """
        shape = int(self.header["frames"]), self.size
        found = self._array(INDEX_EMBEDDINGS, shape, np.float16)
        for first in range(0, len(found), _BLOCK):
            if not np.isfinite(found[first : first + _BLOCK]).all():
                raise self._damaged(f"{self._root}/{self._folder} holds what is no finite number")
        return found

    def check(self) -> None:
        """Read all of it, and compare every file with its SHA-256.

        Raises:
            FormatError: A file is missing or damaged.
        """
        _ = self.embeddings, self.centre, self._first_rows

    @cached_property
    def _first_rows(self) -> dict[int, tuple[int, int]]:
        """For each episode, the row of its first frame and the number of its frames."""
        path = self._verified(INDEX_ROWS)
        names = ("episode_index", "frame", "row")
        try:
            with parquet.reading(path), pq.ParquetFile(path) as file:
                check_names(path, file.schema_arrow.names, names)
                table = file.read(columns=list(names))
                episodes, frames, rows = (table[name].to_numpy() for name in names)
        except FormatError as error:
            raise self._damaged(error.message) from None
        firsts = np.flatnonzero(np.diff(episodes, prepend=-1))
        counts = np.diff(firsts, append=len(episodes))
        expected = np.arange(len(episodes)) - np.repeat(firsts, counts)
        whole = (
            len(rows) == self.header["frames"]
            and len(np.unique(episodes)) == len(firsts)
            and np.array_equal(frames, expected)
            and np.array_equal(rows, np.arange(len(rows)))
        )
        if not whole:
            raise self._damaged(
                f"{path} does not list the frames of the episodes, one after the other"
            )
        starts = zip(episodes[firsts], firsts, counts, strict=True)
        return {int(episode): (int(first), int(count)) for episode, first, count in starts}

    def span(self, episode_index: int, start: int, stop: int) -> NDArray[np.float16]:
        """Return the embeddings of stored frames `start` to `stop` (excluded) of an episode.

        Returns:
            `(stop - start, size) float16`: a view into the memory map.

        Raises:
            UnknownNameError: The index does not hold these frames.
            FormatError: A file of the index is missing or damaged.
        """
        first, count = self._first_rows.get(episode_index, (0, 0))
        if not 0 <= start <= stop <= count:
            raise UnknownNameError(
                f"frames {start} to {stop - 1} of episode {episode_index} are not in "
                f"{self._root}/{self._folder}, which has {count} frames of that episode",
                f"It is damaged: make it again. {self._remedy}",
            )
        return self.embeddings[first + start : first + stop]

    def _array(self, name: str, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        path = self._verified(name)
        try:
            array = np.load(path, mmap_mode="r")
        except (OSError, ValueError, EOFError) as error:
            raise self._damaged(f"{path} cannot be read: {error}") from None
        if array.shape != shape or array.dtype != dtype:
            raise self._damaged(
                f"{path} holds {array.dtype} of shape {array.shape}; expected {np.dtype(dtype)} "
                f"of shape {shape}"
            )
        return array

    def _verified(self, name: str) -> Path:
        """Return the path of a file after its SHA-256 was compared with the header's."""
        try:
            path = self._files.path(f"{self._folder}/{name}")
        except MissingFileError as error:
            raise self._damaged(error.message) from None
        recorded = self.header["files"].get(name, {}).get("sha256")
        if sha256_file(path) != recorded:
            raise self._damaged(f"{path} does not have the SHA-256 of {INDEX_HEADER}")
        return path

    def _damaged(self, message: str) -> FormatError:
        return FormatError(message, f"The index is damaged: make it again. {self._remedy}")


def _data_of(files: Files) -> str:
    """Return the folder to index: the split of a dataset, as both are indexed together."""
    if not isinstance(files, LocalFiles):
        return f"FOLDER, once the data of {files.describe()} is there"
    root = files.root
    return str(root.parent if root.name in (DEMONSTRATIONS, DISTRACTORS) else root)
