"""Resize frames for training and, in the same way, for a policy in a rollout."""

import numpy as np
from numpy.typing import NDArray


def resize(frames: NDArray[np.uint8], size: int | None) -> NDArray[np.uint8]:
    """Return frames with their channels first, as squares of `size` pixels.

    Each pixel is the mean of the pixels that it covers (PyTorch's adaptive average pooling),
    rounded half to even. Sums of bytes are exact, so the result is the same on every machine.

    Args:
        frames: `(T, H, W, 3) uint8` RGB, both sides at least `size`.
        size: Side in pixels; None for no change of size.

    Returns:
        `(T, 3, size, size) uint8`, or `(T, 3, H, W) uint8` if `size` is None.
    """
    first = np.ascontiguousarray(frames.transpose(0, 3, 1, 2))
    if size is None or first.shape[2:] == (size, size):
        return first
    import torch
    from torch.nn.functional import adaptive_avg_pool2d

    pooled = adaptive_avg_pool2d(torch.from_numpy(first).float(), (size, size))
    return pooled.round().to(torch.uint8).numpy()
