"""A `HistoryDataset` in another process, such as a spawned worker of a loader.

Memory maps and tables cannot be pickled: the other process opens the buffer set again.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from robomme_interference_data.errors import HashMismatchError, InterferenceError
from robomme_interference_data.storage.files import LocalFiles

from .epoch import Epoch

if TYPE_CHECKING:
    from .history_dataset import HistoryDataset


class Unusable:
    """A dataset that another process cannot open again.

    A loader reports errors of items in the process that trains, but an error while a dataset is
    unpickled only ends its worker.
    """

    def __init__(self, error: InterferenceError):
        self._error = error

    def __getitem__(self, index: object) -> Any:
        raise self._error

    def __getitems__(self, indices: Sequence[int]) -> Any:
        raise self._error


def reduced(data: "HistoryDataset", arguments: dict[str, Any]) -> tuple[Any, ...]:
    """Return what pickles a dataset: a function, and what it needs to open it again."""
    files = data.buffer_set.files
    # Another process may have another working directory.
    location = str(files.root.absolute()) if isinstance(files, LocalFiles) else files.location
    return open_again, (type(data), location, arguments, data._epoch, data.content)


def open_again(
    kind: "type[HistoryDataset]",
    location: str,
    arguments: dict[str, Any],
    epoch: Epoch,
    content: str,
) -> "HistoryDataset | Unusable":
    """Return a dataset in another process, with the same items."""
    try:
        made = kind(location, **arguments, quiet=True)
        # Items are numbered over all episodes: in a set that grew, an index means another moment.
        if made.content != content:
            raise HashMismatchError(
                f"{location} was changed since the training began: a worker finds other items",
                "Start the training again; do not change a buffer set that is in use.",
            )
    except InterferenceError as error:
        return Unusable(error)
    made._epoch = epoch
    return made
