"""What a buffer set consists of: the table of its manifests, and its datasets, opened on use."""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cached_property
from itertools import chain, compress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    DATASETS,
    MANIFEST_HEADER,
    MANIFEST_ROWS,
    MANIFESTS,
    OPTIONAL_DATASETS,
    RULE_VERSION,
)
from robomme_interference_data.errors import (
    FormatError,
    HashMismatchError,
    MissingFileError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import arrow_schema, from_table, to_pandas
from robomme_interference_data.schema.manifest import BufferManifest, ManifestHeader
from robomme_interference_data.storage.files import Files, LocalFiles, sha256_file
from robomme_interference_data.storage.parquet import RowSpan

from .dataset import Dataset

if TYPE_CHECKING:
    import pandas

# As Python objects, rows take many times the memory of the table.
_BATCH_ROWS = 1024
_KEYS = ("episode_id", "condition", "difficulty")


def pending_rows(header: ManifestHeader) -> str:
    """Return the path of the rows while a build replaces those of an earlier header."""
    return f"{MANIFESTS}/.{header.rows}.parquet"


class ManifestTable:
    """`buffers.parquet`, of which only the rows in use are read.

    Attributes:
        path: The file.
    """

    def __init__(self, files: Files, header: ManifestHeader):
        pending = pending_rows(header)
        # A build that is killed while it replaces both files has written the header, and the rows
        # under this name.
        replaced = isinstance(files, LocalFiles) and (files.root / pending).is_file()
        self.path: Path = files.path(pending if replaced else f"{MANIFESTS}/{MANIFEST_ROWS}")
        self._header, self._where = header, files.describe()

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.keys["episode_id"])

    @cached_property
    def keys(self) -> dict[str, list[str | None]]:
        """The columns that identify and filter buffers.

        Raises:
            FormatError: One is not text, or two rows are of one buffer.
        """
        keys: dict[str, list[str | None]] = self._rows.table([*_KEYS]).to_pydict()
        for column, values in keys.items():
            if not all(value is None or isinstance(value, str) for value in values):
                raise FormatError.damaged(self.path, f"column {column} is not text")
        pairs = Counter(zip(keys["episode_id"], keys["condition"], strict=True))
        for (episode, condition), count in pairs.most_common(1):
            if count > 1:
                raise FormatError.damaged(self.path, f"{count} rows of {episode} under {condition}")
        # Not the column of that name, which a reader of the table alone may filter by.
        keys["family"] = [EpisodeId.parse(text or "").family for text in keys["episode_id"]]
        return keys

    @cached_property
    def row_of(self) -> dict[tuple[str | None, str | None], int]:
        """The number of each row, by episode id and condition."""
        pairs = zip(self.keys["episode_id"], self.keys["condition"], strict=True)
        return {pair: row for row, pair in enumerate(pairs)}

    def record(self, row: int) -> BufferManifest:
        """Return the manifest in a row."""
        return next(from_table(BufferManifest, self._rows.part(row, row + 1).table(), self.path))

    def records(self, keep: NDArray[np.bool_]) -> Iterator[BufferManifest]:
        """Yield the manifests in some rows; `keep` has a truth value for each row."""
        return chain.from_iterable(
            from_table(BufferManifest, table, self.path) for table in self.tables(keep)
        )

    def tables(self, keep: NDArray[np.bool_]) -> Iterator[pa.Table]:
        """Yield some rows as tables; `keep` has a truth value for each row."""
        for first in range(0, len(keep), _BATCH_ROWS):
            mask = keep[first : first + _BATCH_ROWS]
            if mask.any():
                yield self._rows.part(first, first + len(mask)).table().filter(mask)

    def matching(
        self, allowed: Mapping[str, Collection[str]], among: NDArray[np.bool_], where: str
    ) -> NDArray[np.bool_]:
        """Return whether each row has all the wanted properties.

        Args:
            allowed: Allowed values by column of `keys`; none for all values.
            among: The rows to choose from, a truth value for each.
            where: Location of the buffer set, for errors.

        Raises:
            UnknownNameError: No row of those has one of the values.
        """
        keep = among.copy()
        for column, values in allowed.items():
            known = {value for value in compress(self.keys[column], among) if value is not None}
            for value in values:
                if value not in known:
                    raise UnknownNameError.among(column, value, where, known)
            if values:
                keep &= np.array([value in values for value in self.keys[column]])
        return keep

    def to_pandas(self, keep: NDArray[np.bool_]) -> "pandas.DataFrame":
        """Return some rows as a pandas `DataFrame`; `keep` has a truth value for each row."""
        tables = [*self.tables(keep)]
        none = arrow_schema(BufferManifest).empty_table()
        return to_pandas(pa.concat_tables(tables) if tables else none)

    def check(self, fix: str) -> None:
        """Check the file against its hash in the header.

        Args:
            fix: Hint for the error.

        Raises:
            HashMismatchError: It differs.
            FormatError: The rows follow rules of an unknown version.
        """
        version = self._header.rule_version
        if version != RULE_VERSION:
            raise FormatError(
                f"{self._where} follows version {version} of the rules; this package can check "
                f"{RULE_VERSION}",
                "Install the version of robomme-interference-data that made it.",
            )
        if sha256_file(self.path) != self._header.rows:
            raise HashMismatchError(
                f"{self.path} does not have the SHA-256 in {MANIFEST_HEADER}",
                fix,
                "verify BUFFER_SET",
            )

    @cached_property
    def _rows(self) -> RowSpan:
        return RowSpan(self.path)


def dataset_files(files: Files, header: ManifestHeader, name: str) -> Files:
    """Return access to a dataset's files.

    A folder with the dataset's name in a local buffer set takes precedence over the location
    that the manifests record.

    Args:
        files: The buffer set's files.
        header: Its header.
        name: The dataset's name.

    Raises:
        FormatError: The folder is a link that leads out of the buffer set.
        MissingFileError: There is no folder, and no location is recorded.
    """
    location = header.datasets[name].location
    if isinstance(files, LocalFiles) and (location is None or (files.root / name).is_dir()):
        folder = files.root / name
        if not folder.resolve().is_relative_to(files.root.resolve()):
            raise FormatError(
                f"{folder} is a link that leads out of the buffer set",
                "Replace the link by the folder.",
            )
        return LocalFiles(folder, files.refetch)
    # A published buffer set lies in the repository of its demonstrations.
    if location == ".":
        return files
    from robomme_interference_data.storage.hub import HubFiles

    if location is not None:
        return HubFiles.parse(location)
    # Optional datasets are folders of that repository.
    if not isinstance(files, HubFiles) or name not in OPTIONAL_DATASETS:
        raise MissingFileError(
            f"the manifests of {files.location} do not record the location of its {name}",
            "Those of a published buffer set do.",
            "publish BUFFER_SET --repo-id NAMESPACE/NAME",
        )
    return files.inside(name)


class SetDatasets(Mapping[str, Dataset]):
    """The datasets of a buffer set, each opened on first access.

    Args:
        names: The planned ones; in a partial copy, those that are there.
        files_of: Returns access to the files of one.
        header: The buffer set's header.
        fix: Hint and command of the error about a dataset of another revision.
    """

    def __init__(
        self,
        names: Sequence[str],
        files_of: Callable[[str], Files],
        header: ManifestHeader,
        fix: tuple[str, str | None],
    ):
        self._names, self._files_of, self._header, self._fix = names, files_of, header, fix
        self._opened: dict[str, Dataset] = {}

    def __getitem__(self, name: str) -> Dataset:
        if name not in self._opened:
            recorded, files = self._header.datasets[name], self._files_of(name)
            if isinstance(files, LocalFiles):
                _check_is_there(files.root)
            dataset = Dataset(files)
            if dataset.revision != recorded.revision:
                raise HashMismatchError(
                    f"{dataset.files.describe()} has revision {dataset.revision[:12]}…; the "
                    f"manifests were made for {recorded.revision[:12]}…",
                    *self._fix,
                )
            self._opened[name] = dataset
        return self._opened[name]

    def __contains__(self, name: object) -> bool:
        # The method of `Mapping` would open the dataset to find out.
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _check_is_there(folder: Path) -> None:
    """Check that a dataset's folder exists; if not, name the folder that may be meant."""
    if folder.is_dir():
        return
    known = (*DATASETS, MANIFESTS)
    others = sorted(path.name for path in folder.parent.glob("[!.]*/") if path.name not in known)
    # Letters of other alphabets look alike: `ascii` tells them apart.
    found = f"; there is {', '.join(map(ascii, others))}" if others else ""
    raise MissingFileError(
        f"the folder {folder} is missing{found}",
        f"Restore the folder {folder.name!r}, or build the {folder.name} again.",
    )
