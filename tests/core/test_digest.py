"""Digests over decoded data can be recomputed with hashlib alone."""

import hashlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from robomme_interference_data.storage.arrays import FeatureDigests, combine


def images(count: int) -> NDArray[np.uint8]:
    return np.random.default_rng(count).integers(0, 256, (count, 4, 6, 3)).astype(np.uint8)


def vectors(count: int) -> NDArray[np.float32]:
    return np.random.default_rng(count).normal(size=(count, 8)).astype(np.float32)


def feature_digest(values: NDArray[Any]) -> str:
    digests = FeatureDigests()
    digests.update("feature", values)
    return digests.current()["feature"]


def test_feature_digest_by_hand() -> None:
    # 1.0 and -2.0 as little-endian float32: 0000803f and 000000c0.
    expected = hashlib.sha256(bytes.fromhex("0000803f000000c0")).hexdigest()
    assert feature_digest(np.array([[1.0, -2.0]], np.float32)) == expected
    pixels = np.array([[[[1, 2, 3], [4, 5, 6]]]], np.uint8)
    assert feature_digest(pixels) == hashlib.sha256(bytes([1, 2, 3, 4, 5, 6])).hexdigest()


@pytest.mark.parametrize("values", [images(0), vectors(0), images(3), vectors(5)])
def test_feature_digest_is_that_of_the_bytes_whatever_their_layout(
    values: NDArray[np.generic],
) -> None:
    expected = hashlib.sha256(values.tobytes()).hexdigest()
    values.setflags(write=False)
    for one in (values, np.asfortranarray(values), values[:, ::-1].copy()[:, ::-1]):
        assert feature_digest(one) == expected


@given(st.integers(1, 12), st.data())
def test_values_may_pass_by_in_any_portions(count: int, data: st.DataObject) -> None:
    pixels, states = images(count), vectors(count)
    digests = FeatureDigests()
    position = 0
    while position < count:
        step = data.draw(st.integers(1, count - position))
        if step == 1:
            digests.update("front", pixels[position])
            digests.update("state", states[position])
        else:
            digests.update("state", states[position : position + step])
            digests.update("front", pixels[position : position + step])
        position += step
        assert digests.current() == {
            "front": feature_digest(pixels[:position]),
            "state": feature_digest(states[:position]),
        }


def test_combine() -> None:
    assert combine({"b": "22", "a": "11"}) == hashlib.sha256(b'{"a":"11","b":"22"}').hexdigest()
    assert combine({"b": "22", "a": "11"}) == combine({"a": "11", "b": "22"})
    # A digest belongs to its feature: swapping two features is a difference.
    assert combine({"a": "22", "b": "11"}) != combine({"a": "11", "b": "22"})
    assert combine({"a": "11"}) != combine({"a": "11", "b": "22"})
