"""The cache of decoded frames: a file for each session and camera, bounded in size.

A file holds the frames of a whole session, one after another, and then the SHA-256 of these bytes.
It is named by what the frames are: their recorded digest, and how they are laid out. So buffer sets
with equal sessions share files, and none can change what another one reads.
"""

import hashlib
import logging
import math
import os
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from time import time, time_ns

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError

from .files import atomic_path

logger = logging.getLogger(__name__)

_NAME = re.compile(r"[0-9a-f]{64}")
"""A file of the cache; other files in its folder are not ours."""

_PARTIAL = re.compile(r"\.[0-9a-f]{64}\..*")
"""A file while it is written, or a lock; a process that is killed leaves them."""

_LONGEST_WRITE_S = 3600

_DIGEST_BYTES = hashlib.sha256().digest_size

_checked: dict[Path, tuple[int, int, int]] = {}
"""Files whose digest this process has compared, as they were then: inode, size, time of writing."""

_room: dict["DecodedCache", int] = {}
"""Bytes that this process may still add to a cache before it measures the folder again."""


def cache_folder(name: str) -> Path:
    """Return this package's folder of that name under `XDG_CACHE_HOME` or `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "robomme-interference" / name


@dataclass(frozen=True)
class DecodedCache:
    """Decoded frames of sessions, for buffers and for training.

    Each file is compared with its digest when a process first opens it, and again if it was written
    since; a damaged one is decoded again. Beyond the bound, the least recently used files are
    deleted. Each process measures the folder again after adding a sixteenth of the bound, and so
    may exceed it by that much for a while. Several processes may share a folder: files appear
    whole, and of two that need the same session, one waits for the other.

    Args:
        folder: Folder of the files, created when first needed; by default
            `~/.cache/robomme-interference/decoded`.
        max_bytes: Bound on the total size, in bytes.

    Raises:
        InvalidOptionError: If the bound is not positive.
    """

    folder: Path = field(default_factory=partial(cache_folder, "decoded"))
    max_bytes: int = 20 * 2**30

    def __post_init__(self) -> None:
        if self.max_bytes <= 0:
            raise InvalidOptionError(f"max_bytes is {self.max_bytes}; expected a positive number")

    def frames(
        self, key: str, shape: tuple[int, ...], decode: Callable[[], Iterable[NDArray[np.uint8]]]
    ) -> NDArray[np.uint8]:
        """Return the frames of a session as a read-only memory map, decoded now if need be.

        Args:
            key: Identity of the frames: 64 hexadecimal digits.
            shape: Their shape, such as `(T, H, W, 3)`, the same for every call with this key.
            decode: Yields them one by one; if it raises, nothing is stored.

        Raises:
            OSError: The file cannot be written, as on a full disk.
        """
        from filelock import FileLock  # not needed to read buffers without a cache

        path = self.folder / key
        frames = _open(path, shape)
        if frames is not None:
            return frames
        self.folder.mkdir(parents=True, exist_ok=True)
        lock = self.folder / f".{key}.lock"
        with FileLock(lock):
            try:
                frames = _open(path, shape)  # another process may have written it in the meantime
                if frames is None:
                    frames = _write(path, shape, decode())
            finally:
                with suppress(OSError):  # Windows removes no open file
                    lock.unlink()
        self._keep_bound(frames.nbytes)
        return frames

    def _keep_bound(self, added: int) -> None:
        """Delete the least recently used files beyond the bound, if this process added enough."""
        _room[self] = _room.get(self, 0) - added
        if _room[self] >= 0:
            return
        files = []
        for path in self.folder.iterdir():
            with suppress(FileNotFoundError):  # deleted by another process
                stat = path.stat()
                if _NAME.fullmatch(path.name) or _is_left_behind(path, stat):
                    files.append((path, stat))
        size = sum(stat.st_size for _, stat in files)
        for path, stat in sorted(files, key=lambda item: item[1].st_atime_ns):
            if size <= self.max_bytes:
                break
            with suppress(OSError):  # deleted by another process, or on Windows in use
                path.unlink()
            size -= stat.st_size
        _room[self] = min(self.max_bytes - size, self.max_bytes // 16)


def _is_left_behind(path: Path, stat: os.stat_result) -> bool:
    return _PARTIAL.fullmatch(path.name) is not None and time() - stat.st_mtime > _LONGEST_WRITE_S


def _open(path: Path, shape: tuple[int, ...]) -> NDArray[np.uint8] | None:
    """Return the frames in a file; None if there is no file, or a damaged one."""
    try:
        stat = path.stat()
        data = _map(path)
    except OSError:
        return None
    if _checked.get(path) != _state(stat):
        whole = len(data) == math.prod(shape) + _DIGEST_BYTES
        digest = hashlib.sha256(data[:-_DIGEST_BYTES]).digest()
        if not whole or digest != data[-_DIGEST_BYTES:].tobytes():
            logger.warning("%s is damaged: its frames are decoded again", path)
            return None
        _checked[path] = _state(stat)
    with suppress(OSError):  # a folder that only others may write to
        # When it was used; the time of writing stays, which shows whether it is the same file.
        os.utime(path, ns=(time_ns(), stat.st_mtime_ns))
    return data[:-_DIGEST_BYTES].reshape(shape)


def _write(
    path: Path, shape: tuple[int, ...], frames: Iterable[NDArray[np.uint8]]
) -> NDArray[np.uint8]:
    digest = hashlib.sha256()
    # Not flushed to the disk: what a crash of the machine loses, the digest shows.
    with atomic_path(path, flush=False) as partial:
        with partial.open("wb") as file:
            for frame in frames:
                values = np.ascontiguousarray(frame).data
                file.write(values)
                digest.update(values)
            file.write(digest.digest())
        # Mapped before it has its name, under which another process may delete it at once.
        data = _map(partial)
        _checked[path] = _state(partial.stat())
    return data[:-_DIGEST_BYTES].reshape(shape)


def _map(path: Path) -> NDArray[np.uint8]:
    """Return the bytes of a file, read on access."""
    import pyarrow as pa

    if path.stat().st_size == 0:  # which cannot be mapped
        return np.empty(0, np.uint8)
    # Unlike a `numpy.memmap`, this keeps no file open, of which a process may have 1,024: a
    # training maps thousands of sessions.
    with pa.memory_map(str(path)) as file:
        return np.frombuffer(file.read_buffer(), np.uint8)


def _state(stat: os.stat_result) -> tuple[int, int, int]:
    return stat.st_ino, stat.st_size, stat.st_mtime_ns
