"""Statistics as LeRobot stores them are accepted, and others are not."""

import numpy as np
import pytest

from robomme_interference_data.build_dataset.image_stats import QUANTILES
from robomme_interference_data.build_dataset.lerobot_checks import differing_statistics


def stored(values: np.ndarray) -> dict[str, np.ndarray]:
    """What LeRobot computes in 32 bits of `(T, D)` values."""
    found = {name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")}
    found |= {
        name: np.quantile(values, quantile, axis=0, method="inverted_cdf")
        for name, quantile in QUANTILES.items()
    }
    return found | {"count": np.array([len(values)])}


@pytest.mark.parametrize("frames", [32, 256, 1077])
def test_means_in_32_bits_are_those_of_the_data(frames: int) -> None:
    """An arm that hardly moves: the sum of equal values loses the most."""
    values = np.full((frames, 8), 2.7182817, np.float32)
    values[:, 1] = -1.9634954 + 1e-4 * np.arange(frames, dtype=np.float32)
    assert [*differing_statistics(stored(values), values.astype(float))] == []


@pytest.mark.parametrize("name", ["min", "max", "mean", "count"])
def test_a_changed_value_is_found(name: str) -> None:
    values = np.full((256, 8), 2.7182817, np.float32)
    changed = stored(values)
    changed[name] = changed[name] + 1e-3
    assert [*differing_statistics(changed, values.astype(float))] == [name]
