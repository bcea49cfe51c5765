"""What an item is: the moment of an index, and what an epoch draws for it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import SHIFTED
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.views import shifted_view
from robomme_interference_data.schema.shifts import Shift, parse_shift

from .draws import Weights
from .histories import DrawnHistory, Histories
from .moments import Moments
from .rows import StoredRows


class DrawnItem(NamedTuple):
    """A moment of an episode, with its condition, its history and its current frame."""

    item: int  # its index
    number: int  # of the episode
    moment: int
    condition: str
    shift: str
    history: DrawnHistory
    now: int  # row of the current frame


class ItemDraws:
    """Draws conditions and shifts for items, and finds histories and current frames.

    Args:
        buffer_set: The buffer set.
        rows: The rows of its datasets.
        moments: The moments that the items are of.
        histories: The histories of their episodes.
        conditions: Conditions with their weights.
        shifts: Shifts of the first live observation with their weights.
        seed: Seed of all draws.

    Attributes:
        shifts: The shifts by name; None for no shift.
    """

    def __init__(
        self,
        buffer_set: BufferSet,
        rows: StoredRows,
        moments: Moments,
        histories: Histories,
        conditions: Weights,
        shifts: Weights,
        seed: int,
    ):
        self._set, self._rows, self._moments = buffer_set, rows, moments
        self._histories, self._seed = histories, seed
        self._conditions, self._shift_weights = conditions, shifts
        self.shifts = {name: parse_shift(name) for name in shifts.names}

    @property
    def live_rows(self) -> NDArray[np.int64]:
        """Rows of the first live observations; those of later ones belong to the same spans."""
        numbers, shifts = range(len(self._moments.episodes)), self.shifts.values()
        return np.array([self._live_row(number, shift) for shift in shifts for number in numbers])

    def draw(self, epoch: int, index: int) -> DrawnItem:
        """Return the item that an index means in an epoch.

        Raises:
            IndexError: There is no item of that index; negative ones count from the end.
        """
        count = len(self._moments)
        if not -count <= index < count:
            raise IndexError(f"index {index} of {count} items")
        index %= count
        number, moment = self._moments.locate(index)
        condition = self._conditions.draw("condition", self._seed, epoch, index)
        name = self._shift_weights.draw("shift", self._seed, epoch, index)
        shift = self.shifts[name]
        history = self._histories.get(epoch, self._moments.episodes[number], condition, shift)
        now = self._live_row(number, shift) + moment
        return DrawnItem(index, number, moment, condition, name, history, now)

    def _live_row(self, number: int, shift: Shift | None) -> int:
        """Return the row of the first live observation of an episode, given by its number."""
        if shift is None:
            return int(self._moments.first[number])
        _, stored, frame = shifted_view(self._set, self._moments.episodes[number], shift)
        return self._rows.first(SHIFTED, stored) + frame
