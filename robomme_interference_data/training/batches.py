"""The tensors of a batch: which frames its items have in memory, now, and as actions."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION, STATE
from robomme_interference_data.schema.sampling import Memory

from .item_draws import DrawnItem
from .layout import memory_entry
from .moments import Moments
from .rows import PADDING, StoredRows


class Batches:
    """Makes the arrays of batches; see `HistoryDataset` for their names and shapes.

    Args:
        rows: The stored frames, states and actions.
        moments: The moments of the executions.
        memory: The memory rule.
        cameras: Features of the cameras.
        chunk: Actions per item.
        places: Places in memory.
        parts: Most parts of an answer.
    """

    def __init__(
        self,
        rows: StoredRows,
        moments: Moments,
        memory: Memory,
        cameras: Sequence[str],
        chunk: int,
        places: int,
        parts: int,
    ):
        self._rows, self._moments, self._memory = rows, moments, memory
        self._features, self._chunk = (*cameras, STATE), chunk
        self._places, self._parts = places, parts

    def arrays(self, items: Sequence[DrawnItem]) -> dict[str, NDArray[Any]]:
        """Return the entries of a batch that are arrays."""
        rows, batch = self._in_memory(items)
        now = np.array([drawn.now for drawn in items])
        for name in self._features:
            batch[name] = self._rows.take(name, now)
            batch[memory_entry(name)] = self._rows.take(name, rows)
        moment = np.array([drawn.moment for drawn in items])
        batch["position"] = moment + [len(drawn.history.rows) for drawn in items]
        if self._chunk:
            numbers = [drawn.number for drawn in items]
            steps = moment[:, None] + np.arange(self._chunk)
            last = self._moments.actions[numbers][:, None] - 1
            first = self._moments.first[numbers][:, None]
            # After the end the last action repeats, as LeRobot pads its chunks.
            batch[ACTION] = self._rows.take(ACTION, first + np.minimum(steps, last))
            batch["action_is_pad"] = steps > last
        batch["frame_index"] = moment
        batch["index"] = np.array([drawn.item for drawn in items])
        return batch

    def _in_memory(self, items: Sequence[DrawnItem]) -> tuple[NDArray[np.int64], dict[str, Any]]:
        """Return the rows of the frames in memory, `(B, M)`, and what is known of each place."""
        places = len(items), self._places
        rows, position = np.full(places, PADDING), np.zeros(places, np.int64)
        is_pad = np.ones(places, bool)
        evidence = np.zeros((*places, self._parts), bool)
        for place, drawn in enumerate(items):
            past, shown = drawn.history.rows, drawn.history.evidence
            kept = np.asarray(self._memory.earlier(len(past) + drawn.moment), np.int64)
            count, ended = len(kept), int(kept.searchsorted(len(past)))
            rows[place, :ended] = past[kept[:ended]]
            # Frames after the history are of the execution, which begins at its own row.
            rows[place, ended:count] = kept[ended:] + (
                self._moments.first[drawn.number] - len(past)
            )
            position[place, :count], is_pad[place, :count] = kept, False
            if shown is not None:
                evidence[place, :ended] = shown[kept[:ended]]
        known = np.array([drawn.history.evidence is not None for drawn in items])
        return rows, {
            "memory.position": position,
            "memory.is_pad": is_pad,
            "memory.evidence": evidence,
            "evidence_known": known,
        }
