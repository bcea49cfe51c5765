"""A split: datasets and the manifests that name buffers of them. Opened and loaded here."""

import os
import re
from collections.abc import Iterator
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.buffer import Buffer
from robomme_interference_data.cache import DecodedCache, default_cache_folder
from robomme_interference_data.conditions import Condition, parse_condition
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    MANIFEST_HEADER,
    MANIFEST_ROWS,
    MANIFESTS,
)
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.files import Files, LocalFiles
from robomme_interference_data.ids import EpisodeId, whole_number
from robomme_interference_data.parquet import RowSpan
from robomme_interference_data.query import Query
from robomme_interference_data.records import BufferManifest, ManifestHeader
from robomme_interference_data.rows import from_table, read_header

_FOLDER = re.compile(r"\w[\w.-]*")
_BATCH = 1024
"""Rows that are read at a time."""


class Split:
    """A split; made by `load_split`.

    Attributes:
        root: Folder with `demonstrations/`, `distractors/` and `manifests/`.
        header: How its buffers were planned.
    """

    def __init__(self, root: Path, cache: DecodedCache | None, threads: int | None):
        self.root = root
        self._cache = cache
        self._threads = threads
        self._manifests: Files = LocalFiles(root / MANIFESTS)
        self.header = read_header(self._manifests.path(MANIFEST_HEADER), ManifestHeader)
        if DEMONSTRATIONS not in self.header.datasets:
            raise FormatError.damaged(root / MANIFESTS / MANIFEST_HEADER, "no demonstrations")
        for dataset in self.header.datasets:
            if not _FOLDER.fullmatch(dataset):
                what = f"dataset {dataset!r} is not the name of a folder"
                raise FormatError.damaged(root / MANIFESTS / MANIFEST_HEADER, what)

    def __repr__(self) -> str:
        return f"Split({self.name}, buffers={len(self)}, conditions={list(self.conditions)})"

    def __len__(self) -> int:
        """Return the number of buffers."""
        return len(self._keys["episode_id"])

    @property
    def name(self) -> str:
        """Name of the split: that of its folder."""
        return self.root.resolve().name

    @cached_property
    def revision(self) -> str:
        """Identity of the split: SHA-256 of `manifest.json`, which names all data by hash."""
        return sha256(self._manifests.path(MANIFEST_HEADER).read_bytes()).hexdigest()

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions for which buffers are planned, in order."""
        return self.header.conditions

    @cached_property
    def datasets(self) -> dict[str, Dataset]:
        """The datasets by name, such as `demonstrations` and `distractors`.

        Raises:
            HashMismatchError: A dataset is not the one that the manifests were made for.
        """
        opened = {}
        for name, recorded in self.header.datasets.items():
            dataset = Dataset(LocalFiles(self.root / name))
            if dataset.revision != recorded.revision:
                raise HashMismatchError(
                    f"{self.root / name} has revision {dataset.revision[:12]}…; the manifests "
                    f"were made for {recorded.revision[:12]}…",
                    "Put the right dataset there, or build the manifests again: "
                    f"robomme-interference build manifests {self.root}",
                )
            opened[name] = dataset
        return opened

    @cached_property
    def episode_ids(self) -> tuple[EpisodeId, ...]:
        """Ids of all query episodes, in canonical order."""
        return tuple(sorted(EpisodeId.parse(text or "") for text in {*self._keys["episode_id"]}))

    @property
    def families(self) -> tuple[str, ...]:
        """Families of the query episodes, in canonical order."""
        return tuple(dict.fromkeys(episode.family for episode in self.episode_ids))

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, such as `front` and `wrist`."""
        return self.datasets[DEMONSTRATIONS].cameras

    def query(self, episode_id: EpisodeId | str) -> Query:
        """Return a query episode: its goal, scene and first live observation, without a buffer.

        Raises:
            InvalidIdError: `episode_id` does not read `<Family>/<split>/<index>`.
            UnknownNameError: The split does not have this episode; offers the nearest.
        """
        episode = EpisodeId.parse(episode_id)
        self._check_episode(episode)
        dataset = self.datasets[DEMONSTRATIONS]
        return Query(dataset, dataset.record(dataset.index_of(episode)))

    def manifest(
        self,
        episode_id: EpisodeId | str,
        condition: Condition | str | None = None,
        *,
        k: int | None = None,
    ) -> BufferManifest:
        """Return the manifest of one buffer; see `load_buffer` for arguments and errors."""
        episode = EpisodeId.parse(episode_id)
        wanted = _condition(condition, k)
        if wanted.name not in self.conditions:
            raise UnknownNameError(
                f"condition {wanted.name!r} is not in {self.root}",
                f"Planned there: {' '.join(self.conditions)}. For another one, type: "
                f"robomme-interference build manifests {self.root} --conditions "
                f"{' '.join(self.conditions)} {wanted.name}",
            )
        row = self._places.get((str(episode), wanted.name))
        if row is None:
            self._check_episode(episode)
            raise FormatError.damaged(self._rows.path, f"no row of {episode} under {wanted}")
        return next(
            from_table(BufferManifest, self._rows.part(row, row + 1).table(), self._rows.path)
        )

    def manifests(
        self,
        *,
        family: str | None = None,
        condition: Condition | str | None = None,
        k: int | None = None,
        difficulty: str | None = None,
    ) -> Iterator[BufferManifest]:
        """Yield the manifests of all buffers, or of those that have all given properties.

        Raises:
            UnknownNameError: No buffer has this family, condition or difficulty.
        """
        name = None if condition is None and k is None else _condition(condition, k).name
        keep = np.ones(len(self), bool)
        for column, value in (("family", family), ("condition", name), ("difficulty", difficulty)):
            if value is not None:
                if value not in self._keys[column]:
                    known = {one for one in self._keys[column] if one is not None}
                    raise UnknownNameError.among(column, value, self.root, known)
                keep &= np.array([one == value for one in self._keys[column]])
        return self._read(keep)

    def load(
        self,
        episode_id: EpisodeId | str,
        condition: Condition | str | None = None,
        *,
        k: int | None = None,
        verify: bool = False,
    ) -> Buffer:
        """Load one buffer; see `load_buffer` for arguments and errors."""
        buffer = self._buffer(self.manifest(episode_id, condition, k=k))
        if verify:
            buffer.verify()
        return buffer

    def buffers(self, **wanted: Any) -> Iterator[Buffer]:
        """Yield all buffers, or those that have all given properties; see `manifests`."""
        return map(self._buffer, self.manifests(**wanted))

    def _buffer(self, manifest: BufferManifest) -> Buffer:
        for entry in manifest.sessions:
            if entry.dataset not in self.datasets:
                what = f"a session of {manifest} is of {entry.dataset!r}, no dataset of the split"
                raise FormatError.damaged(self._rows.path, what)
        return Buffer(
            manifest,
            self.query(manifest.episode_id),
            self.datasets,
            cache=self._cache,
            threads=self._threads,
        )

    def _check_episode(self, episode: EpisodeId) -> None:
        if episode.family not in self.families:
            raise UnknownNameError.among("family", episode.family, self.root, self.families)
        if episode not in self.episode_ids:
            raise UnknownNameError.among("episode", str(episode), self.root, self.episode_ids)

    def _read(self, keep: NDArray[np.bool_]) -> Iterator[BufferManifest]:
        for first in range(0, len(keep), _BATCH):
            wanted = keep[first : first + _BATCH]
            if wanted.any():
                table = self._rows.part(first, first + len(wanted)).table()
                yield from from_table(BufferManifest, table.filter(wanted), self._rows.path)

    @cached_property
    def _rows(self) -> RowSpan:
        return RowSpan(self._manifests.path(MANIFEST_ROWS))

    @cached_property
    def _keys(self) -> dict[str, list[str | None]]:
        """The columns by which buffers are found; kept, as many may be asked for."""
        columns = ["episode_id", "condition", "family", "difficulty"]
        keys: dict[str, list[str | None]] = self._rows.table(columns).to_pydict()
        for column, values in keys.items():
            if not all(value is None or isinstance(value, str) for value in values):
                raise FormatError.damaged(self._rows.path, f"column {column} is not text")
        return keys

    @cached_property
    def _places(self) -> dict[tuple[str | None, str | None], int]:
        """The row of each buffer by its key."""
        keys = zip(self._keys["episode_id"], self._keys["condition"], strict=True)
        return {key: row for row, key in enumerate(keys)}


def load_split(
    split: str | os.PathLike[str],
    *,
    cache: bool | str | os.PathLike[str] | DecodedCache = False,
    threads: int | None = None,
) -> Split:
    """Open a split, to list, filter and load its buffers.

    Args:
        split: Folder with `demonstrations/`, `distractors/` and `manifests/`.
        cache: Where to keep decoded frames for the next time: a cache, a folder for one of
            20 GiB, or True for the folder `~/.cache/robomme-interference`.
        threads: Threads that decode side by side; None for one per processor.

    Raises:
        MissingFileError: The folder is not a split.
        FormatError: Its files are damaged, or of another format version.
        InvalidOptionError: An argument is not what it may be.
    """
    root = _folder("split", split, "a folder")
    if not (root / MANIFESTS / MANIFEST_HEADER).is_file():
        raise MissingFileError(
            f"{root} is not a split: {MANIFESTS}/{MANIFEST_HEADER} is missing",
            "Point to the folder that holds demonstrations/, distractors/ and manifests/, or make "
            f"one: robomme-interference build all --source KIND:PATH --out {root}",
        )
    if threads is not None:
        expected = "a number from 1, or None"
        threads = whole_number("threads", threads, expected)
        if threads < 1:
            raise InvalidOptionError.expected("threads", threads, expected)
    return Split(root, _cache(cache), threads)


def load_buffer(
    episode_id: EpisodeId | str,
    condition: Condition | str | None = None,
    *,
    split: str | os.PathLike[str] | Split,
    k: int | None = None,
    verify: bool = False,
    cache: bool | str | os.PathLike[str] | DecodedCache = False,
    threads: int | None = None,
) -> Buffer:
    """Load the history buffer of one query episode.

    Opens only the manifest row and the small metadata; frames are decoded when asked for.

    Args:
        episode_id: Id of the query episode, such as `VideoRepick/test/7`.
        condition: Name of the condition, such as `k3`, one that the split has planned.
        split: A folder, or what `load_split` returned (then `cache` and `threads` are its own).
        k: Short for the condition `k<k>`, instead of `condition`.
        verify: Decode everything now and compare it with the recorded SHA-256; and later what
            comes out of the cache.
        cache: As for `load_split`.
        threads: As for `load_split`.

    Returns:
        The buffer.

    Raises:
        InvalidIdError: `episode_id` or `condition` does not read as one.
        InvalidOptionError: Neither or both of `condition` and `k` are given, or an argument is
            not what it may be.
        UnknownNameError: The split does not have this episode or condition; offers the nearest.
        MissingFileError: The folder is not a split, or a file of it is missing.
        FormatError: A file is damaged or of another format version.
        HashMismatchError: The datasets are not the ones that the manifests were made for, or,
            with `verify`, data is not what the manifest names.
    """
    opened = split if isinstance(split, Split) else load_split(split, cache=cache, threads=threads)
    return opened.load(episode_id, condition, k=k, verify=verify)


def _condition(condition: Condition | str | None, k: int | None) -> Condition:
    if (condition is None) == (k is None):
        raise InvalidOptionError(
            f"condition {condition!r} and k={k!r}; expected one of the two",
            'For example: load_buffer("VideoRepick/test/7", "k3", split="my-split")',
        )
    if k is None:
        return parse_condition(condition or "")
    return parse_condition(f"k{whole_number('k', k, 'a whole number from 0, such as 3')}")


def _cache(cache: bool | str | os.PathLike[str] | DecodedCache) -> DecodedCache | None:
    if isinstance(cache, bool | DecodedCache | None):
        return DecodedCache(default_cache_folder()) if cache is True else cache or None
    return DecodedCache(_folder("cache", cache, "True, False, a folder or a DecodedCache"))


def _folder(option: str, given: object, expected: str) -> Path:
    if not isinstance(given, str | os.PathLike) or not str(given) or "\0" in str(given):
        raise InvalidOptionError.expected(option, given, expected)
    return Path(given)
