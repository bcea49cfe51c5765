"""What PyTorch's loaders need of a dataset: whole batches, and errors that they can report."""

from collections.abc import Callable, Sequence
from typing import Any

from torch.utils.data._utils.collate import collate, default_collate_fn_map

from robomme_interference_data.errors import InterferenceError


class Item(dict[str, Any]):
    """An item of a batch, which shares the memory of the batch's tensors."""


class Items(Sequence[Item]):
    """The items of a batch, which a loader passes to its `collate_fn`.

    PyTorch's own, `default_collate`, returns the batch itself. Any other finds a sequence of items.

    Attributes:
        batch: The batch, a dict of tensors and texts.
    """

    def __init__(self, batch: dict[str, Any]):
        self.batch = batch

    def __len__(self) -> int:
        return len(self.batch["index"])

    def __getitem__(self, place: Any) -> Any:
        if isinstance(place, slice):
            return [self[one] for one in range(len(self))[place]]
        if not -len(self) <= place < len(self):
            raise IndexError(place)  # which ends a loop over the items
        return Item(item_of(self.batch, place))


def item_of(batch: dict[str, Any], place: int) -> dict[str, Any]:
    """Return an item of a batch."""
    return {
        name: [texts[place] for texts in values]
        if name.endswith("question.options")  # O lists of the texts of B options
        else values[place]
        for name, values in batch.items()
    }


def _collate(items: Sequence[Item], *, collate_fn_map: Any = None) -> dict[str, Any]:
    """Return the batch of items; of those that did not come together, the collated ones."""
    if isinstance(items, Items):
        return items.batch
    collated: dict[str, Any] = collate([*map(dict, items)], collate_fn_map=collate_fn_map)
    return collated


default_collate_fn_map[Item] = _collate  # where PyTorch looks for the types of others


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


def made_or_unusable[T](make: Callable[..., T], *arguments: Any) -> T | Unusable:
    """Return what a function makes, or what raises its error when an item is taken."""
    try:
        return make(*arguments)
    except InterferenceError as error:
        return Unusable(error)
