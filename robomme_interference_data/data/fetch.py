"""Bring a buffer set from the Hub to this machine, or the part of it that some buffers need."""

import filecmp
import shutil
from collections.abc import Container, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from robomme_interference_data.constants import (
    INDEX_DIR,
    INDEX_HEADER,
    MANIFEST_PATH,
    MANIFESTS,
    OPTIONAL_DATASETS,
    QUESTIONS_PATH,
    SHIFTED,
)
from robomme_interference_data.errors import InvalidOptionError, MissingFileError
from robomme_interference_data.ids import parse_numbers
from robomme_interference_data.schema.settings import setting
from robomme_interference_data.storage.files import atomic_path
from robomme_interference_data.storage.hub import HubFiles

if TYPE_CHECKING:
    from .buffer_set import BufferSet
    from .dataset import Dataset


@dataclass(frozen=True)
class FetchConfig:
    """Which buffers of a buffer set are wanted, and what of them."""

    families: tuple[str, ...] = setting((), help="Families of the queries; by default all.")
    conditions: tuple[str, ...] = setting((), help="Conditions; by default all that are planned.")
    episodes: str | None = setting(None, help="Numbers, such as 0-9 or 0,3,10-12; default: all.")
    cameras: tuple[str, ...] = setting((), help="Cameras, such as front; by default all.")
    index: str | None = setting(None, help="Also the embeddings of this encoder, as thumbnail.")
    questions: bool = setting(False, help="Also the questions; all buffers come with them.")


@dataclass(frozen=True)
class Part:
    """What is wanted of one repository.

    Attributes:
        files: The repository.
        folder: Where its files go inside a fetched buffer set's folder: empty for its root.
        sizes: Path to bytes of every file that is wanted.
        missing: Those that are not in the cache yet.
    """

    files: HubFiles
    folder: str
    sizes: dict[str, int]
    missing: tuple[str, ...]


def plan_fetch(buffer_set: "BufferSet", config: FetchConfig) -> list[Part]:
    """Return what is to be fetched of each repository: its files are listed, none is fetched."""
    if not isinstance(buffer_set.files, HubFiles):
        raise InvalidOptionError(
            f"{buffer_set.location} is a folder on this machine; only a repository can be fetched",
            "Give the buffer set as namespace/name.",
        )
    cameras = config.cameras or buffer_set.cameras
    whole = replace(config, index=None, questions=False) == FetchConfig()
    episodes = _episodes(buffer_set, config)
    others = {n: d.files for n, d in buffer_set.datasets.items() if d.files is not buffer_set.files}
    parts = []
    for folder, files in {"": buffer_set.files, **others}.items():
        assert isinstance(files, HubFiles)  # so is every place of a buffer set on the Hub
        sizes = files.sizes()
        # What tells of a dataset or buffer set is small: all in meta/ and manifests/, and at the root
        # but for questions, which have pictures. All of a buffer set is more than its buffers need:
        # units that no query drew, too.
        wanted = {
            path
            for path, (top, *below) in ((path, path.split("/")) for path in sizes)
            if top in ("meta", MANIFESTS)
            or (not below and (config.questions or top != QUESTIONS_PATH))
            or (whole and top not in (INDEX_DIR, *OPTIONAL_DATASETS))
        }
        for name, dataset in buffer_set.datasets.items():
            if dataset.files is files:
                wanted |= {*_paths(dataset, episodes[name], cameras, config.index, sizes)}
        if lacking := sorted(wanted - sizes.keys()):
            more = f" and {len(lacking) - 1} more files" if len(lacking) > 1 else ""
            hint = "Without the index, the frames can be fetched." if config.index else None
            raise MissingFileError(f"{files.describe()} lacks {lacking[0]}{more}", hint)
        chosen = {path: sizes[path] for path in sorted(wanted)}
        parts.append(Part(files, folder, chosen, tuple(files.missing(chosen))))
    return parts


def fetch(parts: Sequence[Part], to: Path | None = None) -> None:
    """Fetch what is missing, every file against its digest.

    Args:
        parts: What `plan_fetch` returned.
        to: Folder to copy the files to; None leaves them in the Hub client's cache. It becomes a
            buffer set at the very end.
    """
    header = parts[0].files.path(MANIFEST_PATH)
    there = None if to is None else to / MANIFEST_PATH
    if there is not None and there.is_file() and there.read_bytes() != header.read_bytes():
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


def _episodes(buffer_set: "BufferSet", config: FetchConfig) -> dict[str, set[int]]:
    """Return the episodes of each dataset that the wanted buffers and their queries hold."""
    numbers = None if config.episodes is None else {*parse_numbers(config.episodes)}
    found: dict[str, set[int]] = {name: set() for name in buffer_set.header.datasets}
    for manifest in buffer_set.manifests(family=config.families, condition=config.conditions):
        episode = manifest.episode_id
        if numbers is None or episode.index in numbers:
            found[manifest.query.dataset].add(manifest.query.episode_index)
            if SHIFTED in found:
                found[SHIFTED].add(buffer_set.datasets[SHIFTED].index_of(episode))
            for entry in manifest.sessions:
                found[entry.dataset].add(entry.episode_index)
    if not any(found.values()):
        raise InvalidOptionError(
            f"no buffer of {buffer_set.location} is of episodes {config.episodes}",
            command=f"list {buffer_set.location}",
        )
    return found


def _paths(
    dataset: "Dataset",
    episodes: Iterable[int],
    cameras: Iterable[str],
    encoder: str | None,
    there: Container[str],
) -> Iterator[str]:
    from .embeddings import (
        CENTRE_FILE,
        INDEX_SUMS,
        episode_file,
        index_folder,
    )

    for index in episodes:
        yield from dataset.files_of(index, cameras)
    for camera in cameras if encoder is not None else ():
        folder = index_folder(encoder or "", camera)
        own = (INDEX_HEADER, INDEX_SUMS, *map(episode_file, episodes))
        yield from (f"{folder}/{name}" for name in own)
        if (centre := f"{folder}/{CENTRE_FILE}") in there:  # of units, if the encoder is centred
            yield centre


def _copy(source: Path, target: Path) -> None:
    if not target.is_file() or not filecmp.cmp(source, target, shallow=False):
        with atomic_path(target) as partial:
            shutil.copyfile(source, partial)
