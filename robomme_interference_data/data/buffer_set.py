"""A buffer set: datasets, and the manifests that name buffers of them."""

import logging
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    DATASETS,
    DEMONSTRATIONS,
    DISTRACTORS,
    FETCH_RECORD,
    MANIFEST_PATH,
)
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    UnknownNameError,
    counted,
)
from robomme_interference_data.ids import EpisodeId, whole_number
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.conditions import Condition, datasets_of, parse_condition
from robomme_interference_data.schema.manifest import BufferManifest, ManifestHeader
from robomme_interference_data.storage.files import Files, LocalFiles
from robomme_interference_data.storage.text import digest_json, read_header

from .buffer import Buffer
from .dataset import Dataset
from .query import Query
from .set_files import ManifestTable, SetDatasets, dataset_files

if TYPE_CHECKING:
    import pandas

    from robomme_interference_data.storage.cache import DecodedCache
    from robomme_interference_data.storage.hub import HubFiles

    from .fetched_copy import FetchedCopy
    from .query_sessions import SessionSource

logger = logging.getLogger(__name__)
# Where a header may send a reader: to its own root or to a commit, never to another folder.
_LOCATION = re.compile(r"\.|[\w.-]+(?:/[\w.-]+)+@[0-9a-f]{40}")
# The digest of the rows is also a part of a file's name; see `pending_rows`.
_DIGEST = re.compile(r"[0-9a-f]{64}")


class BufferSet:
    """A buffer set, returned by `load_buffer_set`.

    Attributes:
        files: Access to the folder, or to the repository on the Hub, with its manifests.
        header: How its buffers were planned.
        copy: What a folder holds that `fetch` copied; None for other folders and repositories.
            Of a partial copy, this class shows the buffers that are there.
    """

    def __init__(
        self, files: "LocalFiles | HubFiles", cache: "DecodedCache | None", threads: int | None
    ):
        self.files = files
        self.copy: FetchedCopy | None = None
        if isinstance(files, LocalFiles) and (files.root / FETCH_RECORD).is_file():
            from .fetched_copy import open_copy

            self.copy = open_copy(files.root)
            self.files = files = replace(files, refetch=self.copy.refetch)
        self._cache = cache
        self._threads = threads
        path = files.path(MANIFEST_PATH)
        self.header = read_header(path, ManifestHeader)
        if not _DIGEST.fullmatch(self.header.rows):
            raise FormatError.damaged(path, f"rows: {self.header.rows[:80]!r} is not a SHA-256")
        names = self.header.datasets.keys()
        if not {DEMONSTRATIONS, DISTRACTORS} <= names <= {*DATASETS}:
            what = f"datasets {', '.join(map(ascii, sorted(names)))}; expected demonstrations, "
            raise FormatError.damaged(path, f"{what}distractors, and optional ones")
        for name, dataset in self.header.datasets.items():
            if not _LOCATION.fullmatch(dataset.location or "."):
                raise FormatError.damaged(path, f"{name} has the location {dataset.location!r}")

    def __reduce__(self) -> tuple[Any, ...]:
        return _open_again, (self.files, self._cache, self._threads, self.header)

    def __repr__(self) -> str:
        return f"BufferSet({self.name}, buffers={len(self)}, conditions={list(self.conditions)})"

    def __len__(self) -> int:
        """Return the number of buffers."""
        return len(self._present["episode_id"])

    def counts(self) -> Counter[tuple[str | None, str | None]]:
        """Return the number of buffers by family and condition."""
        return Counter(zip(self._present["family"], self._present["condition"], strict=True))

    @property
    def planned_buffers(self) -> int:
        """Number of buffers, including those that a partial copy lacks."""
        return len(self._table)

    @property
    def rows_path(self) -> Path:
        """File of the rows that the header names, also after an interrupted build."""
        return self._table.path

    @property
    def name(self) -> str:
        """Name of its folder or repository."""
        files = self.files
        return files.root.resolve().name if isinstance(files, LocalFiles) else files.repo_id

    @property
    def location(self) -> str:
        """Its folder, or its repository with the commit, `namespace/name@…`."""
        return self.files.location

    @property
    def is_own(self) -> bool:
        """Whether it may be changed: a folder that is no copy of a published version."""
        return isinstance(self.files, LocalFiles) and self.copy is None

    @cached_property
    def revision(self) -> str:
        """Identity of the content: SHA-256 over its header, which lists all data by hash.

        It depends neither on where the datasets are stored nor on the questions, which a run that
        asks them records by itself.
        """
        bare = {
            name: replace(dataset, location=None) for name, dataset in self.header.datasets.items()
        }
        return digest_json([to_dict(replace(self.header, datasets=bare, questions=None))])

    @property
    def conditions(self) -> tuple[str, ...]:
        """Names of the conditions for which buffers are planned, in order."""
        if self.copy is None:
            return self.header.conditions
        present = {*self._present["condition"]}
        return tuple(name for name in self.header.conditions if name in present)

    @cached_property
    def datasets(self) -> Mapping[str, Dataset]:
        """The datasets by name, such as `demonstrations`; each is opened on first access.

        Raises:
            HashMismatchError: On access, if the manifests were made for another revision.
        """
        names = [
            name
            for name in self.header.datasets
            if self.copy is None or self.copy.has_dataset(self.dataset_files(name))
        ]
        own = f"build {shlex.quote(self.location)} --only manifests"
        command = own if self.is_own else None
        return SetDatasets(names, self.dataset_files, self.header, (self.fix, command))

    def dataset_files(self, name: str) -> Files:
        """Return access to a dataset's files; see `set_files.dataset_files`."""
        return dataset_files(self.files, self.header, name)

    @cached_property
    def episode_ids(self) -> tuple[EpisodeId, ...]:
        """Ids of all query episodes, in canonical order."""
        return tuple(sorted(EpisodeId.parse(text or "") for text in {*self._present["episode_id"]}))

    def episodes_under(self, conditions: Iterable[Condition | str]) -> tuple[EpisodeId, ...]:
        """Return the ids of the query episodes that have a buffer under all of some conditions.

        Only a partial copy has fewer than `episode_ids`.

        Raises:
            UnknownNameError: No buffers are planned for one of the conditions.
            MissingFileError: A partial copy has none of one of them.
        """
        names = [self.planned(condition).name for condition in conditions]
        pairs = {*zip(self._present["episode_id"], self._present["condition"], strict=True)}
        return tuple(
            episode
            for episode in self.episode_ids
            if all((str(episode), name) in pairs for name in names)
        )

    @cached_property
    def families(self) -> tuple[str, ...]:
        """Families of the query episodes, in canonical order."""
        return tuple(dict.fromkeys(episode.family for episode in self.episode_ids))

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, such as `front` and `wrist`."""
        demonstrations = self.datasets[DEMONSTRATIONS]
        return demonstrations.cameras if self.copy is None else self.copy.cameras(demonstrations)

    def planned(self, condition: Condition | str | None, k: int | None = None) -> Condition:
        """Return a condition for which buffers are planned; for arguments see `load_buffer`.

        Raises:
            InvalidIdError: `condition` is not the name of a condition.
            UnknownNameError: No buffers are planned for it.
            MissingFileError: A partial copy has none of them.
        """
        parsed = _condition(condition, k)
        if self.copy is not None and parsed.name in {*self.header.conditions} - {*self.conditions}:
            raise self.copy.not_fetched(
                f"the buffers of {parsed.name}", f"--conditions {parsed.name}"
            )
        if parsed.name not in self.conditions:
            what = f"condition {parsed.name!r} is not in {self.location}"
            there = f"Planned there: {' '.join(self.conditions)}."
            lacking = None
            if isinstance(self.files, LocalFiles) and self.is_own:
                from .query_sessions import lacking_for

                queries = map(self.query, self.episode_ids)
                lacking = lacking_for(parsed, self.files.root, queries)
            if lacking is None:
                raise UnknownNameError(what, there, self.planning(parsed.name))
            raise UnknownNameError(what, f"{there} {lacking}")
        return parsed

    def planning(self, *conditions: str) -> str:
        """Return the command that plans buffers under these conditions too."""
        if not self.is_own:
            location = self.header.datasets[DEMONSTRATIONS].location
            command = f"build BUFFER_SET --demonstrations {location} --source KIND:PATH"
            names = [name for name in self.conditions if name not in conditions]
            return f"{command} --conditions {','.join([*names, *conditions])}"
        added = ",".join(conditions)
        return f"build {shlex.quote(self.location)} --only manifests --conditions {added}"

    @property
    def fix(self) -> str:
        """Hint for errors about manifests and data that do not match."""
        if not isinstance(self.files, LocalFiles):
            locations = [dataset.location or "." for dataset in self.header.datasets.values()]
            others = {location.split("@")[0] for location in locations} - {"."}
            cached = " ".join(f"dataset/{name}" for name in sorted({self.files.repo_id, *others}))
            return (
                f"Download it again: run hf cache rm {cached}, then the same command. If that "
                "does not help, ask its publisher."
            )
        if self.copy is not None:
            return f"Fetch it again: robomme-interference {self.copy.refetch}"
        return "Restore the original files, or build the manifests again."

    def holds(self, dataset: Dataset, episode_index: int) -> bool:
        """Whether an episode can be loaded; only a partial copy lacks some."""
        return self.copy is None or self.copy.holds(dataset, episode_index)

    def check_is_whole(self) -> None:
        """Check that all files of all datasets are here.

        Raises:
            MissingFileError: This is a copy that lacks some.
        """
        if self.copy is not None and not self.copy.is_whole(self.datasets, self.header):
            raise self.copy.not_fetched("some files")

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
        row = self._table.row_of.get((str(episode), name))
        if row is None:
            # A known episode has a row under each planned condition.
            self._check_episode(episode)
            raise FormatError.damaged(self._table.path, f"no row of {episode} under {name}")
        if self.copy is not None and not self._is_present[row]:
            options = f"--families {episode.family} --episodes {episode.index} --conditions {name}"
            raise self.copy.not_fetched(f"the sessions of {episode} under {name}", options)
        return self._table.record(row)

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
        return self._table.records(self._matching(family, condition, k, difficulty))

    def to_pandas(
        self,
        *,
        family: str | Sequence[str] | None = None,
        condition: Condition | str | Sequence[Condition | str] | None = None,
        k: int | None = None,
        difficulty: str | None = None,
    ) -> "pandas.DataFrame":
        """Return the manifests as a pandas `DataFrame`, a row per buffer; see `manifests`.

        Its columns are those of `buffers.parquet`; `sessions` holds a list of dicts.

        Raises:
            MissingExtraError: pandas is not installed.
            UnknownNameError: No buffer has this family, condition or difficulty.
        """
        return self._table.to_pandas(self._matching(family, condition, k, difficulty))

    def _matching(
        self,
        family: str | Sequence[str] | None,
        condition: Condition | str | Sequence[Condition | str] | None,
        k: int | None,
        difficulty: str | None,
    ) -> NDArray[np.bool_]:
        """Return whether each row has all the given properties."""
        conditions: Sequence[Condition | str] = ()
        if isinstance(condition, Condition | str):
            conditions = (condition,)
        elif condition is not None:
            conditions = tuple(condition)
        if k is not None:
            conditions = (self.planned(conditions[0] if conditions else None, k),)
        allowed = {
            "family": (family,) if isinstance(family, str) else family or (),
            "condition": [self.planned(name).name for name in conditions],
            "difficulty": () if difficulty is None else (difficulty,),
        }
        return self._table.matching(allowed, self._is_present, self.location)

    def planned_manifests(self) -> Iterator[BufferManifest]:
        """Yield the manifests of all buffers, including those that a partial copy lacks."""
        return self._table.records(np.ones(self.planned_buffers, bool))

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
            self._table.check(self.fix)
            buffer.verify()
        return buffer

    def check_tables(self, conditions: Iterable[Condition | str], *, planned: bool = True) -> None:
        """Check the tables of some conditions; nothing is decoded.

        Checked are the records of all episodes against the revisions of their datasets, and every
        row against the one that the rules give.

        Args:
            conditions: The conditions.
            planned: Whether their rows are used; else the records alone are checked.

        Raises:
            HashMismatchError: A table differs.
            FormatError: The rows follow rules of an unknown version.
        """
        parsed = [parse_condition(condition) for condition in conditions]
        for name in datasets_of(parsed):
            self.datasets[name].check_records()
        if planned:
            self._table.check(self.fix)
            for manifest in self.manifests(condition=parsed):
                self.check_rules(manifest)

    def check_rules(self, manifest: BufferManifest) -> None:
        """Check that a manifest is the one that the rules give; see `SessionSource.check`."""
        self._source.check(manifest)

    @cached_property
    def _source(self) -> "SessionSource":
        """What the rules depend on: needed, and imported, only to check."""
        from .query_sessions import SessionSource

        return SessionSource(self.datasets, self.header.seed)

    def buffers(self, **properties: Any) -> Iterator[Buffer]:
        """Yield all buffers, or those with all the given properties; see `manifests`."""
        return map(self._buffer, self.manifests(**properties))

    def _buffer(self, manifest: BufferManifest) -> Buffer:
        # The table may be anybody's: a name in it need not be one of the header's datasets.
        for entry in manifest.sessions:
            if entry.dataset not in self.datasets:
                what = f"{manifest} has a session of the unknown dataset {entry.dataset!r}"
                raise FormatError.damaged(self._table.path, what)
        return Buffer(
            manifest,
            self.query(manifest.episode_id),
            self.datasets,
            cache=self._cache,
            threads=self._threads,
            check_rules=self.check_rules,
        )

    def _check_episode(self, episode: EpisodeId) -> None:
        if episode in self._episodes:
            return
        # First what a wider copy would have: that error has the command that fetches it.
        if self.copy is not None and str(episode) in {*self._table.keys["episode_id"]}:
            options = f"--families {episode.family} --episodes {episode.index}"
            raise self.copy.not_fetched(f"the buffers of {episode}", options)
        if episode.family not in self.families:
            raise UnknownNameError.among("family", episode.family, self.location, self.families)
        raise UnknownNameError.among("episode", str(episode), self.location, self.episode_ids)

    @cached_property
    def _table(self) -> ManifestTable:
        return ManifestTable(self.files, self.header)

    @cached_property
    def _is_present(self) -> NDArray[np.bool_]:
        """Whether the buffer of each row can be loaded; all but in a partial copy."""
        if self.copy is None:
            return np.ones(self.planned_buffers, bool)
        present = [
            self.copy.holds_buffer(self.datasets, manifest) for manifest in self.planned_manifests()
        ]
        if not all(present):
            logger.info(
                "%s holds %d of the %s of %s; for more: robomme-interference %s",
                self.location,
                sum(present),
                counted(len(present), "buffer"),
                self.copy.record.location,
                self.copy.refetch,
            )
        return np.array(present, bool)

    @cached_property
    def _present(self) -> dict[str, list[str | None]]:
        """The columns of the table's `keys` for the buffers that can be loaded."""
        if self.copy is None:
            return self._table.keys
        return {
            name: [value for value, here in zip(values, self._is_present, strict=True) if here]
            for name, values in self._table.keys.items()
        }

    @cached_property
    def _episodes(self) -> frozenset[EpisodeId]:
        return frozenset(self.episode_ids)


def _open_again(
    files: "LocalFiles | HubFiles",
    cache: "DecodedCache | None",
    threads: int | None,
    header: ManifestHeader,
) -> BufferSet:
    """Return an unpickled buffer set, or a copy of one: open files cannot be pickled."""
    buffer_set = BufferSet(files, cache, threads)
    if buffer_set.header != header:
        raise HashMismatchError(
            f"{buffer_set.location} was changed since it was pickled: it has other buffers",
            "Open it again; do not change a buffer set that is in use.",
        )
    return buffer_set


def _condition(condition: Condition | str | None, k: int | None) -> Condition:
    if (condition is None) == (k is None):
        raise InvalidOptionError(
            f"condition {condition!r} and k={k!r}; expected exactly one of them",
            'For example: load_buffer("VideoRepick/test/7", "k3", buffer_set="my-buffers")',
        )
    if k is None:
        return parse_condition(condition or "")
    return parse_condition(f"k{whole_number('k', k, 'an integer from 0, such as 3')}")
