"""Which files `fetch` downloads of a published buffer set, and from which repositories."""

import logging
import re
import shlex
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from robomme_interference_data.constants import (
    DATASET_FOLDERS,
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    IDENTITY_PATH,
    INDEX_DIR,
    INDEX_HEADER,
    MANIFEST_PATH,
    MANIFEST_ROWS,
    MANIFESTS,
    OPTIONAL_DATASETS,
    QUESTIONS_PATH,
    SHIFTED,
    SUMS_PATH,
)
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    InvalidOptionError,
    MissingFileError,
)
from robomme_interference_data.ids import parse_numbers
from robomme_interference_data.schema.settings import setting
from robomme_interference_data.storage.hub import HubFiles

if TYPE_CHECKING:
    from .buffer_set import BufferSet
    from .dataset import Dataset

logger = logging.getLogger(__name__)
_EPISODES, _CONTENT = "Episodes", "Content"

_CARD = re.compile(r"(README|LICENSE)[^/]*")
"""Files for readers, at the root of a repository."""

_LEFT_OUT = re.compile(rf"\..*|{INDEX_DIR}/.*|({'|'.join(OPTIONAL_DATASETS)})/.*")
"""Files of a repository that a whole buffer set may have, and that are not copied with it."""

_ROWS_PATH = f"{MANIFESTS}/{MANIFEST_ROWS}"


@dataclass(frozen=True)
class FetchConfig:
    """Which buffers of a buffer set to download, and which of their files."""

    families: tuple[str, ...] = setting(
        (), help="Families of the queries; by default all.", group=_EPISODES
    )
    conditions: tuple[str, ...] = setting(
        (), help="Conditions; by default all that are planned.", group=_EPISODES
    )
    episodes: str | None = setting(
        None, help="Episode numbers, such as 0-9 or 0,3,10-12; by default all.", group=_EPISODES
    )
    cameras: tuple[str, ...] = setting(
        (), help="Cameras, such as front; by default all.", group=_CONTENT
    )
    index: str | None = setting(
        None, help="Encoder whose embeddings to download too, such as thumbnail.", group=_CONTENT
    )
    questions: bool = setting(
        False, help="Download the questions too; a full download has them.", group=_CONTENT
    )
    executions: bool = setting(
        False, help="Download the executions too; a full download has them.", group=_CONTENT
    )


@dataclass(frozen=True)
class FetchPart:
    """Files to download from one repository.

    Attributes:
        files: The repository.
        folder: Folder for its files inside the local buffer set; empty for the root.
        sizes: Bytes of every file to download, by path.
        sums: SHA-256 by path of the files whose digest the buffer set records: all but the header
            of the manifests, which leads to all digests, and cards.
        missing: Paths of those that are not in the cache yet.
        unlisted: Paths of the repository's files that the buffer set does not list.
    """

    files: HubFiles
    folder: str
    sizes: dict[str, int]
    sums: dict[str, str]
    missing: tuple[str, ...]
    unlisted: tuple[str, ...]


def plan_fetch(
    buffer_set: "BufferSet", config: FetchConfig, to: Path | None = None
) -> list[FetchPart]:
    """Return the files to download from each repository; only listings and metadata are read.

    A repository may hold anything, but only files that the buffer set lists are fetched: those of
    its datasets, by their lists of digests, its manifests, and its card. `to` is checked first.
    """
    if not isinstance(buffer_set.files, HubFiles):
        raise InvalidOptionError(
            f"{buffer_set.location} is a folder on this machine; only a repository can be fetched",
            "Give the buffer set as namespace/name.",
        )
    if to is not None:
        # Not at the top: commands load this module for its settings, and that loads pyarrow.
        from .fetched_copy import earlier_files

        header = buffer_set.files.path(MANIFEST_PATH)
        earlier_files(to.resolve(), buffer_set.location, header)
    for camera in config.cameras:
        buffer_set.datasets[DEMONSTRATIONS].camera(camera, "cameras")  # raises for an unknown one
    cameras = config.cameras or buffer_set.cameras
    # Without a choice of buffers or cameras everything is fetched, also what no buffer needs.
    whole = replace(config, index=None, questions=False, executions=False) == FetchConfig()
    datasets, episodes = _needed(buffer_set, config, whole=whole)
    others = {
        name: dataset.files
        for name, dataset in datasets.items()
        if dataset.files is not buffer_set.files
    }
    parts = []
    for folder, files in {"": buffer_set.files, **others}.items():
        assert isinstance(files, HubFiles)  # all datasets of a published buffer set are on the Hub
        sizes = files.sizes()
        sums: dict[str, str] = {}
        paths = {path for path in sizes if _CARD.fullmatch(path)}
        if files is buffer_set.files:
            paths |= {MANIFEST_PATH, _ROWS_PATH}
            sums[_ROWS_PATH] = buffer_set.header.rows
            questions = buffer_set.header.questions
            if config.questions and questions is None:
                raise MissingFileError(f"{buffer_set.location} has no questions")
            if questions is not None and (whole or config.questions):
                paths.add(QUESTIONS_PATH)
                sums[QUESTIONS_PATH] = questions
        for name, dataset in datasets.items():
            if dataset.files is files:
                listed = _listed(dataset)
                sums |= listed
                sums[IDENTITY_PATH] = buffer_set.header.datasets[name].identity
                sums[SUMS_PATH] = dataset.identity.sums
                paths |= {IDENTITY_PATH, SUMS_PATH}
                paths |= {path for path in listed if whole or path.startswith("meta/")}
                paths |= {*_paths(dataset, episodes[name], cameras, config.index, sizes)}
        if lacking := sorted(paths - sizes.keys()):
            more = f" and {len(lacking) - 1} more files" if len(lacking) > 1 else ""
            hint = "Without the index, the frames can be fetched." if config.index else None
            raise MissingFileError(f"{files.describe()} lacks {lacking[0]}{more}", hint)
        chosen = {path: sizes[path] for path in sorted(paths)}
        # A part leaves listed files out, so nothing can be said about the rest.
        unlisted = sizes.keys() - paths - sums.keys() if whole else ()
        parts.append(
            FetchPart(
                files,
                folder,
                chosen,
                {path: sums[path] for path in chosen if path in sums},
                tuple(files.missing(chosen)),
                tuple(sorted(path for path in unlisted if not _LEFT_OUT.fullmatch(path))),
            )
        )
    return parts


def _listed(dataset: "Dataset") -> dict[str, str]:
    """Return the files that a dataset lists, with their SHA-256."""
    sums = dataset.sums()
    for path in sums:
        # The list comes from the repository: it could name files that other programs would run.
        if path.split("/")[0] not in DATASET_FOLDERS:
            raise FormatError.damaged(
                dataset.files.describe(),
                f"{SUMS_PATH} lists {path}, which is outside {', '.join(DATASET_FOLDERS)}",
            )
    return sums


def _needed(
    buffer_set: "BufferSet", config: FetchConfig, *, whole: bool
) -> tuple[dict[str, "Dataset"], dict[str, set[int]]]:
    """Return the datasets that the chosen buffers need, and the episodes of each.

    Parts of a buffer set omit datasets without sessions in the chosen buffers, and views under
    shifts that do not fit the manifests.
    """
    numbers = None if config.episodes is None else {*parse_numbers(config.episodes)}
    episodes: dict[str, set[int]] = {name: set() for name in buffer_set.header.datasets}
    queries = set()
    for manifest in buffer_set.manifests(family=config.families, condition=config.conditions):
        if numbers is None or manifest.episode_id.index in numbers:
            queries.add(manifest.episode_id)
            episodes[manifest.query.dataset].add(manifest.query.episode_index)
            for entry in manifest.sessions:
                episodes[entry.dataset].add(entry.episode_index)
    if not queries:
        raise InvalidOptionError(
            f"no buffer of {buffer_set.location} has one of the episodes {config.episodes}",
            command=f"list {shlex.quote(buffer_set.location)}",
        )
    datasets = {
        name: buffer_set.datasets[name]
        for name, some in episodes.items()
        # No session lies in these two: they go by query, below.
        if name not in (SHIFTED, EXECUTIONS)
        and (whole or some or name in (DEMONSTRATIONS, DISTRACTORS))
    }
    if SHIFTED in episodes:
        try:
            shifted = datasets[SHIFTED] = buffer_set.datasets[SHIFTED]
            episodes[SHIFTED] = {shifted.index_of(query) for query in queries}
        except HashMismatchError as error:
            if whole:
                raise
            logger.warning("views under shifts are left out: %s", error.message)
    if config.executions and EXECUTIONS not in episodes:
        raise MissingFileError(f"{buffer_set.location} has no executions")
    if EXECUTIONS in episodes and (whole or config.executions):
        executions = datasets[EXECUTIONS] = buffer_set.datasets[EXECUTIONS]
        episodes[EXECUTIONS] = {
            record.episode_index for record in executions.records() if record.episode_id in queries
        }
    return datasets, episodes


def _paths(
    dataset: "Dataset",
    episodes: Collection[int],
    cameras: Iterable[str],
    encoder: str | None,
    existing: Collection[str],
) -> Iterator[str]:
    for index in episodes:
        yield from dataset.files_of(index, cameras)
    if encoder is None:
        return
    from .index_layout import CENTER_FILE, INDEX_SUMS, episode_file, index_folder

    for camera in cameras:
        folder = index_folder(encoder, camera)
        for name in (INDEX_HEADER, INDEX_SUMS, *map(episode_file, episodes)):
            yield f"{folder}/{name}"
        if (center := f"{folder}/{CENTER_FILE}") in existing:
            yield center
