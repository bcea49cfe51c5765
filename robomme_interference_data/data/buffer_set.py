"""A buffer set: datasets, and the manifests that name buffers of them."""

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from hashlib import sha256
from typing import Any

import numpy as np

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    MANIFEST_PATH,
    OPTIONAL_DATASETS,
)
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId, whole_number
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.conditions import Condition, parse_condition
from robomme_interference_data.schema.manifest import BufferManifest, ManifestHeader
from robomme_interference_data.storage.cache import DecodedCache
from robomme_interference_data.storage.files import LocalFiles, canonical_json, read_header
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.viz.tables import Table

from .buffer import Buffer
from .dataset import Dataset
from .manifest_table import ManifestTable
from .query import Query

_FOLDER = re.compile(r"\w[\w.-]*")
_LOCATION = re.compile(r"\.|[\w.-]+/[\w.-]+@[0-9a-f]{40}")
_DIGEST = re.compile(r"[0-9a-f]{64}")


class BufferSet:
    """A buffer set; see `load_buffer_set`.

    Attributes:
        files: The folder, or the repository on the Hub, that holds its manifests.
        header: How its buffers were planned.
    """

    def __init__(
        self, files: LocalFiles | HubFiles, cache: DecodedCache | None, threads: int | None
    ):
        self.files = files
        self._cache = cache
        self._threads = threads
        path = files.path(MANIFEST_PATH)
        self.header = read_header(path, ManifestHeader)
        if not _DIGEST.fullmatch(self.header.rows):
            raise FormatError.damaged(path, f"rows: {self.header.rows[:80]!r} is no SHA-256")
        if DEMONSTRATIONS not in self.header.datasets:
            raise FormatError.damaged(path, "no demonstrations")
        for name, dataset in self.header.datasets.items():
            if not _FOLDER.fullmatch(name):
                raise FormatError.damaged(path, f"dataset {name!r} is not the name of a folder")
            if not _LOCATION.fullmatch(dataset.location or "."):
                raise FormatError.damaged(path, f"{name} has the location {dataset.location!r}")

    def __repr__(self) -> str:
        return f"BufferSet({self.name}, buffers={len(self)}, conditions={list(self.conditions)})"

    def _repr_html_(self) -> str:
        """Return the table of its buffers by family, as notebooks show it."""
        counts = Counter(
            zip(self._table.keys["family"], self._table.keys["condition"], strict=True)
        )
        return Table.make(
            "buffers",
            f"{self.name}: {len(self):,} buffers of {len(self.episode_ids):,} query episodes",
            " ".join(["family", *(f"{name}:count" for name in self.conditions)]),
            ((one, *(counts[one, name] for name in self.conditions)) for one in self.families),
            f"Buffers by family and condition. Cameras: {', '.join(self.cameras)}.",
        ).html()

    def __len__(self) -> int:
        """Return the number of buffers."""
        return len(self._table.keys["episode_id"])

    @property
    def name(self) -> str:
        """Name of the buffer set: that of its folder or repository."""
        files = self.files
        return files.repo_id if isinstance(files, HubFiles) else files.root.resolve().name

    @property
    def location(self) -> str:
        """Where it lies: its folder, or its repository with the commit, `namespace/name@…`."""
        return self.files.location

    @cached_property
    def revision(self) -> str:
        """Identity of the buffer set: SHA-256 over its header, which names all data by hash.

        It is the same wherever the datasets lie.
        """
        bare = {name: replace(one, location=None) for name, one in self.header.datasets.items()}
        text = canonical_json(to_dict(replace(self.header, datasets=bare)))
        return sha256(text.encode(errors="backslashreplace")).hexdigest()  # as files are written

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions for which buffers are planned, in order."""
        return self.header.conditions

    @cached_property
    def datasets(self) -> Mapping[str, Dataset]:
        """The datasets by name, such as `demonstrations`; each is opened on first use.

        Raises:
            HashMismatchError: A dataset is not the one that the manifests were made for.
        """
        return _Datasets(self)

    def dataset_files(self, name: str) -> LocalFiles | HubFiles:
        """Return where a dataset of the buffer set lies.

        That is the folder of its name, if there is one or the manifests name no other location.
        """
        location, own = self.header.datasets[name].location, self.files
        if isinstance(own, LocalFiles) and (location is None or (own.root / name).is_dir()):
            return LocalFiles(own.root / name)
        if location is None and isinstance(own, HubFiles) and name in OPTIONAL_DATASETS:
            return own.inside(name)
        if location is None:
            raise MissingFileError(
                f"the manifests of {self.location} do not say where its {name} are",
                "Those of a published buffer set do.",
                "publish BUFFER_SET --repo-id NAMESPACE/NAME",
            )
        return own if location == "." else HubFiles.parse(location)

    @cached_property
    def episode_ids(self) -> tuple[EpisodeId, ...]:
        """Ids of all query episodes, in canonical order."""
        return tuple(
            sorted(EpisodeId.parse(text or "") for text in {*self._table.keys["episode_id"]})
        )

    @cached_property
    def families(self) -> tuple[str, ...]:
        """Families of the query episodes, in canonical order."""
        return tuple(dict.fromkeys(episode.family for episode in self.episode_ids))

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, such as `front` and `wrist`."""
        return self.datasets[DEMONSTRATIONS].cameras

    def planned(self, condition: Condition | str | None, k: int | None = None) -> Condition:
        """Return a condition for which buffers are planned; see `load_buffer` for arguments.

        Raises:
            InvalidIdError: It does not read as one.
            UnknownNameError: No buffers are planned for it.
        """
        wanted = _condition(condition, k)
        if wanted.name not in self.conditions:
            raise UnknownNameError(
                f"condition {wanted.name!r} is not in {self.location}",
                f"Planned there: {' '.join(self.conditions)}.",
                self.planning(*self.conditions, wanted.name),
            )
        return wanted

    def planning(self, *conditions: str) -> str:
        """Return the command that plans buffers under these conditions."""
        command = f"build manifests {self.location}"
        if isinstance(self.files, HubFiles):  # what is published stays as it is
            location = self.header.datasets[DEMONSTRATIONS].location
            command = f"new-buffer-set BUFFER_SET --demonstrations {location} --source KIND:PATH"
        return f"{command} --conditions {','.join(conditions)}"

    @property
    def fix(self) -> str:
        """What to do where manifests and data are not of each other."""
        if isinstance(self.files, HubFiles):
            locations = [one.location or "." for one in self.header.datasets.values()]
            others = {location.split("@")[0] for location in locations} - {"."}
            cached = " ".join(f"dataset/{name}" for name in sorted({self.files.repo_id, *others}))
            return (
                f"Fetch it again: type hf cache rm {cached}, and the same command. If that does "
                "not help, only its publisher can."
            )
        return "Put the right files there, or build the manifests again."

    def query(self, episode_id: EpisodeId | str) -> Query:
        """Return a query episode: its goal, scene and first live observation, without a buffer.

        Raises:
            InvalidIdError: `episode_id` does not read `<Family>/<split>/<index>`.
            UnknownNameError: The buffer set does not have this episode; offers the nearest.
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
        wanted = self.planned(condition, k)
        found = self._table.manifest(str(episode), wanted.name)
        if found is None:
            self._check_episode(episode)
            raise FormatError.damaged(self._table.path, f"no row of {episode} under {wanted}")
        return found

    def manifests(
        self,
        *,
        family: str | Sequence[str] | None = None,
        condition: Condition | str | Sequence[Condition | str] | None = None,
        k: int | None = None,
        difficulty: str | None = None,
    ) -> Iterator[BufferManifest]:
        """Yield the manifests of all buffers, or of those that have all given properties.

        Args:
            family: Family, or several; None, or an empty sequence, for all.
            condition: Condition, likewise.
            k: Instead of a condition, see `load_buffer`.
            difficulty: Difficulty of the query episode.

        Raises:
            UnknownNameError: No buffer has this family, condition or difficulty.
        """
        some = (condition,) if isinstance(condition, Condition | str) else tuple(condition or ())
        if k is not None:
            some = (self.planned(some[0] if some else None, k),)
        wanted = {
            "family": (family,) if isinstance(family, str) else family or (),
            "condition": [self.planned(one).name for one in some],
            "difficulty": () if difficulty is None else (difficulty,),
        }
        keep = np.ones(len(self), bool)
        for column, values in wanted.items():
            known = {one for one in self._table.keys[column] if one is not None}
            for value in values:
                if value not in known:
                    raise UnknownNameError.among(column, value, self.location, known)
            if values:
                keep &= np.array([one in values for one in self._table.keys[column]])
        return self._table.manifests(keep)

    def load(
        self,
        episode_id: EpisodeId | str,
        condition: Condition | str | None = None,
        *,
        k: int | None = None,
        verify: bool = False,
        cameras: Sequence[str] | None = None,
    ) -> Buffer:
        """Load one buffer; see `load_buffer` for arguments and errors."""
        buffer = self._buffer(self.manifest(episode_id, condition, k=k))
        buffer.fetch(cameras)
        if verify:
            self._table.check(self.fix)
            buffer.verify()
        return buffer

    def buffers(self, **wanted: Any) -> Iterator[Buffer]:
        """Yield all buffers, or those that have all given properties; see `manifests`."""
        return map(self._buffer, self.manifests(**wanted))

    def _buffer(self, manifest: BufferManifest) -> Buffer:
        for entry in manifest.sessions:
            if entry.dataset not in self.datasets:
                what = (
                    f"a session of {manifest} is of {entry.dataset!r}, no dataset of the buffer set"
                )
                raise FormatError.damaged(self._table.path, what)
        return Buffer(
            manifest,
            self.query(manifest.episode_id),
            self.datasets,
            cache=self._cache,
            threads=self._threads,
        )

    def _check_episode(self, episode: EpisodeId) -> None:
        if episode in self._episodes:
            return
        if episode.family not in self.families:
            raise UnknownNameError.among("family", episode.family, self.location, self.families)
        raise UnknownNameError.among("episode", str(episode), self.location, self.episode_ids)

    @cached_property
    def _table(self) -> ManifestTable:
        return ManifestTable(self.files, self.header)

    @cached_property
    def _episodes(self) -> frozenset[EpisodeId]:
        return frozenset(self.episode_ids)


class _Datasets(Mapping[str, Dataset]):
    """The datasets of a buffer set, each opened on first use."""

    def __init__(self, buffer_set: BufferSet):
        self._buffer_set = buffer_set
        self._opened: dict[str, Dataset] = {}

    def __getitem__(self, name: str) -> Dataset:
        if name not in self._opened:
            recorded = self._buffer_set.header.datasets[name]
            dataset = Dataset(self._buffer_set.dataset_files(name))
            if dataset.revision != recorded.revision:
                local = isinstance(self._buffer_set.files, LocalFiles)
                raise HashMismatchError(
                    f"{dataset.files.describe()} has revision {dataset.revision[:12]}…; the "
                    f"manifests were made for {recorded.revision[:12]}…",
                    self._buffer_set.fix,
                    f"build manifests {self._buffer_set.location}" if local else None,
                )
            self._opened[name] = dataset
        return self._opened[name]

    def __contains__(self, name: object) -> bool:
        return name in self._buffer_set.header.datasets

    def __iter__(self) -> Iterator[str]:
        return iter(self._buffer_set.header.datasets)

    def __len__(self) -> int:
        return len(self._buffer_set.header.datasets)


def _condition(condition: Condition | str | None, k: int | None) -> Condition:
    if (condition is None) == (k is None):
        raise InvalidOptionError(
            f"condition {condition!r} and k={k!r}; expected one of the two",
            'For example: load_buffer("VideoRepick/test/7", "k3", buffer_set="my-buffers")',
        )
    if k is None:
        return parse_condition(condition or "")
    return parse_condition(f"k{whole_number('k', k, 'a whole number from 0, such as 3')}")
