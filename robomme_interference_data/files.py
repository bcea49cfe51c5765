"""Reach the files of a dataset, and write files so that none is ever seen half-written."""

import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from robomme_interference_data.errors import FormatError, MissingFileError

__all__ = [
    "Files",
    "LocalFiles",
    "atomic_path",
    "canonical_json",
    "check_names",
    "read_json",
    "sha256_file",
    "write_json",
]


class Files(Protocol):
    """The one way in which this package reaches the files of a dataset or split.

    A path is always relative, with `/`, such as `meta/info.json`.
    """

    def path(self, relative: str) -> Path:
        """Return where the file lies on this machine, fetching it first if need be.

        Raises:
            MissingFileError: There is no such file.
        """
        ...

    def list(self, folder: str, suffix: str = "") -> list[str]:
        """Return the sorted relative paths of all files under a folder; empty if none."""
        ...

    def describe(self) -> str:
        """Return the place in words, for messages: a folder, or a repository and revision."""
        ...


@dataclass(frozen=True)
class LocalFiles:
    """Files in a folder on this machine."""

    root: Path

    def path(self, relative: str) -> Path:
        """Return the file's path; see `Files.path`."""
        path = self.root / relative
        if not path.is_file():
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

    def describe(self) -> str:
        """Return the folder."""
        return str(self.root)


def canonical_json(value: Any) -> str:
    """Return the one JSON text of a value: sorted keys, no spaces, UTF-8, no NaN."""
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


_DAMAGED = "The file is damaged: download or build it again."


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        FormatError: The file is not JSON or holds something else.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise FormatError(f"{path} is not JSON: {error}", _DAMAGED) from None
    if not isinstance(value, dict):
        raise FormatError(f"{path} holds no JSON object", _DAMAGED)
    return value


def check_names(path: Path, found: Iterable[str], expected: Iterable[str]) -> None:
    """Check that a file has all expected columns or keys.

    Raises:
        FormatError: It lacks some.
    """
    present = set(found)
    missing = [name for name in expected if name not in present]
    if missing:
        raise FormatError(f"{path} lacks {', '.join(missing)}", _DAMAGED)


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON with sorted keys, atomically."""
    text = json.dumps(value, sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False)
    with atomic_path(path) as partial:
        partial.write_text(text + "\n", encoding="utf-8")


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Give a temporary path beside `path` that becomes `path` if the block succeeds.

    The data reaches the disk before the name does; if the block fails, nothing is left behind.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".partial")
    os.close(handle)
    partial = Path(name)
    try:
        yield partial
        partial.chmod(0o644)
        with partial.open("rb") as file:
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def sha256_file(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
