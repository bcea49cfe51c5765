"""Open a buffer set, load a buffer: from a folder, or from the Hub."""

import os
from collections.abc import Sequence
from pathlib import Path

from robomme_interference_data.constants import MANIFEST_PATH
from robomme_interference_data.errors import InvalidOptionError, MissingFileError
from robomme_interference_data.ids import EpisodeId, whole_number
from robomme_interference_data.schema.conditions import Condition
from robomme_interference_data.storage.cache import DecodedCache, default_cache_folder
from robomme_interference_data.storage.hub import locate

from .buffer import Buffer
from .buffer_set import BufferSet


def load_buffer_set(
    buffer_set: str | os.PathLike[str],
    *,
    revision: str | None = None,
    cache: bool | str | os.PathLike[str] | DecodedCache = False,
    threads: int | None = None,
) -> BufferSet:
    """Open a buffer set, to list, filter and load its buffers.

    Args:
        buffer_set: Folder with `demonstrations/`, `distractors/` and `manifests/`; or a repository on
            the Hub, `namespace/name`.
        revision: Branch, tag or commit of the repository, such as `data-1.0.0`.
        cache: Where to keep decoded frames for the next time: a cache, a folder for one of
            20 GiB, or True for the folder `~/.cache/robomme-interference`.
        threads: Threads that decode side by side; None for one per processor.

    Raises:
        MissingFileError: The folder is not a buffer set.
        FormatError: Its files are damaged, or of another format version.
        InvalidOptionError: An argument is not what it may be.
    """
    files = locate(
        _place("buffer_set", buffer_set, "a folder, or namespace/name"), revision=revision
    )
    if threads is not None:
        expected = "a number from 1, or None"
        threads = whole_number("threads", threads, expected)
        if threads < 1:
            raise InvalidOptionError.expected("threads", threads, expected)
    try:
        return BufferSet(files, _cache(cache), threads)
    except MissingFileError as error:
        raise MissingFileError(
            f"{files.describe()} is not a buffer set: {MANIFEST_PATH} is missing",
            "Point to the folder that holds demonstrations/, distractors/ and manifests/, or make "
            "one.",
            "build all BUFFER_SET --source KIND:PATH",
        ) from error


def load_buffer(
    episode_id: EpisodeId | str,
    condition: Condition | str | None = None,
    *,
    buffer_set: str | os.PathLike[str] | BufferSet,
    revision: str | None = None,
    k: int | None = None,
    verify: bool = False,
    cameras: Sequence[str] | None = None,
    cache: bool | str | os.PathLike[str] | DecodedCache = False,
    threads: int | None = None,
) -> Buffer:
    """Load the history buffer of one query episode.

    Of a buffer set on the Hub the manifests, the small metadata and the files of this buffer's sessions
    are downloaded, nothing else; a second time none is. Frames are decoded when asked for.

    Args:
        episode_id: Id of the query episode, such as `VideoRepick/test/7`.
        condition: Name of the condition, such as `k3`, one that the buffer set has planned.
        buffer_set: A folder, a repository on the Hub (`namespace/name`), or what `load_buffer_set` returned
            (then `revision`, `cache` and `threads` are its own).
        revision: As for `load_buffer_set`.
        k: Short for the condition `k<k>`, instead of `condition`.
        verify: Decode everything now and compare it with the recorded SHA-256; and later what
            comes out of the cache.
        cameras: Whose frames are downloaded now, such as `["front"]`; None for all. Others follow
            when they are asked for.
        cache: As for `load_buffer_set`.
        threads: As for `load_buffer_set`.

    Returns:
        The buffer.

    Raises:
        InvalidIdError: `episode_id` or `condition` does not read as one.
        InvalidOptionError: Neither or both of `condition` and `k` are given, or an argument is
            not what it may be.
        UnknownNameError: The buffer set does not have this episode or condition; offers the nearest.
        MissingFileError: It is not a buffer set, or a file of it is missing.
        HubError: The repository is unknown, needs permission, or cannot be reached.
        FormatError: A file is damaged or of another format version.
        HashMismatchError: The datasets are not the ones that the manifests were made for, or,
            with `verify`, data is not what the manifest names.
    """
    opened = (
        buffer_set
        if isinstance(buffer_set, BufferSet)
        else load_buffer_set(buffer_set, revision=revision, cache=cache, threads=threads)
    )
    return opened.load(episode_id, condition, k=k, verify=verify, cameras=cameras)


def _cache(cache: bool | str | os.PathLike[str] | DecodedCache) -> DecodedCache | None:
    if isinstance(cache, bool | DecodedCache | None):
        return DecodedCache(default_cache_folder()) if cache is True else cache or None
    return DecodedCache(Path(_place("cache", cache, "True, False, a folder or a DecodedCache")))


def _place(option: str, given: object, expected: str) -> str:
    if not isinstance(given, str | os.PathLike) or not str(given) or "\0" in str(given):
        raise InvalidOptionError.expected(option, given, expected)
    return os.fspath(given)
