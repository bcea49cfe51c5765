"""The cache of decoded frames: bounded, shared, and never trusted when damaged."""

import os
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.messages import raises

from robomme_interference_data import DecodedCache
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.storage.cache import default_cache_folder

SHAPE = (4, 8, 8, 3)
FILE_BYTES = 4 * 8 * 8 * 3 + 128


def frames(seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, SHAPE).astype(np.uint8)


def name(seed: int) -> str:
    return f"{seed:064x}"


def used_at(cache: DecodedCache, seed: int, second: int) -> None:
    """Set when a file was last used: clocks may be too coarse to order two writes."""
    os.utime(cache.folder / f"{name(seed)}.npy", (second, second))


def test_put_and_get(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path / "cache")
    assert cache.get(name(1), SHAPE) is None
    assert not cache.folder.exists()  # asking makes nothing
    cache.put(name(1), frames(1))
    found = cache.get(name(1), SHAPE)
    assert found is not None
    np.testing.assert_array_equal(found, frames(1))
    assert isinstance(found, np.memmap)
    with raises(ValueError):
        found[0] = 0
    assert [path.name for path in cache.folder.iterdir()] == [f"{name(1)}.npy"]


def test_put_replaces_and_another_shape_or_type_counts_as_absent(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path)
    cache.put(name(1), frames(1))
    held = cache.get(name(1), SHAPE)
    cache.put(name(1), frames(2))
    np.testing.assert_array_equal(held, frames(1))  # a map that is in use keeps its file
    np.testing.assert_array_equal(cache.get(name(1), SHAPE), frames(2))
    assert cache.get(name(1), (5, 8, 8, 3)) is None
    np.save(tmp_path / f"{name(2)}.npy", frames(2).astype(np.int8))
    assert cache.get(name(2), SHAPE) is None
    (tmp_path / f"{name(3)}.npy").mkdir()
    assert cache.get(name(3), SHAPE) is None
    path = tmp_path / f"{name(1)}.npy"
    path.write_bytes(path.read_bytes()[:-1])  # damaged
    assert cache.get(name(1), SHAPE) is None
    cache.put(name(1), frames(1))  # and written anew
    np.testing.assert_array_equal(cache.get(name(1), SHAPE), frames(1))


def test_least_used_go_first(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path, max_bytes=3 * FILE_BYTES)
    for seed in (1, 2, 3):
        cache.put(name(seed), frames(seed))
        used_at(cache, seed, second=seed)
    assert cache.get(name(1), SHAPE) is not None  # used now, so 2 is the least used
    cache.put(name(4), frames(4))
    assert cache.get(name(2), SHAPE) is None
    for seed in (1, 3, 4):
        np.testing.assert_array_equal(cache.get(name(seed), SHAPE), frames(seed))


@pytest.mark.parametrize("bound", [FILE_BYTES, 2 * FILE_BYTES - 1, 5 * FILE_BYTES, 10**9])
def test_the_bound_holds_after_every_put(tmp_path: Path, bound: int) -> None:
    cache = DecodedCache(tmp_path, max_bytes=bound)
    for seed in range(8):
        cache.put(name(seed), frames(seed))
        used_at(cache, seed, second=seed)
        sizes = [path.stat().st_size for path in tmp_path.iterdir()]
        assert sum(sizes) <= bound
        assert sizes == [FILE_BYTES] * min(seed + 1, bound // FILE_BYTES)
    DecodedCache(tmp_path / "smaller", FILE_BYTES - 1).put(name(1), frames(1))
    assert not (tmp_path / "smaller").exists()
    with raises(InvalidOptionError):
        DecodedCache(tmp_path, max_bytes=0)


def test_other_files_stay(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path, max_bytes=FILE_BYTES)
    others = [tmp_path / "mine.npy", tmp_path / f"{name(1)}.npz", tmp_path / f"{name(1)[:-1]}.npy"]
    for path in others:
        path.write_bytes(bytes(2 * FILE_BYTES))
        os.utime(path, (0, 0))
    cache.put(name(1), frames(1))
    assert sorted(tmp_path.iterdir()) == sorted([*others, tmp_path / f"{name(1)}.npy"])


def test_with_verify_other_frames_count_as_absent(tmp_path: Path) -> None:
    cache, right = DecodedCache(tmp_path), sha256(frames(1).tobytes()).hexdigest()
    for seed, found in ((1, True), (2, False), (1, True)):
        cache.put(right, frames(seed))
        assert cache.get(right, SHAPE) is not None
        assert (cache.get(right, SHAPE, verify=True) is not None) == found


def test_many_at_once(tmp_path: Path) -> None:
    """Several users share a folder that holds fewer files than they use."""
    cache = DecodedCache(tmp_path, max_bytes=3 * FILE_BYTES)

    def use(worker: int) -> None:
        for turn in range(60):
            seed = (turn * (worker + 1)) % 7
            found = cache.get(name(seed), SHAPE)
            if found is None:
                cache.put(name(seed), frames(seed))
            else:
                np.testing.assert_array_equal(found, frames(seed))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(use, range(4)))
    cache.put(name(99), frames(99))
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 3 * FILE_BYTES


def test_default_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_folder() == tmp_path / "robomme-interference" / "decoded"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert default_cache_folder() == tmp_path / ".cache" / "robomme-interference" / "decoded"


def test_a_cache_that_only_others_may_write_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = DecodedCache(tmp_path)
    cache.put(name(1), frames(1))

    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "utime", refuse)
    np.testing.assert_array_equal(cache.get(name(1), SHAPE), frames(1))
