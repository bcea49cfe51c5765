"""Statistics of values, by the names that LeRobot's normalizers read."""

import numpy as np
from numpy.typing import NDArray

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Statistics = dict[str, NDArray[np.float64] | NDArray[np.int64]]
"""`mean`, `std`, `min`, `max`, the quantiles `q01` to `q99`, and the `count` of values, `(1,)`."""


def of_vectors(values: NDArray[np.float32]) -> Statistics:
    """Return the statistics of `(N, D)` values, `(D,)` each; `std` is that of the population."""
    exact = values.astype(np.float64)
    found: Statistics = {
        "mean": exact.mean(0),
        "std": exact.std(0),
        "min": exact.min(0),
        "max": exact.max(0),
    }
    quantiles = np.quantile(exact, list(_QUANTILES.values()), axis=0)
    found |= dict(zip(_QUANTILES, quantiles, strict=True))
    return found | {"count": np.array([len(values)])}


def of_images(frames: NDArray[np.uint8]) -> Statistics:
    """Return the statistics of the pixels of `(N, 3, H, W)` images, `(3, 1, 1)`, from 0 to 1.

    `count` is the number of images.
    """
    # There are only 256 values: their counts replace sorting millions of pixels.
    counts = np.stack(
        [np.bincount(frames[:, channel].ravel(), minlength=256) for channel in range(3)]
    )
    level, pixels = np.arange(256) / 255, counts[0].sum()
    mean = counts @ level / pixels
    below = counts.cumsum(1)
    ends = {
        "min": level[(counts > 0).argmax(1)],
        "max": level[255 - (counts[:, ::-1] > 0).argmax(1)],
    }
    # The lowest value with at least this share of the pixels at or below it.
    quantiles = {
        name: level[(below >= share * pixels).argmax(1)] for name, share in _QUANTILES.items()
    }
    spread = np.sqrt((counts * (level - mean[:, None]) ** 2).sum(1) / pixels)
    found = {"mean": mean, "std": spread, **ends, **quantiles}
    shaped: Statistics = {name: values.reshape(3, 1, 1) for name, values in found.items()}
    return shaped | {"count": np.array([len(frames)])}
