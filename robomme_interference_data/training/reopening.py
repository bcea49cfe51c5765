"""What stands for a dataset that a spawned worker of a loader cannot open again."""

from collections.abc import Callable, Sequence
from typing import Any

from robomme_interference_data.errors import InterferenceError


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
