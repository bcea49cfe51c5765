"""Names of the features of a memory in the batches of LeRobot policies."""

MEMORY_PREFIX = "observation.memory."

MEMORY_POSITION = MEMORY_PREFIX + "position"
"""Index of each kept frame in history and execution together, `(B, M) int64`."""

MEMORY_PADDING = MEMORY_PREFIX + "padding"
"""True for the places without a frame, `(B, M) bool`."""

POSITION = "observation.position"
"""Index of the current frame in history and execution together, `(B,) int64`."""


def in_memory(feature: str) -> str:
    """Return the name of a feature's values in memory: `observation.memory.state`."""
    return MEMORY_PREFIX + feature.removeprefix("observation.")
