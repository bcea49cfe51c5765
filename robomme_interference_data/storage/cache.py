"""A cache of decoded frames: memory-mapped arrays by content hash, bounded in size."""

import os
import re
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError, InvalidOptionError

from .arrays import FeatureDigests, map_array, write_array
from .files import atomic_path

_NAME = re.compile(r"[0-9a-f]{64}\.npy")
_HEADER = 128  # bytes that numpy writes before the data of an array of four dimensions

_warned: set[Path] = set()
"""Folders that could not be written to, and were warned about."""

_room: dict["DecodedCache", int] = {}
"""Bytes that this process may still add to a cache before it measures the folder again."""


def default_cache_folder() -> Path:
    """Return the folder for decoded frames, under `XDG_CACHE_HOME` or `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "robomme-interference" / "decoded"


@dataclass(frozen=True)
class DecodedCache:
    """Decoded frames of sessions, one `.npy` file each, named by the SHA-256 of the frames.

    Beyond the bound, the least recently used files are deleted; files with other names stay.
    Several processes may share a folder: files appear whole, and a missing one is decoded again.
    Each process measures the folder again after adding a sixteenth of the bound, and so may exceed
    it by that much for a while. Files are not flushed to disk, so a crash of the machine may lose
    some. If the folder cannot be written to, as on a full disk, the cache warns once and stores
    nothing.

    Args:
        folder: Folder of the arrays, created when first needed.
        max_bytes: Bound on the total size, in bytes.

    Raises:
        InvalidOptionError: If the bound is not positive.
    """

    folder: Path
    max_bytes: int = 20 * 2**30

    def __post_init__(self) -> None:
        if self.max_bytes <= 0:
            raise InvalidOptionError(f"max_bytes is {self.max_bytes}; expected a positive number")

    def get(
        self, sha256: str, shape: tuple[int, ...], *, verify: bool = False
    ) -> NDArray[np.uint8] | None:
        """Return cached frames as a read-only memory map, or None.

        Args:
            sha256: Digest of the frames.
            shape: Expected shape, `(T, H, W, 3)`; a file with another shape counts as absent.
            verify: Compare the frames with the digest; a mismatch counts as absent. This takes
                longer than reading the frames.
        """
        if not _NAME.fullmatch(f"{sha256}.npy"):
            return None  # an untrusted dataset may have any text here
        path = self._path(sha256)
        try:
            frames = map_array(path, np.uint8, shape)
        except (OSError, FormatError):
            return None
        with suppress(OSError):  # a read-only folder
            os.utime(path)
        return None if verify and frames_sha256(frames) != sha256 else frames

    def put(self, sha256: str, frames: NDArray[np.uint8]) -> None:
        """Store frames, unless they alone exceed the bound; delete the least recently used ones."""
        size = frames.nbytes + _HEADER
        if size > self.max_bytes:
            return
        try:
            with atomic_path(self._path(sha256), flush=False) as partial:
                write_array(partial, frames)
            _room[self] = _room.get(self, 0) - size
            if _room[self] < 0:
                _room[self] = min(self._shrink(), self.max_bytes // 16)
        except OSError as error:
            if self.folder not in _warned:
                _warned.add(self.folder)
                warnings.warn(
                    f"decoded frames cannot be cached in {self.folder}: {error.strerror or error}",
                    RuntimeWarning,
                    stacklevel=2,
                )

    def _path(self, sha256: str) -> Path:
        return self.folder / f"{sha256}.npy"

    def _shrink(self) -> int:
        """Delete files beyond the bound; return the bytes left until it is reached."""
        files = []
        for path in self.folder.iterdir():
            if _NAME.fullmatch(path.name):
                with suppress(FileNotFoundError):  # deleted by another process
                    files.append((path, path.stat()))
        size = sum(stat.st_size for _, stat in files)
        for path, stat in sorted(files, key=lambda item: item[1].st_mtime_ns):
            if size <= self.max_bytes:
                break
            path.unlink(missing_ok=True)
            size -= stat.st_size
        return self.max_bytes - size


def frames_sha256(frames: NDArray[np.uint8]) -> str:
    """Return the digest that names frames in the cache."""
    digests = FeatureDigests()
    digests.update("frames", frames)
    return digests.current()["frames"]
