"""Download a buffer set from the Hub, or the part of it that some buffers need."""

import filecmp
import logging
import shutil
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    INDEX_DIR,
    INDEX_HEADER,
    MANIFEST_PATH,
    MANIFESTS,
    OPTIONAL_DATASETS,
    QUESTIONS_PATH,
    SHIFTED,
)
from robomme_interference_data.errors import HashMismatchError, InvalidOptionError, MissingFileError
from robomme_interference_data.ids import parse_numbers
from robomme_interference_data.schema.settings import setting
from robomme_interference_data.storage.files import atomic_path
from robomme_interference_data.storage.hub import HubFiles

if TYPE_CHECKING:
    from .buffer_set import BufferSet
    from .dataset import Dataset

logger = logging.getLogger(__name__)
_EPISODES, _CONTENT = "Episodes", "Content"


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
class Part:
    """Files to download from one repository.

    Attributes:
        files: The repository.
        folder: Folder for its files inside the local buffer set; empty for the root.
        sizes: Bytes of every file to download, by path.
        missing: Paths of those that are not in the cache yet.
    """

    files: HubFiles
    folder: str
    sizes: dict[str, int]
    missing: tuple[str, ...]


def plan_fetch(buffer_set: "BufferSet", config: FetchConfig) -> list[Part]:
    """Return the files to download from each repository; only listings and metadata are read."""
    if not isinstance(buffer_set.files, HubFiles):
        raise InvalidOptionError(
            f"{buffer_set.location} is a folder on this machine; only a repository can be fetched",
            "Give the buffer set as namespace/name.",
        )
    cameras = config.cameras or buffer_set.cameras
    whole = replace(config, index=None, questions=False, executions=False) == FetchConfig()
    datasets, episodes = _needed(buffer_set, config, whole=whole)
    others = {n: one.files for n, one in datasets.items() if one.files is not buffer_set.files}
    parts = []
    for folder, files in {"": buffer_set.files, **others}.items():
        assert isinstance(files, HubFiles)  # all datasets of a published buffer set are on the Hub
        sizes = files.sizes()
        # Small metadata is always downloaded: meta/, manifests/ and files at the root, except
        # questions, which contain pictures.
        paths = {
            path
            for path, (top, *below) in ((path, path.split("/")) for path in sizes)
            if top in ("meta", MANIFESTS)
            or (not below and (config.questions or top != QUESTIONS_PATH))
            or (whole and top not in (INDEX_DIR, *OPTIONAL_DATASETS))
        }
        for name, dataset in datasets.items():
            if dataset.files is files:
                paths |= {*_paths(dataset, episodes[name], cameras, config.index, sizes)}
        if lacking := sorted(paths - sizes.keys()):
            more = f" and {len(lacking) - 1} more files" if len(lacking) > 1 else ""
            hint = "Without the index, the frames can be fetched." if config.index else None
            raise MissingFileError(f"{files.describe()} lacks {lacking[0]}{more}", hint)
        chosen = {path: sizes[path] for path in sorted(paths)}
        parts.append(Part(files, folder, chosen, tuple(files.missing(chosen))))
    return parts


def fetch(parts: Sequence[Part], to: Path | None = None) -> None:
    """Download missing files and check each against its digest.

    If `to` is given, all files are copied into that folder, which becomes a buffer set at the very
    end; otherwise they stay in the Hub client's cache.
    """
    header = parts[0].files.path(MANIFEST_PATH)
    if to is not None:
        existing = to / MANIFEST_PATH
        if existing.is_file() and existing.read_bytes() != header.read_bytes():
            raise InvalidOptionError(f"{to} holds another buffer set", "Give another folder.")
    for part in parts:
        part.files.fetch(part.sizes)
    if to is None:
        return
    for part in parts:
        for path in part.sizes:
            if part.folder or path != MANIFEST_PATH:
                _copy(part.files.path(path), to / part.folder / path)
    _copy(header, to / MANIFEST_PATH)


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
            command=f"list {buffer_set.location}",
        )
    datasets = {
        name: buffer_set.datasets[name]
        for name, some in episodes.items()
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
            one.episode_index for one in executions.records() if one.episode_id in queries
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
    from .embeddings import CENTER_FILE, INDEX_SUMS, episode_file, index_folder

    for camera in cameras:
        folder = index_folder(encoder, camera)
        for name in (INDEX_HEADER, INDEX_SUMS, *map(episode_file, episodes)):
            yield f"{folder}/{name}"
        if (center := f"{folder}/{CENTER_FILE}") in existing:
            yield center


def _copy(source: Path, target: Path) -> None:
    if not target.is_file() or not filecmp.cmp(source, target, shallow=False):
        with atomic_path(target) as partial:
            shutil.copyfile(source, partial)
