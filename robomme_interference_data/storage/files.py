"""Access the files of a dataset, read text and JSON within bounds, and write files atomically."""

import codecs
import errno
import hashlib
import json
import math
import os
import shlex
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, NoReturn

from robomme_interference_data.constants import FORMAT_VERSION
from robomme_interference_data.errors import FormatError, InterferenceError, MissingFileError

_MAX_JSON_BYTES = 16 << 20
"""Our files have some thousand bytes, and Python takes forty times as many for some values."""

_MAX_TEXT_BYTES = 64 << 20
"""A CSV file with a line for each of half a million episodes."""

_MAX_SUMS_BYTES = 64 << 20
"""A list of the SHA-256 of half a million files."""

_POINTER = b"version https://git-lfs.github.com/spec/"
"""First bytes of the text that stands for a file which Git LFS has not downloaded."""

_SHARED_BLOBS = ".huggingface-shared-blobs"
"""File with which the Hub's client marks the blobs that repositories in its cache share."""

_MAX_DEPTH = 64
"""Nesting of JSON: Python can read more than it can always print, compare or write."""


_CORRECT = "Correct it, restore it from a copy, or download or build it again."
"""What to do about text that may have been edited."""


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


# --- JSON ----------------------------------------------------------------------------------------


def canonical_json(value: Any) -> str:
    """Return the one JSON text of a value: sorted keys, no spaces, UTF-8, no NaN."""
    # Any program can make the same text: no escapes but those that JSON requires.
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def digest_json(values: Iterable[Any], end: str = "") -> str:
    """Return the SHA-256 over the canonical JSON of values in turn, `end` after each."""
    digest = hashlib.sha256()
    for value in values:
        # Half a surrogate pair, which a JSON file may hold, has no UTF-8.
        digest.update((canonical_json(value) + end).encode(errors="backslashreplace"))
    return digest.hexdigest()


def indented_json(value: Any) -> str:
    """Return the JSON text of a value for files: indented, with sorted keys, no NaN."""
    text = json.dumps(value, sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False)
    return text + "\n"


def check_not_pointer(path: Path) -> None:
    """Check that a file holds its content: a clone without Git LFS has short texts instead.

    Raises:
        MissingFileError: The file is a pointer of Git LFS.
    """
    with path.open("rb") as file:
        _check_start(path, file.read(len(_POINTER)))


def _check_start(path: Path, data: bytes) -> None:
    if data.startswith(_POINTER):
        clones = (folder for folder in path.resolve().parents if (folder / ".git").exists())
        raise MissingFileError(
            f"{path} is a Git LFS pointer, not the file",
            f"Install Git LFS, then run `git lfs pull` in {next(clones, path.parent)}",
        )


def read_text(path: Path, most: int = _MAX_TEXT_BYTES) -> str:
    """Read text that people or their programs wrote, of at most `most` bytes: see `decode_text`."""
    return decode_text(read_bytes(path, most), path)


def decode_text(data: bytes, where: object) -> str:
    """Decode text in UTF-8, or in UTF-16 or UTF-8 with the mark that programs of Windows write.

    Raises:
        FormatError: It has another encoding; nothing in the data tells which, so none is guessed.
    """
    first = [byte != 0 for byte in data[:2]]
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding, shown = "utf-16", "UTF-16"
    elif first in ([True, False], [False, True]):  # of two bytes for a letter, one is zero
        name = "UTF-16LE" if first[0] else "UTF-16BE"
        raise FormatError(
            f"{where} is not text in UTF-8, but in {name} without its mark",
            f"Save it as UTF-8, such as with iconv -f {name} -t UTF-8 OLD > NEW.",
        )
    else:
        encoding, shown = "utf-8-sig", "UTF-8"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        before = data[: error.start].decode(encoding).rpartition("\n")[2][-40:]
        place = f"after {before!r}" if before else "at the beginning of a line"
        raise FormatError(
            f"{where} is not text in {shown}: byte 0x{data[error.start]:02x} {place}",
            "Save it as UTF-8. Text in Latin-1 or Windows-1252 is converted by iconv "
            "-f WINDOWS-1252 -t UTF-8 OLD > NEW; a downloaded file may be damaged.",
        ) from None


def read_bytes(path: Path, most: int) -> bytes:
    """Return the bytes of a file that has at most `most`."""
    with path.open("rb") as file:
        # Of the open file: by now, another one may have the path.
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise FormatError(f"{path}: {size:,} bytes; expected at most {most:,}", _CORRECT)
        data = file.read()
    _check_start(path, data)  # not by opening it again: it may be a pipe
    return data


def read_json(path: Path, *, nan_as_none: bool = False) -> dict[str, Any]:
    """Read a JSON file that holds an object; see `parse_json`."""
    return parse_json(read_bytes(path, _MAX_JSON_BYTES), path, nan_as_none=nan_as_none)


def parse_json(data: bytes, where: object, *, nan_as_none: bool = False) -> dict[str, Any]:
    """Parse a JSON object, in which keys are unique and numbers are finite; see `decode_text`.

    With `nan_as_none`, for files of other programs, NaN and infinities are read as None: Python and
    pandas write NaN for values that are missing.
    """
    text = decode_text(data, where)
    decoder = _JSON_WITH_NAN if nan_as_none else _JSON
    try:
        value = decoder.decode(text)
        # The number of brackets bounds the depth, and is quickly counted.
        if data.count(b"[") + data.count(b"{") > _MAX_DEPTH and _is_deep(value):
            raise ValueError(f"over {_MAX_DEPTH} nested arrays and objects")
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{where}: not valid JSON: {error}", _CORRECT) from None
    if not isinstance(value, dict):
        raise FormatError(f"{where}: not a JSON object", _CORRECT)
    return value


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _not_finite(text)


def _not_finite(text: str) -> NoReturn:
    raise ValueError(f"{text[:80]} is not a finite number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    # Of two equal keys, readers take different ones: what one checks, another does not use.
    if len(value) < len(pairs):
        names = [name for name, _ in pairs]
        duplicate = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {duplicate[:80]!r} occurs twice")
    return value


_JSON = json.JSONDecoder(object_pairs_hook=_unique, parse_float=_finite, parse_constant=_not_finite)
_JSON_WITH_NAN = json.JSONDecoder(
    object_pairs_hook=_unique, parse_float=_finite, parse_constant=lambda text: None
)


def _is_deep(value: Any) -> bool:
    level = [value]
    for _ in range(_MAX_DEPTH):
        level = [
            inner
            for outer in level
            for inner in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(inner, dict | list)
        ]
    return bool(level)


def read_header[T](path: Path, record: type[T]) -> T:
    """Read the JSON header of a folder as a record with the current `format_version`, if any."""
    from robomme_interference_data.schema.codec import descriptions, from_dict

    value = read_json(path)
    if "format_version" in descriptions(record):
        version = value.get("format_version")
        if version != FORMAT_VERSION:
            raise FormatError(
                f"{path} has format version {version!r}; this package reads {FORMAT_VERSION}",
                "Install the version of robomme-interference-data that wrote it, or build it "
                "again.",
            )
    return from_dict(record, value, path, strict=True)


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
