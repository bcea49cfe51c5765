"""What a repository is to hold, file by file, and how that differs from what it holds."""

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath

from robomme_interference_data.storage.files import sha256_file


@dataclass(frozen=True)
class Content:
    """What a file is to hold.

    Attributes:
        source: The bytes, or a file on this machine that holds them.
        recorded: Their SHA-256, if it is known.
    """

    source: bytes | Path
    recorded: str | None = None

    @cached_property
    def size(self) -> int:
        """Number of bytes."""
        return len(self.source) if isinstance(self.source, bytes) else self.source.stat().st_size

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the bytes: by it the Hub knows large files."""
        if self.recorded is not None:
            return self.recorded
        if isinstance(self.source, bytes):
            return hashlib.sha256(self.source).hexdigest()
        return sha256_file(self.source)

    @cached_property
    def blob(self) -> str:
        """SHA-1 of the bytes as git makes it: by it the Hub knows small files."""
        return hashlib.sha1(b"blob %d\0%b" % (self.size, self.read())).hexdigest()

    def read(self) -> bytes:
        """Return the bytes."""
        return self.source if isinstance(self.source, bytes) else self.source.read_bytes()


Tree = dict[str, Content]
"""What a repository is to hold, by path."""


@dataclass(frozen=True)
class Entry:
    """A file of a repository, as its listing tells it.

    Attributes:
        size: Number of bytes.
        blob: SHA-1 of what git keeps.
        sha256: SHA-256 of a large file, of which git keeps only a pointer; None of a small one.
    """

    size: int
    blob: str
    sha256: str | None = None

    def holds(self, content: Content) -> bool:
        """Tell whether it is a file with this content."""
        if self.size != content.size:
            return False
        return content.blob == self.blob if self.sha256 is None else content.sha256 == self.sha256


@dataclass(frozen=True)
class Difference:
    """How what a repository is to hold differs from what it holds: sorted paths.

    Attributes:
        added: Are not there.
        changed: Are there with another content.
        removed: Are there, and are not to be.
    """

    added: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.added or self.changed or self.removed)

    @property
    def sent(self) -> tuple[str, ...]:
        """Paths that have to be sent."""
        return (*self.added, *self.changed)

    def __str__(self) -> str:
        told = [
            f"{len(paths):,} {what} (such as {paths[0]})"
            for what, paths in vars(self).items()
            if paths
        ]
        return ", ".join(told) or "no difference"


def compare(tree: Mapping[str, Content], there: Mapping[str, Entry]) -> Difference:
    """Return how a tree differs from the files of a repository; what is `beside` is left aside."""
    both = sorted(tree.keys() & there.keys())
    return Difference(
        added=tuple(sorted(tree.keys() - there.keys())),
        changed=tuple(path for path in both if not there[path].holds(tree[path])),
        removed=tuple(sorted(path for path in there.keys() - tree.keys() if not beside(path))),
    )


def beside(path: str) -> bool:
    """Tell whether a file is the Hub's or its owner's: hidden files, and a licence."""
    name = PurePosixPath(path).parts[0]
    return name.startswith(".") or (name.startswith("LICENSE") and name == path)


def total_size(tree: Mapping[str, Content], paths: Iterable[str] | None = None) -> int:
    """Return the bytes of files of a tree: of all, or of these."""
    return sum(tree[path].size for path in (tree if paths is None else paths))
