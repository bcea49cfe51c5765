"""Open a buffer set and load a buffer, from a folder or from the Hub."""

import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from robomme_interference_data.constants import (
    DATASETS,
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    FETCH_RECORD,
    IDENTITY_PATH,
    INFO_PATH,
    MANIFEST_PATH,
    MANIFESTS,
)
from robomme_interference_data.errors import InvalidOptionError, MissingFileError, named
from robomme_interference_data.ids import EpisodeId, whole_number
from robomme_interference_data.schema.conditions import Condition
from robomme_interference_data.storage.files import LocalFiles

from .buffer import Buffer
from .buffer_set import BufferSet
from .dataset import Dataset

if TYPE_CHECKING:
    from robomme_interference_data.storage.cache import DecodedCache
    from robomme_interference_data.storage.hub import HubFiles


def load_buffer_set(
    buffer_set: str | os.PathLike[str],
    *,
    revision: str | None = None,
    cache: "bool | str | os.PathLike[str] | DecodedCache" = False,
    threads: int | None = None,
) -> BufferSet:
    """Open a buffer set, to list, filter and load its buffers.

    Args:
        buffer_set: A folder with `demonstrations/`, `distractors/` and `manifests/`; or, as text,
            a repository on the Hub, `namespace/name`. An existing folder takes precedence.
        revision: Branch, tag or commit of the repository, such as `data-1.0.0`.
        cache: Where decoded frames are kept for the next time: a `DecodedCache`, a folder for one
            of 20 GiB, or True for the folder `~/.cache/robomme-interference`.
        threads: Threads that decode in parallel; None for one per CPU.

    Raises:
        MissingFileError: The folder is missing or is not a buffer set.
        FormatError: Its files are damaged, or of another format version.
        InvalidOptionError: An argument has an invalid value.
        HubError: The repository is unknown, needs permission, or cannot be reached.
    """
    _check_location("buffer_set", buffer_set, "a folder, or namespace/name")
    files: LocalFiles | HubFiles
    folder = Path(buffer_set).expanduser()
    # With a revision, `locate` has the error that a folder has none.
    if folder.is_dir() and revision is None:
        files = LocalFiles(folder)
    else:
        from robomme_interference_data.storage.hub import locate

        files = locate(buffer_set, revision=revision)
    if threads is not None:
        threads = whole_number("threads", threads, "an integer from 1, or None", 1)
    try:
        return BufferSet(files, open_cache(cache), threads)
    except MissingFileError as error:
        raise _no_buffer_set(files) from error


def _no_buffer_set(files: "LocalFiles | HubFiles") -> MissingFileError:
    """Return the error about files that are no buffer set, or not yet a complete one."""
    from robomme_interference_data.storage.staging import staging_path

    from .fetched_copy import fetch_command, read_fetch_record

    if isinstance(files, LocalFiles) and (files.root / FETCH_RECORD).is_file():
        record = read_fetch_record(files.root)
        return MissingFileError(
            f"{files.root} is an incomplete copy of {record.location}: the fetch was interrupted",
            "Resume it.",
            fetch_command(files.root, record),
        )
    message = f"{files.describe()} is not a buffer set: {MANIFEST_PATH} is missing"
    if isinstance(files, LocalFiles):
        if any(staging_path(files.root / name).is_dir() for name in (*DATASETS, MANIFESTS)):
            hint = "Its build has not finished: run the same build command again to resume it."
            return MissingFileError(message, hint)
        if built := built_datasets(files.root):
            lacking = [name for name in (DEMONSTRATIONS, DISTRACTORS) if name not in built]
            return MissingFileError(
                f"{files.root} is not a buffer set yet: it has {' and '.join(built)}; it lacks "
                + " and ".join([*lacking, MANIFESTS]),
                "Build what it lacks.",
                next_build(files.root),
            )
        if (files.root / IDENTITY_PATH).is_file():
            return MissingFileError(message, "It is one dataset: give the folder that holds it.")
        if (files.root / INFO_PATH).is_file():
            command = ["build", "BUFFER_SET", "--source", f"lerobot:{files.root}"]
            return MissingFileError(
                message, "Build one from these recordings.", shlex.join(command)
            )
    return MissingFileError(
        message,
        "Give a folder with demonstrations/, distractors/ and manifests/, or build one.",
        "build BUFFER_SET --source KIND:PATH",
    )


def built_datasets(root: Path) -> tuple[str, ...]:
    """Return the names of the datasets in a folder whose build has finished, in their order."""
    return tuple(name for name in DATASETS if (root / name / IDENTITY_PATH).is_file())


def next_build(root: Path) -> str:
    """Return the command that builds what a buffer set in a folder lacks first.

    If it has manifests, its demonstrations may be on the Hub, and the manifests are built again.
    """
    built = DATASETS if (root / MANIFEST_PATH).is_file() else built_datasets(root)
    for name in (DEMONSTRATIONS, DISTRACTORS):
        if name not in built:
            return shlex.join(["build", str(root), "--only", name, "--source", "KIND:PATH"])
    return shlex.join(["build", str(root), "--only", MANIFESTS])


def load_buffer(
    episode_id: EpisodeId | str,
    condition: Condition | str | None = None,
    *,
    buffer_set: str | os.PathLike[str] | BufferSet,
    revision: str | None = None,
    k: int | None = None,
    verify: bool = False,
    cameras: Sequence[str] | None = None,
    cache: "bool | str | os.PathLike[str] | DecodedCache" = False,
    threads: int | None = None,
) -> Buffer:
    """Load the history buffer of one query episode.

    From the Hub, only the manifests, the small metadata and the files of this buffer's sessions
    are downloaded, and only once. Frames are decoded on demand.

    Args:
        episode_id: Id of the query episode, such as `VideoRepick/test/7`.
        condition: Name of a condition for which the buffer set has buffers, such as `k3`.
        buffer_set: A folder, a repository on the Hub (`namespace/name`), or a buffer set returned
            by `load_buffer_set` (then `revision`, `cache` and `threads` are ignored).
        revision: As for `load_buffer_set`.
        k: Short for the condition `k<k>`, instead of `condition`.
        verify: Decode everything now and compare it with the recorded SHA-256.
        cameras: Cameras whose videos are downloaded now, such as `["front"]`; None for all. Other
            videos are downloaded when they are used.
        cache: As for `load_buffer_set`.
        threads: As for `load_buffer_set`.

    Raises:
        InvalidIdError: `episode_id` or `condition` cannot be parsed.
        InvalidOptionError: Neither or both of `condition` and `k` are given, or an argument has
            an invalid value.
        UnknownNameError: The buffer set lacks this episode or condition; the hint has the nearest.
        MissingFileError: It is not a buffer set, or one of its files is missing.
        HubError: The repository is unknown, needs permission, or cannot be reached.
        FormatError: A file is damaged or of another format version.
        HashMismatchError: The manifests were made for other datasets, or, with `verify`, data
            differs from what the manifest records.
    """
    if not isinstance(buffer_set, BufferSet):
        buffer_set = load_buffer_set(buffer_set, revision=revision, cache=cache, threads=threads)
    return buffer_set.load(episode_id, condition, k=k, verify=verify, cameras=cameras)


def open_dataset(buffer_set: BufferSet, name: str, more: str = "") -> Dataset:
    """Return a dataset of a buffer set by its kind, such as `executions`.

    Args:
        buffer_set: The buffer set.
        name: Kind of the dataset.
        more: What else the error suggests if there is none.

    Raises:
        MissingFileError: The buffer set has none.
    """
    if name in buffer_set.datasets:
        return buffer_set.datasets[name]
    if buffer_set.copy is not None and name in buffer_set.header.datasets:
        option = "--executions" if name == EXECUTIONS else ""
        raise buffer_set.copy.not_fetched(f"the {name}", option)
    hint, command = "Ask its publisher to add them.", None
    if buffer_set.is_own and Path(buffer_set.location, name, IDENTITY_PATH).is_file():
        hint = "It is built; plan the buffers again to include it."
        command = f"build {shlex.quote(buffer_set.location)} --only manifests"
    elif buffer_set.is_own:
        hint = (
            "Build them from the source of its demonstrations, with the same options as then, such "
            f"as {named('families_from')}; then plan the buffers again."
        )
        command = f"build {shlex.quote(buffer_set.location)} --only {name} --source KIND:PATH"
    raise MissingFileError(
        f"{buffer_set.location} has no {name}", f"{hint} {more}".strip(), command
    )


def open_cache(cache: "bool | str | os.PathLike[str] | DecodedCache") -> "DecodedCache | None":
    """Return the cache that an argument `cache` means, None for none; see `load_buffer_set`."""
    if cache is False or cache is None:
        return None
    from robomme_interference_data.storage.cache import DecodedCache

    if cache is True:
        return DecodedCache()
    if isinstance(cache, DecodedCache):
        return cache
    _check_location("cache", cache, "True, False, a folder or a DecodedCache")
    return DecodedCache(Path(cache))


def _check_location(option: str, given: object, expected: str) -> None:
    if not isinstance(given, str | os.PathLike) or not str(given) or "\0" in str(given):
        raise InvalidOptionError.expected(option, given, expected)
