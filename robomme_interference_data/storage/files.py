"""Access the files of a dataset, write files atomically, and record their SHA-256."""

import errno
import hashlib
import os
import shlex
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

from robomme_interference_data.errors import FormatError, InterferenceError, MissingFileError

from .text import indented_json, read_text

_MAX_SUMS_BYTES = 64 << 20
"""A list of the SHA-256 of half a million files."""

_SHARED_BLOBS = ".huggingface-shared-blobs"
"""File with which the Hub's client marks the blobs that repositories in its cache share."""


class Files(ABC):
    """Access to the files of a dataset or buffer set: `LocalFiles`, or `hub.HubFiles`.

    It is the only way in which this package accesses them. A path is always relative, with `/`,
    such as `meta/info.json`. Paths come from data files that are not trusted: no path leaves the
    dataset, and no link does.
    """

    @abstractmethod
    def path(self, relative: str) -> Path:
        """Return where the file is on this machine.

        Raises:
            MissingFileError: There is no such file.
            FormatError: The path leads out of the dataset.
        """

    @abstractmethod
    def list(self, folder: str, suffix: str = "") -> list[str]:
        """Return the sorted relative paths of all files under a folder; empty if none.

        Hidden ones are left out, see `is_hidden`.
        """

    @abstractmethod
    def fetch(self, paths: Iterable[str]) -> None:
        """Download files that are not on this machine."""

    @abstractmethod
    def snapshot(self, *patterns: str) -> Path:
        """Return the folder that holds all files that match a pattern, such as `meta/*`."""

    @property
    @abstractmethod
    def location(self) -> str:
        """The argument of `hub.locate` for the same files."""

    @abstractmethod
    def describe(self) -> str:
        """Return the location for messages."""


@dataclass(frozen=True)
class LocalFiles(Files):
    """Files in a folder on this machine.

    Attributes:
        root: The folder.
        refetch: Command that downloads files which this copy of a published buffer set lacks; None
            for other folders.
    """

    root: Path
    refetch: str | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        # Another process may have another working directory.
        return LocalFiles, (self.root.absolute(), self.refetch)

    def path(self, relative: str) -> Path:
        """See `Files.path`."""
        path = self.root / check_relative(relative, self.describe())
        target = Path(os.path.realpath(path))  # unlike `Path.resolve`, it accepts circular links
        if not any(target.is_relative_to(folder) for folder in _linked_folders(self.root)):
            raise FormatError(
                f"{relative} in {self.root} is a link that leads out of the folder",
                "Replace the link by the file, or copy the folder with its files: "
                f"cp -rL {shlex.quote(str(self.root))} NEW",
            )
        try:
            exists = target.is_file()
        except OSError as error:
            if error.errno != errno.ENAMETOOLONG:
                raise
            raise FormatError.damaged(self.root, f"{relative[:80]!r}… is too long") from None
        if not exists:
            hint = "The folder is not a complete dataset: build it again, or give the right folder."
            if self.refetch is not None:
                hint = "This copy of a published buffer set lacks it; widen the copy."
            raise MissingFileError(f"{relative} is missing in {self.root}", hint, self.refetch)
        return path

    def list(self, folder: str, suffix: str = "") -> list[str]:
        """See `Files.list`."""
        matches = (self.root / folder).rglob(f"*{suffix}")
        names = (p.relative_to(self.root).as_posix() for p in matches if p.is_file())
        return sorted(name for name in names if not is_hidden(name))

    def fetch(self, paths: Iterable[str]) -> None:
        """Do nothing: the files are local."""

    def snapshot(self, *patterns: str) -> Path:
        """Return the folder."""
        return self.root

    @property
    def location(self) -> str:
        """The folder."""
        return str(self.root)

    def describe(self) -> str:
        """Return the folder."""
        return str(self.root)


def _linked_folders(root: Path) -> list[Path]:
    """Return the folders into which links of a folder may lead: itself, and the Hub's blobs.

    In the cache of the Hub's client, `CACHE/REPOSITORY/snapshots/COMMIT/…` has links to
    `CACHE/REPOSITORY/blobs`, which may lead on to the blobs that repositories share.
    """
    root = root.resolve()
    folders = [root]
    snapshots = (path.parent for path in (root, *root.parents) if path.parent.name == "snapshots")
    if (snapshot := next(snapshots, None)) is not None:
        repository = snapshot.parent
        folders.append(repository / "blobs")
        if (repository.parent / "blobs" / _SHARED_BLOBS).is_file():
            folders.append(repository.parent / "blobs")
    return folders


def is_hidden(relative: str) -> bool:
    """Return whether a path is that of a file which other programs left, such as `._a.parquet`.

    macOS, editors and interrupted downloads name them, or their folder, with a dot in front.
    """
    return any(part.startswith(".") for part in PurePosixPath(relative).parts)


def all_files(root: Path) -> list[str]:
    """Return the sorted relative paths of everything but folders; broken links are included."""
    paths = (path for path in root.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(path.relative_to(root).as_posix() for path in paths)


def check_relative(relative: str, where: str) -> str:
    """Return a path if it is relative and stays in its folder."""
    paths = (PurePosixPath(relative), PureWindowsPath(relative))  # the data may move to Windows
    try:
        os.fsencode(relative)
    except UnicodeEncodeError:
        raise FormatError.damaged(where, f"{relative!r} is not a valid path") from None
    if "\0" in relative or any(path.anchor or ".." in path.parts for path in paths):
        raise FormatError.damaged(where, f"the path {relative!r} leads out of it")
    return relative


# --- writing -------------------------------------------------------------------------------------


def write_json(path: Path, value: Any) -> None:
    """Write a value as `indented_json`, atomically."""
    write_text(path, indented_json(value))


def write_text(path: Path, text: str) -> None:
    r"""Write UTF-8 text with `\n` as line end, atomically; half a character becomes `\udcff`."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


@contextmanager
def with_filename(path: object) -> Iterator[None]:
    """Add a file name to the system's errors without one, such as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def atomic_path(path: Path, *, flush: bool = True) -> Iterator[Path]:
    """Give a temporary path that replaces `path` if the block succeeds, and is deleted otherwise.

    With `flush`, the data reaches the disk before the file gets its name.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    # In the same folder: a rename to another disk is not atomic.
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".partial")
    os.close(handle)
    partial = Path(name)
    try:
        with with_filename(path):
            yield partial
            # `mkstemp` makes files that only their owner can read.
            partial.chmod(0o644)
            if flush:
                with partial.open("rb+") as file:  # Windows flushes only what is open for writing
                    os.fsync(file.fileno())
            partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


# --- SHA-256 of files ----------------------------------------------------------------------------


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def format_sums(root: Path, paths: Iterable[str]) -> str:
    """Return the SHA-256 of files in the format of `sha256sum`, sorted by path."""
    return "".join(f"{sha256_file(root / path)}  {path}\n" for path in sorted(paths))


def digest_folder(folder: Path, patterns: Iterable[str]) -> str:
    """Return the SHA-256 over names and bytes of a folder's files that match a pattern."""
    paths = {path for pattern in patterns for path in folder.rglob(pattern) if path.is_file()}
    names = (path.relative_to(folder).as_posix() for path in paths)
    return hashlib.sha256(format_sums(folder, names).encode()).hexdigest()


def read_sums(path: Path) -> dict[str, str]:
    """Read a file in the format of `format_sums`: SHA-256 by path."""
    sums = {}
    for line in read_text(path, _MAX_SUMS_BYTES).splitlines():
        digest, gap, name = line.partition("  ")
        if not gap or len(digest) != 64 or not name:
            raise FormatError.damaged(path, f"{line[:80]!r} is not a SHA-256 and a path")
        sums[check_relative(name, str(path))] = digest
    return sums


# --- errors of pyarrow ---------------------------------------------------------------------------


@contextmanager
def reading(path: Path, hint: str | None = None) -> Iterator[None]:
    """Turn pyarrow's errors on a damaged file into `FormatError`.

    Args:
        path: The file.
        hint: What to do about a file that people may have written; None for that it is damaged.
    """
    import pyarrow as pa  # not to load or list a file

    try:
        yield
    except (InterferenceError, MemoryError):  # of pyarrow's, one is an `ArrowException`, too
        raise
    except (pa.ArrowException, OSError, ValueError, OverflowError, RecursionError) as error:
        what = f"cannot be read: {str(error).partition('\n')[0]}"
        if hint is None:
            raise FormatError.damaged(path, what) from None
        raise FormatError(f"{path}: {what}", hint) from None
