"""The manifest table of a buffer set: which row holds which buffer, and its manifest."""

from collections import Counter
from collections.abc import Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MANIFEST_HEADER, MANIFEST_ROWS, MANIFESTS
from robomme_interference_data.errors import FormatError, HashMismatchError
from robomme_interference_data.schema.codec import from_table
from robomme_interference_data.schema.manifest import BufferManifest, ManifestHeader
from robomme_interference_data.storage.files import LocalFiles, sha256_file
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.storage.parquet import RowSpan

_BATCH = 1024
"""Rows that are read at a time."""


def pending_rows(header: ManifestHeader) -> str:
    """Return the path of the rows while a build replaces those of an earlier header."""
    return f"{MANIFESTS}/.{header.rows}.parquet"


class ManifestTable:
    """The manifest table of a buffer set.

    Args:
        files: Where the buffer set lies.
        header: Header of its manifests.
    """

    def __init__(self, files: LocalFiles | HubFiles, header: ManifestHeader):
        self._header = header
        pending = pending_rows(header)
        replaced = isinstance(files, LocalFiles) and (files.root / pending).is_file()
        self.path = files.path(pending if replaced else f"{MANIFESTS}/{MANIFEST_ROWS}")
        self._rows = RowSpan(self.path)

    def check(self, hint: str) -> None:
        """Check the table against the SHA-256 in the header."""
        if sha256_file(self.path) != self._header.rows:
            what = f"{self.path} does not have the SHA-256 of {MANIFEST_HEADER}"
            raise HashMismatchError(what, hint)

    @cached_property
    def keys(self) -> dict[str, list[str | None]]:
        """The columns by which buffers are found."""
        columns = ["episode_id", "condition", "family", "difficulty"]
        keys: dict[str, list[str | None]] = self._rows.table(columns).to_pydict()
        for column, values in keys.items():
            if not all(value is None or isinstance(value, str) for value in values):
                raise FormatError.damaged(self.path, f"column {column} is not text")
        pairs = Counter(zip(keys["episode_id"], keys["condition"], strict=True))
        for (episode, condition), count in pairs.most_common(1):
            if count > 1:
                what = f"{count} rows of {episode} under {condition}"
                raise FormatError.damaged(self.path, what)
        return keys

    @cached_property
    def _row_of(self) -> dict[tuple[str | None, str | None], int]:
        """The row of each buffer by its key."""
        pairs = zip(self.keys["episode_id"], self.keys["condition"], strict=True)
        return {pair: row for row, pair in enumerate(pairs)}

    def manifest(self, episode: str, condition: str) -> BufferManifest | None:
        """Return the manifest of a buffer; None if there is none."""
        row = self._row_of.get((episode, condition))
        if row is None:
            return None
        return next(from_table(BufferManifest, self._rows.part(row, row + 1).table(), self.path))

    def manifests(self, keep: NDArray[np.bool_]) -> Iterator[BufferManifest]:
        """Yield the manifests of the rows to keep, `(T,) bool`."""
        for first in range(0, len(keep), _BATCH):
            wanted = keep[first : first + _BATCH]
            if wanted.any():
                table = self._rows.part(first, first + len(wanted)).table()
                yield from from_table(BufferManifest, table.filter(wanted), self.path)
