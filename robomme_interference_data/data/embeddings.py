"""What an encoder makes of a dataset's stored frames: the index that lies beside them.

An index is made by `robomme-interference index` (the retrieval area); reading it needs numpy
only. It depends on its dataset, the encoder and the camera alone; `split_index.py` makes
embeddings of it. Every episode has a file of its own. `docs/format.md` lists them.
"""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    DATASETS,
    INDEX_DIR,
    INDEX_HEADER,
    PAPER_ENCODER,
)
from robomme_interference_data.errors import (
    FormatError,
    InvalidOptionError,
    MissingFileError,
    MissingIndexError,
    UnknownNameError,
)
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.storage.arrays import read_array
from robomme_interference_data.storage.files import (
    Files,
    LocalFiles,
    canonical_json,
    read_header,
    read_sums,
    sha256_file,
)

CENTRE_FILE = "centre.npy"
INDEX_SUMS = "SHA256SUMS"

_LONGEST = 1 << 14
"""Values in an embedding, at most: a held frame's is repeated in a buffer; SigLIP's have 1152."""


@dataclass(frozen=True)
class EncoderRecord:
    """What an index records of its encoder.

    Attributes:
        name: As `encoder_id` has it.
        fingerprint: What determines the features: model, weights, preprocessing, code.
        sha256: Over the fingerprint; only embeddings that share it are compared.
    """

    name: str
    fingerprint: dict[str, Any]
    sha256: str


@dataclass(frozen=True)
class IndexHeader:
    """`index.json`, written last: without it there is no index.

    Attributes:
        format_version: Of the files.
        encoder: The encoder.
        computed: Device, precision and batch: they may change the last bits.
        camera: Name of the camera that was embedded.
        revision: Revision of the dataset.
        frames: Frames in all.
        size: Values of a frame.
        typical_cosine: Of distractor units: median cosine of two frames of different ones, centred
            if the encoder is. None of other datasets.
        sums: SHA-256 of `SHA256SUMS`, which lists the other files.
        sha256: SHA-256 of the canonical JSON of all other fields.
    """

    format_version: int
    encoder: EncoderRecord
    computed: dict[str, Any]
    camera: str
    revision: str
    frames: int
    size: int
    typical_cosine: float | None
    sums: str
    sha256: str = ""

    def __post_init__(self) -> None:
        if not 0 < self.size <= _LONGEST:
            raise FormatError(f"size {self.size}; expected 1 to {_LONGEST}")

    def digest(self) -> str:
        """Return what `sha256` must be."""
        fields = {name: one for name, one in to_dict(self).items() if name != "sha256"}
        text = canonical_json(fields).encode(errors="backslashreplace")  # as files are written
        return sha256(text).hexdigest()


def episode_file(episode_index: int) -> str:
    """Return where an episode's features lie inside the folder of an index."""
    return f"chunk-{episode_index // 1000:03d}/episode-{episode_index:06d}.npy"


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
    if not kind:
        raise InvalidOptionError.expected("encoder", encoder, "thumbnail, siglip or siglip:ID")
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


def centre_of(episodes: Iterable[NDArray[np.float16]]) -> NDArray[np.float32]:
    """Return what frames have in common: the mean of each episode's mean, `(D,) float32`.

    Args:
        episodes: Features of each episode, `(T, D) float16`.
    """
    means = [features.mean(axis=0, dtype=np.float64) for features in episodes if len(features)]
    return np.asarray(sum(means) / max(len(means), 1), np.float32)


class Remedy(NamedTuple):
    """How embeddings are made: hint and command of an error."""

    hint: str
    command: str


class EmbeddingIndex:
    """The features of every stored frame of a dataset, of one camera and one encoder.

    Args:
        files: The dataset's files.
        revision: The dataset's identity, `Dataset.revision`.
        encoder: Name of the encoder, see `encoder_id`.
        camera: Camera, with or without `observation.images.`.
    """

    def __init__(self, files: Files, revision: str, encoder: str, camera: str = "front"):
        self._files = files
        self._checked: set[str] = set()
        self._folder = index_folder(encoder, camera)
        root = files.describe()
        self._place = f"{root}/{self._folder}"
        camera = camera.removeprefix(CAMERA_PREFIX)
        of = f"encoder {encoder!r}" + ("" if camera == "front" else f" and camera {camera!r}")
        option = "" if camera == "front" else f" --camera {camera}"
        self.remedy = _remedy(files, f"--encoder {encoder}{option}")
        try:
            path = files.path(f"{self._folder}/{INDEX_HEADER}")
        except MissingFileError:
            raise MissingIndexError(f"{root} has no embeddings of {of}", *self.remedy) from None
        try:
            self.header = read_header(path, IndexHeader)
        except FormatError as error:
            raise FormatError(error.message, *self.remedy) from None
        made = self.header.encoder.name, self.header.camera
        if made != (encoder_id(encoder), camera):
            raise MissingIndexError(
                f"the embeddings in {self._place} are of encoder {made[0]!r} and "
                f"camera {made[1]!r}; expected {encoder_id(encoder)!r} and {camera!r}",
                f"Give the encoder as {made[0]!r}. {self.remedy.hint}",
                self.remedy.command,
            )
        if self.header.revision != revision:
            raise MissingIndexError(
                f"the embeddings of {of} in {root} were made of data with "
                f"revision {self.header.revision[:12]}…; the data now has {revision[:12]}…",
                *self.remedy,
            )

    @property
    def made(self) -> tuple[str, int]:
        """What indexes share whose frames are compared: the encoder, and so the size."""
        return self.header.encoder.sha256, self.header.size

    @cached_property
    def centre(self) -> NDArray[np.float32] | None:
        """What is taken off features before they are normalised, see `centre_of`.

        Only in an index of distractor units, and None there too if the encoder is not centred.
        """
        if CENTRE_FILE not in self._sums:
            return None
        return self._array(CENTRE_FILE, (self.header.size,), np.float32)

    @property
    def typical_cosine(self) -> float:
        """What `IndexHeader` says of distractor units."""
        if self.header.typical_cosine is None:
            raise self._damaged(f"{INDEX_HEADER} has no typical cosine")
        return self.header.typical_cosine

    def span(self, episode_index: int, start: int, stop: int) -> NDArray[np.float16]:
        """Return the features of stored frames `start` to `stop` (excluded) of an episode.

        Returns:
            `(stop - start, size) float16`, as the encoder gave them, rounded; a new array.
        """
        name = episode_file(episode_index)
        found = self._array(name, (-1, self.header.size), np.float16) if name in self._sums else ()
        if not 0 <= start <= stop <= len(found):
            raise UnknownNameError(
                f"frames {start} to {stop - 1} of episode {episode_index} are not in "
                f"{self._place}, which has {len(found)} frames of that episode",
                *self.remedy,
            )
        return np.asarray(found)[start:stop].copy()

    def check(self, lengths: dict[int, int], *, units: bool) -> None:
        """Read all of it: every file against its SHA-256, and the frames of every episode.

        Args:
            lengths: Stored frames of each episode of the dataset.
            units: Whether the dataset is of distractor units.
        """
        header, typical = self.header, self.header.typical_cosine
        finite = typical is None or np.isfinite(typical)
        if not finite or header.sha256 != header.digest():
            raise self._damaged(f"{INDEX_HEADER} does not have the SHA-256 that it records")
        if (typical is not None) != units:
            raise self._damaged(f"the typical cosine is {typical}")
        expected = {*map(episode_file, lengths), *([CENTRE_FILE] if units else [])}
        listed = {name.removeprefix(f"{self._folder}/") for name in self._files.list(self._folder)}
        known = {*self._sums, INDEX_HEADER, INDEX_SUMS}
        if extra := sorted(listed ^ known | (self._sums.keys() - expected)):
            raise self._damaged(f"{extra[0]} is missing, or too many")
        found = centre_of(self.span(episode, 0, length) for episode, length in lengths.items())
        if self.centre is not None and not np.array_equal(self.centre, found):
            raise self._damaged(f"{CENTRE_FILE} is not the mean of the episodes")
        if header.frames != sum(lengths.values()):
            raise self._damaged(f"{header.frames} frames; the dataset has {sum(lengths.values())}")

    @cached_property
    def _sums(self) -> dict[str, str]:
        path = self._path(INDEX_SUMS)
        if sha256_file(path) != self.header.sums:
            raise self._damaged(f"{INDEX_SUMS} does not have the SHA-256 of {INDEX_HEADER}")
        return read_sums(path)

    def _array(self, name: str, shape: tuple[int, ...], dtype: Any) -> NDArray[Any]:
        path, first = self._path(name), name not in self._checked
        if first and sha256_file(path) != self._sums[name]:
            raise self._damaged(f"{name} does not have the SHA-256 of {INDEX_SUMS}")
        try:
            array = read_array(path, dtype, shape)
        except FormatError as error:
            raise self._damaged(error.message) from None
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
        return FormatError(f"{self._place}: {what}", *self.remedy)


def _remedy(files: Files, options: str) -> Remedy:
    """Return how a dataset gets an index; a buffer set's are indexed together."""
    if not isinstance(files, LocalFiles):
        hint = (
            f"Fetch {files.describe()} to a folder and embed its frames, or ask its publisher to "
            "add embeddings."
        )
        return Remedy(hint, f"index FOLDER {options}")
    root = files.root
    buffer_set = root.parent if root.name in DATASETS else root
    return Remedy("Embed the frames of all its datasets (again).", f"index {buffer_set} {options}")
