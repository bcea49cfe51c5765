"""A buffer set: datasets, and the manifests that name buffers of them."""

import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    MANIFEST_HEADER,
    MANIFEST_PATH,
    MANIFEST_ROWS,
    MANIFESTS,
    OPTIONAL_DATASETS,
)
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    MissingFileError,
    UnknownNameError,
    counted,
)
from robomme_interference_data.ids import EpisodeId, whole_number
from robomme_interference_data.schema.codec import from_table, to_dict
from robomme_interference_data.schema.conditions import Condition, datasets_of, parse_condition
from robomme_interference_data.schema.manifest import BufferManifest, ManifestHeader
from robomme_interference_data.storage.files import (
    LocalFiles,
    digest_json,
    read_header,
    sha256_file,
)
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.storage.parquet import RowSpan

from .buffer import Buffer
from .dataset import Dataset
from .query import Query

if TYPE_CHECKING:
    from robomme_interference_data.storage.cache import DecodedCache

_FOLDER = re.compile(r"\w[\w.-]*")
_LOCATION = re.compile(r"\.|[\w.-]+(?:/[\w.-]+)+@[0-9a-f]{40}")
_DIGEST = re.compile(r"[0-9a-f]{64}")
_BATCH_ROWS = 1024
_KEYS = ("episode_id", "condition", "family", "difficulty")


def pending_rows(header: ManifestHeader) -> str:
    """Return the path of the rows while a build replaces those of an earlier header."""
    return f"{MANIFESTS}/.{header.rows}.parquet"


class BufferSet:
    """A buffer set, returned by `load_buffer_set`.

    Attributes:
        files: Access to the folder, or to the repository on the Hub, with its manifests.
        header: How its buffers were planned.
    """

    def __init__(
        self, files: LocalFiles | HubFiles, cache: "DecodedCache | None", threads: int | None
    ):
        self.files = files
        self._cache = cache
        self._threads = threads
        path = files.path(MANIFEST_PATH)
        self.header = read_header(path, ManifestHeader)
        if not _DIGEST.fullmatch(self.header.rows):
            raise FormatError.damaged(path, f"rows: {self.header.rows[:80]!r} is not a SHA-256")
        if DEMONSTRATIONS not in self.header.datasets:
            raise FormatError.damaged(path, "no demonstrations")
        for name, dataset in self.header.datasets.items():
            if not _FOLDER.fullmatch(name):
                raise FormatError.damaged(path, f"dataset {name!r} is not a folder name")
            if not _LOCATION.fullmatch(dataset.location or "."):
                raise FormatError.damaged(path, f"{name} has the location {dataset.location!r}")

    def __repr__(self) -> str:
        return f"BufferSet({self.name}, buffers={len(self)}, conditions={list(self.conditions)})"

    def _repr_html_(self) -> str:
        """Return the table of its buffers by family, for notebooks."""
        from robomme_interference_data.viz.tables import Table

        counts = Counter(zip(self._keys["family"], self._keys["condition"], strict=True))
        return Table.make(
            "buffers",
            f"{self.name}: {counted(len(self), 'buffer')} of "
            f"{counted(len(self.episode_ids), 'query episode')}",
            " ".join(["family", *(f"{name}:count" for name in self.conditions)]),
            ((one, *(counts[one, name] for name in self.conditions)) for one in self.families),
            f"Buffers by family and condition. Cameras: {', '.join(self.cameras)}.",
        ).html()

    def __len__(self) -> int:
        """Return the number of buffers."""
        return len(self._keys["episode_id"])

    @property
    def name(self) -> str:
        """Name of its folder or repository."""
        files = self.files
        return files.repo_id if isinstance(files, HubFiles) else files.root.resolve().name

    @property
    def location(self) -> str:
        """Its folder, or its repository with the commit, `namespace/name@…`."""
        return self.files.location

    @cached_property
    def revision(self) -> str:
        """Identity of the content: SHA-256 over its header, which lists all data by hash.

        It does not depend on where the datasets are stored.
        """
        bare = {name: replace(one, location=None) for name, one in self.header.datasets.items()}
        return digest_json([to_dict(replace(self.header, datasets=bare))])

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions for which buffers are planned, in order."""
        return self.header.conditions

    @cached_property
    def datasets(self) -> Mapping[str, Dataset]:
        """The datasets by name, such as `demonstrations`; each is opened on first access.

        Raises:
            HashMismatchError: On access, if the manifests were made for another revision.
        """
        return _Datasets(self)

    def dataset_files(self, name: str) -> LocalFiles | HubFiles:
        """Return access to a dataset's files.

        A folder with the dataset's name in a local buffer set takes precedence over the location
        that the manifests record.
        """
        location, files = self.header.datasets[name].location, self.files
        if isinstance(files, LocalFiles) and (location is None or (files.root / name).is_dir()):
            return LocalFiles(files.root / name)
        if location is None and isinstance(files, HubFiles) and name in OPTIONAL_DATASETS:
            return files.inside(name)
        if location is None:
            raise MissingFileError(
                f"the manifests of {self.location} do not record the location of its {name}",
                "Those of a published buffer set do.",
                "publish BUFFER_SET --repo-id NAMESPACE/NAME",
            )
        return files if location == "." else HubFiles.parse(location)

    @cached_property
    def episode_ids(self) -> tuple[EpisodeId, ...]:
        """Ids of all query episodes, in canonical order."""
        return tuple(sorted(EpisodeId.parse(text or "") for text in {*self._keys["episode_id"]}))

    @cached_property
    def families(self) -> tuple[str, ...]:
        """Families of the query episodes, in canonical order."""
        return tuple(dict.fromkeys(episode.family for episode in self.episode_ids))

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, such as `front` and `wrist`."""
        return self.datasets[DEMONSTRATIONS].cameras

    def planned(self, condition: Condition | str | None, k: int | None = None) -> Condition:
        """Return a condition for which buffers are planned; for arguments see `load_buffer`.

        Raises:
            InvalidIdError: `condition` is not the name of a condition.
            UnknownNameError: No buffers are planned for it.
        """
        parsed = _condition(condition, k)
        if parsed.name not in self.conditions:
            raise UnknownNameError(
                f"condition {parsed.name!r} is not in {self.location}",
                f"Planned there: {' '.join(self.conditions)}.",
                self.planning(parsed.name),
            )
        return parsed

    def planning(self, *conditions: str) -> str:
        """Return the command that plans buffers under these conditions too."""
        if isinstance(self.files, HubFiles):  # a published version never changes
            location = self.header.datasets[DEMONSTRATIONS].location
            command = f"new-buffer-set BUFFER_SET --demonstrations {location} --source KIND:PATH"
            names = [name for name in self.conditions if name not in conditions]
            return f"{command} --conditions {','.join([*names, *conditions])}"
        return f"build manifests {self.location} --conditions {','.join(conditions)}"

    @property
    def fix(self) -> str:
        """Hint for errors about manifests and data that do not match."""
        if isinstance(self.files, HubFiles):
            locations = [one.location or "." for one in self.header.datasets.values()]
            others = {location.split("@")[0] for location in locations} - {"."}
            cached = " ".join(f"dataset/{name}" for name in sorted({self.files.repo_id, *others}))
            return (
                f"Download it again: run hf cache rm {cached}, then the same command. If that "
                "does not help, ask its publisher."
            )
        return "Restore the original files, or build the manifests again."

    def query(self, episode_id: EpisodeId | str) -> Query:
        """Return a query episode: its goal, scene and first live observation, without a buffer.

        Raises:
            InvalidIdError: `episode_id` is not `<Family>/<split>/<index>`.
            UnknownNameError: The buffer set lacks this episode; the hint has the nearest.
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
        """Return the manifest of one buffer; for arguments and errors see `load_buffer`."""
        episode, name = EpisodeId.parse(episode_id), self.planned(condition, k).name
        row = self._row_of.get((str(episode), name))
        if row is None:
            self._check_episode(episode)
            raise FormatError.damaged(self._path, f"no row of {episode} under {name}")
        return next(from_table(BufferManifest, self._rows.part(row, row + 1).table(), self._path))

    def manifests(
        self,
        *,
        family: str | Sequence[str] | None = None,
        condition: Condition | str | Sequence[Condition | str] | None = None,
        k: int | None = None,
        difficulty: str | None = None,
    ) -> Iterator[BufferManifest]:
        """Yield the manifests of all buffers, or of those with all the given properties.

        Args:
            family: Family, or several; None, or an empty sequence, for all.
            condition: Condition, or several; None, or an empty sequence, for all.
            k: Short for the condition `k<k>`, instead of `condition`.
            difficulty: Difficulty of the query episode; None for all.

        Raises:
            UnknownNameError: No buffer has this family, condition or difficulty.
        """
        given = (condition,) if isinstance(condition, Condition | str) else tuple(condition or ())
        if k is not None:
            given = (self.planned(given[0] if given else None, k),)
        allowed = {
            "family": (family,) if isinstance(family, str) else family or (),
            "condition": [self.planned(one).name for one in given],
            "difficulty": () if difficulty is None else (difficulty,),
        }
        keep = np.ones(len(self), bool)
        for column, values in allowed.items():
            known = {one for one in self._keys[column] if one is not None}
            for value in values:
                if value not in known:
                    raise UnknownNameError.among(column, value, self.location, known)
            if values:
                keep &= np.array([one in values for one in self._keys[column]])
        return self._read_rows(keep)

    def _read_rows(self, keep: NDArray[np.bool_]) -> Iterator[BufferManifest]:
        for first in range(0, len(keep), _BATCH_ROWS):
            mask = keep[first : first + _BATCH_ROWS]
            if mask.any():
                table = self._rows.part(first, first + len(mask)).table()
                yield from from_table(BufferManifest, table.filter(mask), self._path)

    def load(
        self,
        episode_id: EpisodeId | str,
        condition: Condition | str | None = None,
        *,
        k: int | None = None,
        verify: bool = False,
        cameras: Sequence[str] | None = None,
    ) -> Buffer:
        """Load one buffer; for arguments and errors see `load_buffer`."""
        buffer = self._buffer(self.manifest(episode_id, condition, k=k))
        buffer.fetch(cameras)
        if verify:
            self._check_rows()
            buffer.verify()
        return buffer

    def check_tables(self, conditions: Iterable[Condition | str]) -> None:
        """Check the rows of all buffers, and the records of all episodes, against their hashes.

        Args:
            conditions: The conditions whose datasets' records are checked.

        Raises:
            HashMismatchError: They differ.
        """
        self._check_rows()
        for name in datasets_of(map(parse_condition, conditions)):
            self.datasets[name].check_records()

    def _check_rows(self) -> None:
        if sha256_file(self._path) != self.header.rows:
            what = f"{self._path} does not have the SHA-256 in {MANIFEST_HEADER}"
            raise HashMismatchError(what, self.fix, "verify BUFFER_SET")

    def buffers(self, **properties: Any) -> Iterator[Buffer]:
        """Yield all buffers, or those with all the given properties; see `manifests`."""
        return map(self._buffer, self.manifests(**properties))

    def _buffer(self, manifest: BufferManifest) -> Buffer:
        for entry in manifest.sessions:
            if entry.dataset not in self.datasets:
                what = f"{manifest} has a session of the unknown dataset {entry.dataset!r}"
                raise FormatError.damaged(self._path, what)
        query = self.query(manifest.episode_id)
        return Buffer(manifest, query, self.datasets, cache=self._cache, threads=self._threads)

    def _check_episode(self, episode: EpisodeId) -> None:
        if episode in self._episodes:
            return
        if episode.family not in self.families:
            raise UnknownNameError.among("family", episode.family, self.location, self.families)
        raise UnknownNameError.among("episode", str(episode), self.location, self.episode_ids)

    @cached_property
    def _rows(self) -> RowSpan:
        return RowSpan(self._path)

    @cached_property
    def _path(self) -> Path:
        pending, files = pending_rows(self.header), self.files
        replaced = isinstance(files, LocalFiles) and (files.root / pending).is_file()
        return files.path(pending if replaced else f"{MANIFESTS}/{MANIFEST_ROWS}")

    @cached_property
    def _keys(self) -> dict[str, list[str | None]]:
        """The columns that identify and filter buffers."""
        keys: dict[str, list[str | None]] = self._rows.table([*_KEYS]).to_pydict()
        for column, values in keys.items():
            if not all(value is None or isinstance(value, str) for value in values):
                raise FormatError.damaged(self._path, f"column {column} is not text")
        pairs = Counter(zip(keys["episode_id"], keys["condition"], strict=True))
        for (episode, condition), count in pairs.most_common(1):
            if count > 1:
                raise FormatError.damaged(
                    self._path, f"{count} rows of {episode} under {condition}"
                )
        return keys

    @cached_property
    def _row_of(self) -> dict[tuple[str | None, str | None], int]:
        pairs = zip(self._keys["episode_id"], self._keys["condition"], strict=True)
        return {pair: row for row, pair in enumerate(pairs)}

    @cached_property
    def _episodes(self) -> frozenset[EpisodeId]:
        return frozenset(self.episode_ids)


class _Datasets(Mapping[str, Dataset]):
    """The datasets of a buffer set, each opened on first access."""

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
            f"condition {condition!r} and k={k!r}; expected exactly one of them",
            'For example: load_buffer("VideoRepick/test/7", "k3", buffer_set="my-buffers")',
        )
    if k is None:
        return parse_condition(condition or "")
    return parse_condition(f"k{whole_number('k', k, 'an integer from 0, such as 3')}")
