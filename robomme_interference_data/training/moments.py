"""The moments of a `HistoryDataset`: of which episodes, and in which order."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DEMONSTRATIONS, EXECUTIONS, SPLITS
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.ids import EpisodeId, format_numbers, parse_numbers

from .rows import StoredRows


@dataclass(frozen=True)
class Moments:
    """The moments of the query episodes in use, which the items are, in canonical order.

    Attributes:
        episodes: The episodes.
        first: Row of each episode's first live frame, `(E,) int64`.
        actions: Actions of each episode from there on, `(E,) int64`; 0 where only the first moment
            is used.
        stops: Index after the last item of each episode, `(E,) int64`.
    """

    episodes: tuple[EpisodeId, ...]
    first: NDArray[np.int64]
    actions: NDArray[np.int64]
    stops: NDArray[np.int64]

    def __len__(self) -> int:
        return int(self.stops[-1])

    @property
    def most(self) -> int:
        """Most moments of an episode."""
        return int(np.diff(self.stops, prepend=0).max())

    @property
    def of_items(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Number of the episode of each item, and its moment, `(N,)` each."""
        counts = np.diff(self.stops, prepend=0)
        numbers = np.repeat(np.arange(len(counts)), counts)
        return numbers, np.arange(len(self)) - (self.stops - counts)[numbers]

    def locate(self, index: int) -> tuple[int, int]:
        """Return the number of the episode of an item, and the moment."""
        number = int(np.searchsorted(self.stops, index, "right"))
        return number, index - self._start(number)

    def index_of(self, episode: EpisodeId, moment: int) -> int:
        """Return the index of the item of an episode's moment."""
        if episode not in self.episodes:
            raise UnknownNameError.among("episode", str(episode), "the items", self.episodes)
        number = self.episodes.index(episode)
        start = self._start(number)
        count = int(self.stops[number]) - start
        if not 0 <= moment < count:
            raise UnknownNameError(f"{episode} has the moments 0 to {count - 1}; got {moment}")
        return start + moment

    def _start(self, number: int) -> int:
        """Return the index of the first item of an episode."""
        return int(self.stops[number - 1]) if number else 0


def choose_moments(
    buffer_set: BufferSet,
    rows: StoredRows,
    split: str,
    families: Sequence[str],
    episodes: str | None,
    *,
    actions: bool,
) -> Moments:
    """Return the moments of executions, or the first ones alone if actions are not needed.

    Args:
        buffer_set: The buffer set.
        rows: The rows of its datasets.
        split: Split of the episodes.
        families: Families of the episodes; empty for all.
        episodes: Indices of the episodes, such as `0-79`; None for all.
        actions: Whether each moment needs an action.

    Raises:
        InvalidOptionError: There are no such episodes, or not all of them.
        UnknownNameError: There is no such family.
    """
    _check_names(buffer_set, split, families)
    numbers = None if episodes is None else frozenset(parse_numbers(episodes))
    live = buffer_set.datasets[EXECUTIONS if actions else DEMONSTRATIONS]
    recorded = {
        record.episode_id: record
        for record in live.records()
        if buffer_set.holds(live, record.episode_index)
    }
    chosen = tuple(
        episode
        for episode in buffer_set.episode_ids
        if episode.split == split
        and episode.family in (families or buffer_set.families)
        and (numbers is None or episode.index in numbers)
        and episode in recorded
    )
    missing = (numbers or frozenset()) - {episode.index for episode in chosen}
    if missing or not chosen:
        expected = f"indices of {split} episodes in the {live.kind} of {buffer_set.location}"
        hint = f"They lack {format_numbers(sorted(missing))}." if missing else None
        raise InvalidOptionError.expected("episodes", episodes, expected, hint)
    records = [recorded[episode] for episode in chosen]
    counts = np.array([record.length if actions else 0 for record in records])
    # In the demonstrations, the first live frame follows the lesson; executions begin with it.
    first = [
        rows.first(live.kind, record.episode_index) + (record.exec_start_idx or 0)
        for record in records
    ]
    return Moments(chosen, np.array(first), counts, np.cumsum(np.maximum(counts, 1)))


def _check_names(buffer_set: BufferSet, split: str, families: Sequence[str]) -> None:
    """Check that there are episodes of a split and of families."""
    splits = {episode.split for episode in buffer_set.episode_ids}
    if split not in splits:
        names = " or ".join(repr(name) for name in SPLITS if name in splits)
        raise InvalidOptionError.expected(
            "split",
            split,
            f"{names}: {buffer_set.location} has no other episodes",
            "Train on train episodes only; for others, give their split.",
        )
    known = buffer_set.families
    for family in families:
        if family not in known:
            raise UnknownNameError.among("family", family, buffer_set.location, known)
