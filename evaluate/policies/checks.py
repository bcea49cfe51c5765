"""What adapters check of the arrays that pass between the harness and a policy."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import PolicyError
from robomme_interference_data.evaluate.policies.base import Frames

__all__ = ["ACTION_SIZE", "check_actions", "check_frames", "plain"]

ACTION_SIZE = 8
"""Numbers in a state and in an action: 7 joints and the gripper."""


def check_frames(frames: Frames, states: NDArray[np.float32], camera: str) -> NDArray[np.uint8]:
    """Return the frames of a camera, `(T, H, W, 3) uint8`, T at least 1.

    Raises:
        PolicyError: They are not there, or frames and `states` do not fit each other.
    """
    if camera not in frames:
        raise PolicyError(
            f"the frames of camera {camera!r} are missing; given: {', '.join(frames) or 'none'}"
        )
    images = frames[camera]
    ok = images.ndim == 4 and images.shape[-1] == 3 and images.dtype == np.uint8 and len(images)
    if not ok or states.shape != (len(images), ACTION_SIZE):
        raise PolicyError(
            f"{images.dtype} frames of shape {images.shape} with states of shape {states.shape}; "
            f"expected uint8 (T, H, W, 3) with (T, {ACTION_SIZE}), T at least 1"
        )
    return images


def check_actions(actions: Any) -> NDArray[np.float32]:
    """Return actions as `(n, 8) float32`, n at least 1.

    Raises:
        PolicyError: They have another shape, or are not finite numbers.
    """
    given = np.asarray(actions)
    if (
        given.ndim != 2
        or given.shape[1] != ACTION_SIZE
        or not len(given)
        or given.dtype.kind != "f"
    ):
        raise PolicyError(
            f"actions of shape {given.shape} and dtype {given.dtype}; "
            f"expected floats of shape (n, {ACTION_SIZE}), n at least 1"
        )
    if not np.isfinite(given).all():
        raise PolicyError("actions that are not finite numbers")
    return given.astype(np.float32)


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: long arrays become a word on their shape."""
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return value.tolist() if value.size <= 32 else f"{value.dtype} array {value.shape}"
    if isinstance(value, np.generic):
        return value.item()
    return value if value is None or isinstance(value, bool | int | float | str) else repr(value)
