"""The memory of LeRobot policies: how one declares it, and names of its features in batches."""

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


def declares_memory(config: object) -> bool:
    """Return whether the configuration of a policy declares a memory.

    It does by two fields: `memory`, a rule such as `framesamp:32` (see `Memory`), and `image_size`,
    the side of current images and of those in memory in pixels; None for no change of size.
    """
    return hasattr(config, "memory") and hasattr(config, "image_size")
