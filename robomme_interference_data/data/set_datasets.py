"""The datasets of a buffer set: where each is stored, opened on first access."""

from collections.abc import Callable, Iterator, Mapping, Sequence

from robomme_interference_data.constants import OPTIONAL_DATASETS
from robomme_interference_data.errors import FormatError, HashMismatchError, MissingFileError
from robomme_interference_data.schema.manifest import ManifestHeader
from robomme_interference_data.storage.files import Files, LocalFiles

from .dataset import Dataset


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
    if location == ".":
        return files
    from robomme_interference_data.storage.hub import HubFiles

    if location is not None:
        return HubFiles.parse(location)
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
            recorded = self._header.datasets[name]
            dataset = Dataset(self._files_of(name))
            if dataset.revision != recorded.revision:
                raise HashMismatchError(
                    f"{dataset.files.describe()} has revision {dataset.revision[:12]}…; the "
                    f"manifests were made for {recorded.revision[:12]}…",
                    *self._fix,
                )
            self._opened[name] = dataset
        return self._opened[name]

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)
