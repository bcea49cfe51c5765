"""Names of the entries of items and batches, in each layout of a `HistoryDataset`.

LeRobot's processors keep entries below `observation.`, `action`, `task`, `index` and `…_is_pad`,
and drop all others. So in the layout `lerobot`, what a policy may see is below `observation.`, and
what it must not see is below `label.`.
"""

from collections.abc import Mapping
from typing import Any

from robomme_interference_data.schema.memory_features import MEMORY_PADDING, POSITION

LAYOUTS = ("plain", "lerobot")
"""The layouts: the names that `HistoryDataset` lists, and those of this module."""

_RENAMED = {
    "memory.is_pad": MEMORY_PADDING,
    "memory.evidence": "label.evidence",
    "evidence_known": "label.evidence_known",
    "position": POSITION,
    "question.answer": "label.answer",
    "condition": "label.condition",
    "shift": "label.shift",
    "episode_id": "label.episode_id",
}
_MOVED = ("memory.", "question")
"""Beginnings of the other names that move below `observation.`"""


def memory_entry(feature: str) -> str:
    """Return the name of a feature's values in memory, in the layout `plain`: `memory.state`."""
    return f"memory.{feature.removeprefix('observation.')}"


def renamed(batch: Mapping[str, Any]) -> dict[str, Any]:
    """Return an item or a batch with the names of the layout `lerobot`."""
    return {_renamed(name): values for name, values in batch.items()}


def _renamed(name: str) -> str:
    if name in _RENAMED:
        return _RENAMED[name]
    return f"observation.{name}" if name.startswith(_MOVED) else name
