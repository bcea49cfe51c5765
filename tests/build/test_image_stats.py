"""Statistics of images, as LeRobot stores them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.image_stats import ImageStats

SHAPES = st.tuples(st.integers(1, 5), st.integers(1, 13), st.integers(1, 13), st.just(3))


@given(arrays(np.uint8, SHAPES))
def test_statistics_against_numpy_in_any_order(images: NDArray[np.uint8]) -> None:
    stats, backward = ImageStats(), ImageStats()
    for image, last in zip(images, images[::-1], strict=True):
        stats.add(image)
        backward.add(last)
    result = stats.result()
    assert all(v.tobytes() == backward.result()[name].tobytes() for name, v in result.items())
    pixels = images[:, ::4, ::4].reshape(-1, 3).astype(np.float64)  # every fourth row and column
    assert result["count"].tolist() == [len(pixels)]
    np.testing.assert_array_equal(result["min"], pixels.min(0))
    np.testing.assert_array_equal(result["max"], pixels.max(0))
    np.testing.assert_allclose(result["mean"], pixels.mean(0), rtol=1e-12)
    np.testing.assert_allclose(result["std"], pixels.std(0), rtol=1e-9, atol=1e-9)
    for name, quantile in (("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)):
        # The smallest value that at least so many of the pixels do not exceed.
        expected = np.quantile(pixels, quantile, axis=0, method="inverted_cdf")
        np.testing.assert_array_equal(result[name], expected)
