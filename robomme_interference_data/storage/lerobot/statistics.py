"""Statistics of images and vectors, in the form in which LeRobot stores them."""

import math
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from robomme_interference_data.constants import EPISODES_DIR
from robomme_interference_data.errors import FormatError

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

STATISTICS = ("min", "max", "mean", "std", "count", *QUANTILES)
"""Names of the statistics in the order of LeRobot's columns."""

Statistics = dict[str, dict[str, NDArray[Any]]]
"""Feature to name of a statistic to its values."""

_STEP = 4


class ImageStats:
    """Per-channel statistics of images, from every fourth row and column of every frame.

    LeRobot, too, estimates image statistics from downsampled frames. Counting the 256 values
    makes them exact on those pixels, and the same on every machine.
    """

    def __init__(self) -> None:
        self._counts = np.zeros((3, 256), np.int64)

    def add(self, image: NDArray[np.uint8]) -> None:
        """Count the pixels of a frame, `(H, W, 3) uint8`."""
        pixels = image[::_STEP, ::_STEP]
        for channel in range(3):
            self._counts[channel] += np.bincount(pixels[..., channel].ravel(), minlength=256)

    def result(self) -> dict[str, NDArray[np.float64]]:
        """Return statistic name to one value per channel, `(3,)`, on the scale 0 to 255."""
        values = np.arange(256, dtype=np.float64)
        total = self._counts.sum(axis=1)
        mean = (self._counts * values).sum(axis=1) / total
        variance = (self._counts * (values[None] - mean[:, None]) ** 2).sum(axis=1) / total
        cumulated = self._counts.cumsum(axis=1)
        quantiles = {
            name: np.argmax(cumulated >= quantile * total[:, None], axis=1).astype(np.float64)
            for name, quantile in QUANTILES.items()
        }
        return {
            "min": np.argmax(self._counts > 0, axis=1).astype(np.float64),
            "max": 255.0 - np.argmax(self._counts[:, ::-1] > 0, axis=1),
            "mean": mean,
            "std": np.sqrt(variance),
            "count": np.array([int(total[0])]),
            **quantiles,
        }


def vector_statistics(values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return the statistics of an episode's vectors or numbers, `(T, D)` or `(T,)`.

    They are computed in float64, which the squares of float32 values cannot exceed, and quantiles
    are values that occur.

    Returns:
        Statistic name to one value per dimension, `(D,)` or `(1,)`; `count` is `(1,)`.
    """
    columns = values.reshape(len(values), -1).astype(np.float64)
    ordered = np.sort(columns, axis=0)
    ranks = {
        name: max(math.ceil(quantile * len(columns)) - 1, 0) for name, quantile in QUANTILES.items()
    }
    return {
        "min": ordered[0],
        "max": ordered[-1],
        "mean": columns.mean(axis=0),
        "std": columns.std(axis=0),
        "count": np.array([len(columns)]),
        **{name: ordered[rank] for name, rank in ranks.items()},
    }


def episode_statistics(table: pa.Table) -> list[Statistics]:
    """Return the statistics of each episode in LeRobot's table, images on the scale 0 to 1."""
    columns = [name for name in table.column_names if name.startswith("stats/")]
    episodes: list[Statistics] = []
    for row in table.select(columns).to_pylist():
        episodes.append({})
        for column, values in row.items():
            feature, _, name = column.removeprefix("stats/").rpartition("/")
            try:
                numbers = np.ravel(np.asarray(values, np.int64 if name == "count" else np.float64))
            except (TypeError, ValueError):
                raise FormatError.damaged(EPISODES_DIR, f"{column} is {values}") from None
            episodes[-1].setdefault(feature, {})[name] = numbers
    return episodes


def before_scaling(name: str, values: NDArray[Any]) -> tuple[float, ...]:
    """Return the values of an image statistic before LeRobot divided them by 255, bit for bit.

    LeRobot divides again when it writes an extended dataset; of a lossy one, the frames that the
    statistics were computed from no longer exist.
    """
    if name == "count":
        return tuple(values.tolist())
    scaled = []
    for value in values.tolist():
        near = value * 255
        steps = (near, math.nextafter(near, math.inf), math.nextafter(near, -math.inf))
        scaled.append(next((step for step in steps if step / 255 == value), near))
    return tuple(scaled)
