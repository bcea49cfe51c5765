"""Arrays in files: as numpy writes them, and nothing else is read; digests of decoded data."""

import errno
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from support.messages import raises

from robomme_interference_data.errors import FormatError
from robomme_interference_data.storage.arrays import (
    FeatureDigests,
    combine,
    read_array,
    write_array,
)


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("shape", [(), (0, 3), (5,), (2, 3, 4, 3)])
def test_arrays_are_as_numpy_writes_them(tmp_path: Path, order: Any, shape: Any) -> None:
    for dtype in (np.uint8, np.float16, np.float32):
        array = np.ones(shape, dtype, order)
        write_array(tmp_path / "a.npy", array)
        np.save(tmp_path / "b.npy", np.asarray(array, order="C"))
        assert (tmp_path / "a.npy").read_bytes() == (tmp_path / "b.npy").read_bytes()


def test_a_full_disk_raises_the_systems_error() -> None:
    with raises(OSError) as caught:
        write_array(Path("/dev/full"), np.zeros(10**6, np.uint8))
    assert caught.value.errno == errno.ENOSPC


@given(st.sampled_from([np.uint8, np.float16, np.float32]), st.data())
def test_what_is_written_is_read(tmp_path_factory: Any, dtype: Any, data: st.DataObject) -> None:
    shape = data.draw(hnp.array_shapes(min_dims=1, max_dims=4, min_side=0, max_side=5))
    array = data.draw(hnp.arrays(dtype, shape, elements=hnp.from_dtype(np.dtype(np.uint8))))
    path = tmp_path_factory.mktemp("arrays") / "a.npy"
    write_array(path, array)
    for expected_shape in (shape, (-1, *shape[1:])):
        found = read_array(path, dtype, expected_shape)
        assert found.dtype == dtype and found.shape == shape and np.array_equal(found, array)


@pytest.mark.parametrize(
    "array",
    [
        np.ones((2, 8), np.float32),
        np.ones((2, 7), np.float16),
        np.ones((8, 2), np.float16).T,
        np.ones((2, 8), ">f2"),
        np.zeros((2, 8), [("a", "<f2")]),
        np.array([[None]]),
    ],
)
def test_other_arrays_raise(tmp_path: Path, array: Any) -> None:
    np.save(tmp_path / "a.npy", array)
    with raises(FormatError):
        read_array(tmp_path / "a.npy", np.float16, (-1, 8))


def test_a_file_is_as_long_as_its_header_says(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    write_array(path, np.ones((2, 8), np.float16))
    data = path.read_bytes()
    for wrong in (data[:-1], data + b"\0", data[:128], data[:100], data[:9], b""):
        path.write_bytes(wrong)
        with raises(FormatError):
            read_array(path, np.float16, (-1, 8))


# --- digests -------------------------------------------------------------------------------------


def images(count: int) -> NDArray[np.uint8]:
    return np.random.default_rng(count).integers(0, 256, (count, 4, 6, 3)).astype(np.uint8)


def vectors(count: int) -> NDArray[np.float32]:
    return np.random.default_rng(count).normal(size=(count, 8)).astype(np.float32)


def feature_digest(values: NDArray[Any]) -> str:
    digests = FeatureDigests()
    digests.update("feature", values)
    return digests.current()["feature"]


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
