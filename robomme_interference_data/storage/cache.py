"""A cache of decoded frames: memory-mappable arrays by content hash, bounded in size."""

import os
import re
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError

from .arrays import write_array
from .digest import FeatureDigests
from .files import atomic_path

_OWN = re.compile(r"[0-9a-f]{64}\.npy")
_HEADER = 128  # bytes that numpy writes before the data of an array of four dimensions

_told: set[Path] = set()
"""Folders that could not be written to, which was said once."""


def default_cache_folder() -> Path:
    """Return the folder for decoded frames, under `XDG_CACHE_HOME` or `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "robomme-interference" / "decoded"


@dataclass(frozen=True)
class DecodedCache:
    """Decoded frames of sessions, one `.npy` file each, named by the SHA-256 of the frames.

    Files that were not used for longest are removed when they outgrow the bound; files of other
    names are left alone. Several
    processes may share a folder: files appear whole, and one that vanishes is decoded again. Where
    nothing can be written, as on a full disk, it says so once, and keeps nothing.

    Args:
        folder: Where the arrays lie; made when first written to.
        max_bytes: Bound on the size of all arrays, in bytes.

    Raises:
        InvalidOptionError: The bound is not positive.
    """

    folder: Path
    max_bytes: int = 20 * 2**30

    def __post_init__(self) -> None:
        if self.max_bytes <= 0:
            raise InvalidOptionError(f"cache bound of {self.max_bytes} bytes is not positive")

    def get(
        self, sha256: str, shape: tuple[int, ...], *, verify: bool = False
    ) -> NDArray[np.uint8] | None:
        """Return cached frames as a read-only memory map, or None.

        Args:
            sha256: Digest of the frames.
            shape: Expected shape, `(T, H, W, 3)`; a file of another one counts as absent.
            verify: Compare the frames with the digest; others count as absent. Not the default:
                it takes longer than reading them.
        """
        if not _OWN.fullmatch(f"{sha256}.npy"):
            return None  # a dataset may call its frames what it likes
        path = self._path(sha256)
        try:
            frames = np.lib.format.open_memmap(path, mode="r")  # type: ignore[no-untyped-call]
        except (OSError, ValueError, TokenError):  # what numpy raises for damaged files
            return None
        with suppress(OSError):  # a folder that only others may write
            os.utime(path)
        if frames.shape != shape or frames.dtype != np.uint8:
            return None
        return None if verify and frames_sha256(frames) != sha256 else frames

    def put(self, sha256: str, frames: NDArray[np.uint8]) -> None:
        """Store frames, unless they alone exceed the bound, and remove the least used ones."""
        if frames.nbytes + _HEADER > self.max_bytes:
            return
        try:
            with atomic_path(self._path(sha256)) as partial:
                write_array(partial, frames)
            self._shrink()
        except OSError as error:
            if self.folder not in _told:
                _told.add(self.folder)
                warnings.warn(
                    f"decoded frames are not kept in {self.folder}: {error.strerror or error}",
                    RuntimeWarning,
                    stacklevel=2,
                )

    def _path(self, sha256: str) -> Path:
        return self.folder / f"{sha256}.npy"

    def _shrink(self) -> None:
        files = []
        for path in self.folder.iterdir():
            if _OWN.fullmatch(path.name):
                with suppress(FileNotFoundError):  # removed by another process
                    files.append((path, path.stat()))
        size = sum(stat.st_size for _, stat in files)
        for path, stat in sorted(files, key=lambda item: item[1].st_mtime_ns):
            if size <= self.max_bytes:
                return
            path.unlink(missing_ok=True)
            size -= stat.st_size


def frames_sha256(frames: NDArray[np.uint8]) -> str:
    """Return the digest of frames, by which they are kept."""
    digests = FeatureDigests()
    digests.update("frames", frames)
    return digests.current()["frames"]
