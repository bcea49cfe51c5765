"""Open a split, and load its history buffers by episode id."""

import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

from robomme_interference_data.buffer import Buffer
from robomme_interference_data.cache import DecodedCache, default_cache_folder
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    MANIFEST_JSON,
    MANIFESTS,
)
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import (
    HashMismatchError,
    MissingFileError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.files import LocalFiles
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.manifest_io import ManifestReader
from robomme_interference_data.schema import BufferManifest

__all__ = ["Split", "load_buffer", "load_split"]


@dataclass(frozen=True)
class Split:
    """A split: demonstrations, distractor units and the manifests that name buffers of them.

    Attributes:
        root: Folder with `demonstrations/`, `distractors/` and `manifests/`.
        cache: Cache of decoded frames, or None.
        threads: Threads that decode side by side; None for one per processor.
    """

    root: Path
    cache: DecodedCache | None = None
    threads: int | None = None

    @cached_property
    def reader(self) -> ManifestReader:
        """The manifest files."""
        return ManifestReader(LocalFiles(self.root / MANIFESTS))

    @cached_property
    def datasets(self) -> dict[str, Dataset]:
        """The demonstrations and distractors, by those names.

        Raises:
            HashMismatchError: A dataset is not the one that the manifests were made for.
        """
        opened = {}
        for name in (DEMONSTRATIONS, DISTRACTORS):
            dataset = Dataset(LocalFiles(self.root / name))
            expected = self.reader.header["datasets"][name]["revision"]
            if dataset.revision != expected:
                raise HashMismatchError(
                    f"{self.root / name} has revision {dataset.revision[:12]}…; the manifests "
                    f"were made for {expected[:12]}…",
                    "Put the right dataset there, or build the manifests again: "
                    f"robomme-interference build manifests --demonstrations "
                    f"{self.root / DEMONSTRATIONS} --distractors {self.root / DISTRACTORS} "
                    f"--out {self.root / MANIFESTS}",
                )
            opened[name] = dataset
        return opened

    @property
    def name(self) -> str:
        """Name of the split: that of its folder."""
        return self.root.resolve().name

    @cached_property
    def revision(self) -> str:
        """Identity of the split: SHA-256 of `manifest.json`, which names all data by hash."""
        return sha256((self.root / MANIFESTS / MANIFEST_JSON).read_bytes()).hexdigest()

    @property
    def episode_ids(self) -> tuple[EpisodeId, ...]:
        """Ids of all query episodes, in canonical order."""
        return self.reader.episode_ids

    @property
    def families(self) -> tuple[str, ...]:
        """Families of the query episodes, in canonical order."""
        return tuple(dict.fromkeys(episode.family for episode in self.episode_ids))

    @property
    def k_values(self) -> tuple[int, ...]:
        """Numbers of distractor sessions for which buffers are planned, ascending."""
        return self.reader.k_values

    def manifest(self, episode_id: EpisodeId | str, k: int) -> BufferManifest:
        """Return the manifest of one buffer; see `load_buffer` for arguments and errors."""
        return self.reader.get(_episode(episode_id), k)

    def manifests(
        self,
        *,
        family: str | None = None,
        k: int | None = None,
        difficulty: str | None = None,
    ) -> Iterator[BufferManifest]:
        """Yield the manifests of all buffers, or of those that have all given properties.

        Raises:
            UnknownNameError: No buffer has this family, k or difficulty.
        """
        equal: dict[str, Any] = {}
        for name, value in (("family", family), ("k", k), ("difficulty", difficulty)):
            if value is None:
                continue
            known = self.reader.values(name)
            if value not in known:
                raise UnknownNameError(
                    f"{name} {value!r} is not in {self.reader.files.describe()}",
                    nearest(str(value), (str(one) for one in known if one is not None)),
                )
            equal[name] = value
        return self.reader.select(equal)

    def load(self, episode_id: EpisodeId | str, k: int, *, verify: bool = False) -> Buffer:
        """Load one buffer; see `load_buffer` for arguments and errors."""
        buffer = Buffer(
            self.manifest(episode_id, k), self.datasets, cache=self.cache, threads=self.threads
        )
        if verify:
            buffer.verify()
        return buffer

    def buffers(
        self,
        *,
        family: str | None = None,
        k: int | None = None,
        difficulty: str | None = None,
    ) -> Iterator[Buffer]:
        """Yield all buffers, or those that have all given properties, in file order."""
        for manifest in self.manifests(family=family, k=k, difficulty=difficulty):
            yield Buffer(manifest, self.datasets, cache=self.cache, threads=self.threads)

    def __len__(self) -> int:
        return int(self.reader.header["counts"]["buffers"])


def load_split(
    split: str | os.PathLike[str],
    *,
    cache: bool | DecodedCache = False,
    threads: int | None = None,
) -> Split:
    """Open a split, to list, filter and load its buffers.

    Args:
        split: Folder with `demonstrations/`, `distractors/` and `manifests/`.
        cache: Whether to keep decoded frames for the next time: a cache, or True for one of
            20 GiB under `~/.cache/robomme-interference`.
        threads: Threads that decode side by side; None for one per processor.

    Raises:
        MissingFileError: The folder is not a split.
        FormatError: Its files are of another format version.
    """
    root = Path(split)
    if not (root / MANIFESTS / MANIFEST_JSON).is_file():
        raise MissingFileError(
            f"{root} is not a split: {MANIFESTS}/{MANIFEST_JSON} is missing",
            "Point to the folder that holds demonstrations/, distractors/ and manifests/, or make "
            f"one: robomme-interference build all --source KIND:PATH --out {root}",
        )
    if cache is True:
        cache = DecodedCache(default_cache_folder())
    opened = Split(root, cache or None, threads)
    opened.reader  # noqa: B018 - refuses an unknown format version now
    return opened


def load_buffer(
    episode_id: EpisodeId | str,
    k: int,
    split: str | os.PathLike[str] | Split,
    *,
    verify: bool = False,
    cache: bool | DecodedCache = False,
    threads: int | None = None,
) -> Buffer:
    """Load the history buffer of one query episode.

    Opens only the manifest row and the small metadata; frames are decoded when asked for.

    Args:
        episode_id: Id of the query episode, such as `VideoRepick/test/7`.
        k: Number of distractor sessions after the lesson, one that the split has planned.
        split: A folder, or what `load_split` returned (then `cache` and `threads` are its own).
        verify: Decode everything now and compare it with the recorded SHA-256.
        cache: As for `load_split`.
        threads: As for `load_split`.

    Returns:
        The buffer.

    Raises:
        InvalidIdError: `episode_id` does not read `<Family>/<split>/<index>`.
        UnknownNameError: The split does not have this episode or k; offers the nearest.
        MissingFileError: The folder is not a split, or a file of it is missing.
        FormatError: A file is damaged or of another format version.
        HashMismatchError: The datasets are not the ones that the manifests were made for, or,
            with `verify`, data is not what the manifest names.
    """
    opened = split if isinstance(split, Split) else load_split(split, cache=cache, threads=threads)
    return opened.load(episode_id, k, verify=verify)


def _episode(episode_id: EpisodeId | str) -> EpisodeId:
    return episode_id if isinstance(episode_id, EpisodeId) else EpisodeId.parse(episode_id)
