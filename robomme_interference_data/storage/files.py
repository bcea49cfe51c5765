"""Reach the files of a dataset, and write files so that none is ever seen half-written."""

import errno
import hashlib
import json
import math
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NoReturn, Protocol

from robomme_interference_data.constants import FORMAT_VERSION
from robomme_interference_data.errors import FormatError, MissingFileError

_MOST_JSON = 16 << 20
"""Bytes of a file of JSON, at most: ours have some thousand, and Python takes forty times as many
for some values."""

_MOST_SUMS = 64 << 20
"""Bytes of a list of SHA-256, at most: those of half a million files."""

_DEEPEST = 64
"""Lists and maps of JSON inside each other, at most: what Python reads, it cannot always show,
compare or write again."""


class Files(Protocol):
    """The one way in which this package reaches the files of a dataset or buffer set.

    A path is always relative, with `/`, such as `meta/info.json`. Paths come out of data files
    that a stranger may have written: none leads out of the dataset, not by a link either.
    """

    def path(self, relative: str) -> Path:
        """Return where the file lies on this machine, fetching it first if need be."""
        ...

    def list(self, folder: str, suffix: str = "") -> list[str]:
        """Return the sorted relative paths of all files under a folder; empty if none."""
        ...

    def fetch(self, paths: Iterable[str]) -> None:
        """Bring files to this machine that are about to be read, several at a time."""
        ...

    def snapshot(self, *patterns: str) -> Path:
        """Return the folder that holds all files, bringing those here that match a pattern."""
        ...

    @property
    def location(self) -> str:
        """What `locate` finds the same files by: a folder, or `namespace/name@commit`."""
        ...

    def describe(self) -> str:
        """Return the location in words, for messages only."""
        ...


@dataclass(frozen=True)
class LocalFiles:
    """Files in a folder on this machine."""

    root: Path

    def path(self, relative: str) -> Path:
        """Return the file's path; see `Files.path`."""
        path = self.root / check_relative(relative, self.describe())
        # Links are followed only inside the folder, and into the store that the Hub's client
        # keeps the files of a snapshot, or of a folder in one, in.
        root = self.root.resolve()
        stores = (one.parent.parent / "blobs" for one in (root, root.parent) if _is_snapshot(one))
        store = next(stores, root)
        real = Path(os.path.realpath(path))  # which a link that goes round does not stop
        if not (real.is_relative_to(root) or real.is_relative_to(store)):
            raise FormatError(
                f"{relative} in {self.root} is a link that leads out of the folder",
                "Put the file itself there.",
            )
        try:
            there = real.is_file()
        except OSError as error:
            if error.errno != errno.ENAMETOOLONG:
                raise
            raise FormatError.damaged(self.root, f"{relative[:80]!r}… is too long") from None
        if not there:
            raise MissingFileError(
                f"{relative} is missing in {self.root}",
                "The folder is not a complete dataset: build it again, or point to the folder "
                "that holds it.",
            )
        return path

    def list(self, folder: str, suffix: str = "") -> list[str]:
        """Return the files under a folder; see `Files.list`."""
        found = (self.root / folder).rglob(f"*{suffix}")
        return sorted(p.relative_to(self.root).as_posix() for p in found if p.is_file())

    def fetch(self, paths: Iterable[str]) -> None:
        """Do nothing: the files are here; see `Files.fetch`."""

    def snapshot(self, *patterns: str) -> Path:
        """Return the folder; see `Files.snapshot`."""
        return self.root

    @property
    def location(self) -> str:
        """The folder."""
        return str(self.root)

    def describe(self) -> str:
        """Return the folder."""
        return str(self.root)


def all_files(root: Path) -> list[str]:
    """Return the sorted relative paths of all that is no folder, links that lead nowhere too."""
    found = (path for path in root.rglob("*") if path.is_symlink() or not path.is_dir())
    return sorted(path.relative_to(root).as_posix() for path in found)


def _is_snapshot(folder: Path) -> bool:
    return folder.parent.name == "snapshots"


def check_relative(relative: str, where: str) -> str:
    """Return a relative path that stays in its folder."""
    path = PurePosixPath(relative)
    try:
        os.fsencode(relative)
    except UnicodeEncodeError:
        raise FormatError.damaged(where, f"{relative!r} is no path") from None
    if path.is_absolute() or ".." in path.parts or "\0" in relative:
        raise FormatError.damaged(where, f"the path {relative!r} leads out of it")
    return relative


def canonical_json(value: Any) -> str:
    """Return the one JSON text of a value: sorted keys, no spaces, UTF-8, no NaN."""
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def indented_json(value: Any) -> str:
    """Return the JSON text of a value as files have it: indented, with sorted keys, no NaN."""
    text = json.dumps(value, sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False)
    return text + "\n"


def read_bytes(path: Path, most: int) -> bytes:
    """Return a file's bytes."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise FormatError.damaged(path, f"{size:,} bytes; at most {most:,} are read")
        return file.read()


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object."""
    return parse_json(read_bytes(path, _MOST_JSON), path)


def parse_json(data: bytes, where: object) -> dict[str, Any]:
    """Read JSON: an object, in which no key occurs twice and all numbers are finite.

    Args:
        data: UTF-8.
        where: What is read, for messages.
    """
    try:
        value = _JSON.decode(data.decode())
        if data.count(b"[") + data.count(b"{") > _DEEPEST and _is_deep(value):
            raise ValueError(f"over {_DEEPEST} lists and maps inside each other")
    except (ValueError, RecursionError) as error:
        raise FormatError.damaged(where, f"not JSON: {error}") from None
    if not isinstance(value, dict):
        raise FormatError.damaged(where, "no JSON object")
    return value


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:80]} is no finite number")
    return value


def _not_finite(name: str) -> NoReturn:
    raise ValueError(f"{name} is no finite number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{twice[:80]!r} occurs twice")
    return found


_JSON = json.JSONDecoder(object_pairs_hook=_unique, parse_float=_finite, parse_constant=_not_finite)


def _is_deep(value: Any) -> bool:
    inside = [value]
    for _ in range(_DEEPEST):
        inside = [
            one
            for outer in inside
            for one in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(one, dict | list)
        ]
    return bool(inside)


def read_header[T](path: Path, record: type[T]) -> T:
    """Read a JSON file as a record, if it has the `format_version` of this package."""
    from robomme_interference_data.schema.codec import descriptions, from_dict

    value = read_json(path)
    if "format_version" in descriptions(record):
        version = value.get("format_version")
        if version != FORMAT_VERSION:
            raise FormatError(
                f"{path} has format version {version!r}; this package reads {FORMAT_VERSION}",
                "Install the version of robomme-interference-data that wrote it, or make it again.",
            )
    return from_dict(record, value, path, strict=True)


def write_json(path: Path, value: Any) -> None:
    """Write a value as `indented_json`, atomically."""
    write_text(path, indented_json(value))


def write_text(path: Path, text: str) -> None:
    r"""Write UTF-8 text, lines ending alike on every system, atomically.

    Of a file's name that is not UTF-8, its bytes are written as JSON would: `\udcff`.
    """
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8", errors="backslashreplace", newline="\n")


@contextmanager
def with_filename(place: object) -> Iterator[None]:
    """Add a file name to the system's error where it has none: that of a full disk has not."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(place)
        raise


@contextmanager
def atomic_path(path: Path, *, flush: bool = True) -> Iterator[Path]:
    """Give a temporary path beside `path` that becomes `path` if the block succeeds.

    If the block fails, nothing is left behind.

    Args:
        path: The file to write.
        flush: Let the data reach the disk before the name does.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".partial")
    os.close(handle)
    partial = Path(name)
    try:
        with with_filename(path):
            yield partial
            partial.chmod(0o644)
            if flush:
                with partial.open("rb") as file:
                    os.fsync(file.fileno())
            partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def format_sums(root: Path, paths: Iterable[str]) -> str:
    """Return the SHA-256 of files as `sha256sum` writes them, a line each, sorted by path."""
    return "".join(f"{sha256_file(root / path)}  {path}\n" for path in sorted(paths))


def digest_folder(folder: Path, patterns: Iterable[str]) -> str:
    """Return the SHA-256 over names and bytes of a folder's files that fit one of the patterns."""
    found = {path for pattern in patterns for path in folder.rglob(pattern) if path.is_file()}
    names = (path.relative_to(folder).as_posix() for path in found)
    return hashlib.sha256(format_sums(folder, names).encode()).hexdigest()


def read_sums(path: Path) -> dict[str, str]:
    """Read a file of what `format_sums` returns: SHA-256 by path."""
    sums = {}
    try:
        lines = read_bytes(path, _MOST_SUMS).decode().splitlines()
    except UnicodeDecodeError as error:
        raise FormatError.damaged(path, error) from None
    for line in lines:
        digest, gap, name = line.partition("  ")
        if not gap or len(digest) != 64 or not name:
            raise FormatError.damaged(path, f"{line[:80]!r} is no line of SHA-256 and path")
        sums[check_relative(name, str(path))] = digest
    return sums
