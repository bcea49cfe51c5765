"""Read the states of a buffer's sessions, and make one array of them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DEMONSTRATIONS, STATE, UNITS
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.schema.other_states import (
    OtherStates,
    check_rule,
    check_sizes,
    fit_states,
)

from .dataset import Dataset


def query_state_size(datasets: Mapping[str, Dataset]) -> int:
    """Return the number of values of the states of lessons and live observations."""
    (size,) = datasets[DEMONSTRATIONS].features[STATE]
    return size


def other_state_sizes(datasets: Mapping[str, Dataset]) -> dict[str, int]:
    """Return the datasets of units of another robot, by name, to the number of their values."""
    size = query_state_size(datasets)
    units = {name: datasets[name].features[STATE][0] for name in UNITS if name in datasets}
    return {name: other for name, other in units.items() if other != size}


class StateReader:
    """Reads states of a buffer's sessions, and keeps what it has read."""

    def __init__(self, manifest: BufferManifest, query: Dataset, datasets: Mapping[str, Dataset]):
        self._manifest, self._query, self._datasets = manifest, query, datasets
        self._sessions: dict[int, NDArray[np.float32]] = {}
        self._arrays: dict[OtherStates, NDArray[np.float32]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy in another process reads them again.
        return StateReader, (self._manifest, self._query, self._datasets)

    def session(self, number: int) -> NDArray[np.float32]:
        """Return the states of a session as they were recorded, `(n, D)`; not to be changed."""
        if number not in self._sessions:
            entry = self._manifest.sessions[number]
            stored = self._datasets[entry.dataset].read_vectors(
                entry.episode_index, STATE, entry.start, entry.stop
            )
            # A held frame is stored once, and counts `repeat` times.
            self._sessions[number] = np.repeat(stored, entry.repeat, 0)
        return self._sessions[number]

    def all(self, other_states: str) -> NDArray[np.float32]:
        """Return all states by a rule of `schema.other_states`, `(T, D)`; not to be changed.

        Raises:
            InvalidOptionError: There is no such rule, or it does not allow the states of a session.
        """
        rule = check_rule(other_states)
        if rule not in self._arrays:
            (size,) = self._query.features[STATE]
            entries = self._manifest.sessions
            sessions = [self.session(number) for number in range(len(entries))]
            sizes = {
                f"session {number} ({entry.source} of the {entry.dataset})": states.shape[1]
                for number, (entry, states) in enumerate(zip(entries, sessions, strict=True))
            }
            check_sizes(str(self._manifest), size, sizes, rule, 'states_by("{}")'.format)
            fitted = [fit_states(states, size, rule) for states in sessions]
            self._arrays[rule] = np.concatenate([np.empty((0, size), np.float32), *fitted])
        return self._arrays[rule]
