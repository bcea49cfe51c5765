"""The cache of decoded frames: bounded, shared, and never trusted when damaged."""

import logging
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.messages import raises

from robomme_interference_data import DecodedCache
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.storage.cache import cache_folder

SHAPE = (4, 8, 8, 3)
FILE_BYTES = 4 * 8 * 8 * 3 + 32


def frames(seed: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, SHAPE).astype(np.uint8)


def name(seed: int) -> str:
    return f"{seed:064x}"


def get(cache: DecodedCache, seed: int) -> tuple[NDArray[np.uint8], bool]:
    """Return the frames of a seed, and whether they were decoded now."""
    decoded = []

    def decode() -> Iterator[NDArray[np.uint8]]:
        decoded.append(seed)
        return iter(frames(seed))

    found = cache.frames(name(seed), SHAPE, decode)
    np.testing.assert_array_equal(found, frames(seed))
    return found, bool(decoded)


def used_at(cache: DecodedCache, seed: int, second: int) -> None:
    """Set when a file was last used: clocks may be too coarse to order two uses."""
    path = cache.folder / name(seed)
    os.utime(path, ns=(second * 10**9, path.stat().st_mtime_ns))


def test_what_is_stored_is_not_decoded_again(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path / "cache")
    assert get(cache, 1)[1]
    found, decoded = get(cache, 1)
    assert not decoded
    with raises(ValueError):
        found[0] = 0
    assert [path.name for path in cache.folder.iterdir()] == [name(1)]
    assert not get(DecodedCache(tmp_path / "cache"), 1)[1]


def overwrite_by_zeros(path: Path) -> None:
    path.write_bytes(bytes(FILE_BYTES - 32) + path.read_bytes()[-32:])


def shorten(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-1])


def empty(path: Path) -> None:
    path.write_bytes(b"")


@pytest.mark.parametrize("damage", [overwrite_by_zeros, shorten, empty])
def test_damaged_frames_are_decoded_again(
    damage: object, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Also in a process that opened the file before it was damaged."""
    cache = DecodedCache(tmp_path)
    get(cache, 1)
    damage(tmp_path / name(1))  # type: ignore[operator]
    with caplog.at_level(logging.WARNING):
        assert get(cache, 1)[1]
    assert name(1) in caplog.text
    assert not get(cache, 1)[1]


def test_a_digest_is_compared_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = DecodedCache(tmp_path)
    get(cache, 1)
    monkeypatch.setattr("hashlib.sha256", None)
    assert not get(cache, 1)[1]


def test_a_map_that_is_in_use_keeps_its_file(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path)
    held, _ = get(cache, 1)
    (tmp_path / name(1)).unlink()
    assert get(cache, 1)[1]
    np.testing.assert_array_equal(held, frames(1))


def test_least_used_go_first(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path, max_bytes=3 * FILE_BYTES)
    for seed in (1, 2, 3):
        get(cache, seed)
        used_at(cache, seed, second=seed)
    get(cache, 1)  # used now, so 2 is the least used
    get(cache, 4)
    assert not any(get(cache, seed)[1] for seed in (1, 3, 4))
    assert get(cache, 2)[1]


@pytest.mark.parametrize("bound", [FILE_BYTES, 2 * FILE_BYTES - 1, 5 * FILE_BYTES, 10**9])
def test_the_bound_holds_after_every_use(tmp_path: Path, bound: int) -> None:
    cache = DecodedCache(tmp_path, max_bytes=bound)
    for seed in range(8):
        get(cache, seed)
        used_at(cache, seed, second=seed)
        sizes = [path.stat().st_size for path in tmp_path.iterdir()]
        assert sum(sizes) <= bound
        assert sizes == [FILE_BYTES] * min(seed + 1, bound // FILE_BYTES)
    with raises(InvalidOptionError):
        DecodedCache(tmp_path, max_bytes=0)


def test_other_files_stay_and_what_a_kill_left_goes(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path, max_bytes=FILE_BYTES)
    others = [tmp_path / "mine", tmp_path / f"{name(1)}.npz", tmp_path / name(1)[:-1]]
    left = tmp_path / f".{name(2)}.1234.partial"
    for path in (*others, left):
        path.write_bytes(bytes(2 * FILE_BYTES))
        os.utime(path, (0, 0))
    get(cache, 1)
    assert sorted(tmp_path.iterdir()) == sorted([*others, tmp_path / name(1)])


def test_what_cannot_be_decoded_leaves_nothing(tmp_path: Path) -> None:
    def decode() -> Iterator[NDArray[np.uint8]]:
        yield frames(1)[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        DecodedCache(tmp_path).frames(name(1), SHAPE, decode)
    assert not [*tmp_path.iterdir()]


def test_many_at_once(tmp_path: Path) -> None:
    """Several users share a folder that holds fewer files than they use."""
    cache = DecodedCache(tmp_path, max_bytes=3 * FILE_BYTES)

    def use(worker: int) -> None:
        for turn in range(60):
            get(cache, (turn * (worker + 1)) % 7)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(use, range(4)))
    get(cache, 99)
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= 3 * FILE_BYTES


def _slowly(folder: Path, seed: int) -> bool:
    """Return whether the frames were decoded by this call."""
    decoded = []

    def decode() -> Iterator[NDArray[np.uint8]]:
        decoded.append(seed)
        for frame in frames(seed):
            time.sleep(0.05)
            yield frame

    DecodedCache(folder).frames(name(seed), SHAPE, decode)
    return bool(decoded)


def test_of_two_processes_one_waits_for_the_other(tmp_path: Path) -> None:
    """As the ranks of a training; threads have locks of their own, as processes do."""
    with ThreadPoolExecutor(2) as pool:
        decoded = pool.map(_slowly, [tmp_path] * 2, [1] * 2)
    assert sum(decoded) == 1


def test_default_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert DecodedCache().folder == tmp_path / "robomme-interference" / "decoded"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder("weights") == tmp_path / ".cache" / "robomme-interference" / "weights"


def test_a_cache_that_only_others_may_write_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache = DecodedCache(tmp_path)
    get(cache, 1)

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "utime", refuse)
    assert not get(cache, 1)[1]
