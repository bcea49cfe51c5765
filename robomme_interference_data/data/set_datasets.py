"""The datasets of a buffer set: where each is stored, opened on first access."""

from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import TYPE_CHECKING

from robomme_interference_data.constants import OPTIONAL_DATASETS
from robomme_interference_data.errors import FormatError, HashMismatchError, MissingFileError
from robomme_interference_data.schema.manifest import ManifestHeader
from robomme_interference_data.storage.files import Files, LocalFiles
from robomme_interference_data.storage.hub import HubFiles

from .dataset import Dataset

if TYPE_CHECKING:
    from .buffer_set import BufferSet


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
    if location is None and isinstance(files, HubFiles) and name in OPTIONAL_DATASETS:
        return files.inside(name)
    if location is None:
        raise MissingFileError(
            f"the manifests of {files.location} do not record the location of its {name}",
            "Those of a published buffer set do.",
            "publish BUFFER_SET --repo-id NAMESPACE/NAME",
        )
    return files if location == "." else HubFiles.parse(location)


class SetDatasets(Mapping[str, Dataset]):
    """The datasets of a buffer set, each opened on first access."""

    def __init__(self, buffer_set: "BufferSet"):
        self._buffer_set = buffer_set
        self._opened: dict[str, Dataset] = {}

    def __getitem__(self, name: str) -> Dataset:
        if name not in self._opened:
            recorded = self._buffer_set.header.datasets[name]
            dataset = Dataset(self._buffer_set.dataset_files(name))
            if dataset.revision != recorded.revision:
                raise HashMismatchError(
                    f"{dataset.files.describe()} has revision {dataset.revision[:12]}…; the "
                    f"manifests were made for {recorded.revision[:12]}…",
                    self._buffer_set.fix,
                    f"build {self._buffer_set.location} --only manifests"
                    if self._buffer_set.is_own
                    else None,
                )
            self._opened[name] = dataset
        return self._opened[name]

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    @cached_property
    def _names(self) -> tuple[str, ...]:
        """All that are planned; in a partial copy, those that are there."""
        buffer_set, copy = self._buffer_set, self._buffer_set.copy
        return tuple(
            name
            for name in buffer_set.header.datasets
            if copy is None or copy.has_dataset(buffer_set.dataset_files(name))
        )
