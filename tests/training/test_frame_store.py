"""The store of decoded frames: resized, complete, resumed, compared with the digests."""

import errno
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import copy_buffer_set, dataset, stored_frames, stored_states
from support.messages import raises
from support.retrieval import QUIET

from robomme_interference_data.errors import HashMismatchError
from robomme_interference_data.runtime.progress import WorkProgress
from robomme_interference_data.training import frame_store, resize
from robomme_interference_data.training.frame_store import first_rows, stored_values

FRONT, STATE = "observation.images.front", "observation.state"


def test_resize_by_hand() -> None:
    image = np.zeros((1, 4, 4, 3), np.uint8)
    image[0, :2, :2, 0] = [[1, 2], [3, 4]]  # mean 2.5, rounded to even
    image[0, :2, 2:, 1] = [[255, 255], [255, 254]]  # 254.75
    small = resize(image, 2)
    assert small.shape == (1, 3, 2, 2) and small.dtype == np.uint8
    assert small[0].tolist() == [[[2, 0], [0, 0]], [[0, 255], [0, 0]], [[0, 0], [0, 0]]]
    np.testing.assert_array_equal(resize(image, None), image.transpose(0, 3, 1, 2))
    # 4 pixels to 3: each is the mean of the two that it touches.
    row = np.array([0, 10, 20, 30], np.uint8)[None, None, :, None].repeat(4, 1).repeat(3, 3)
    assert resize(row, 3)[0, 0, 0].tolist() == [5, 15, 25]


@pytest.mark.parametrize("size", [None, 16, 12])
def test_all_frames_in_order(size: int | None, tiny_buffers: Path, tmp_path: Path) -> None:
    units = dataset(tiny_buffers, "distractors")
    values = stored_values(units, FRONT, tmp_path, size, QUIET)
    states = stored_values(units, STATE, tmp_path, None, QUIET)
    rows = first_rows(units)
    assert len(values) == len(states) == rows[-1] == 17 * 32
    for record in units.records():
        part = slice(*rows[record.episode_index : record.episode_index + 2])
        frames = stored_frames("distractors", record.episode_id, "front")
        np.testing.assert_array_equal(values[part], resize(frames, size))
        np.testing.assert_array_equal(states[part], stored_states("distractors", record.episode_id))


def test_a_bar_fits_into_a_line(
    tiny_buffers: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with WorkProgress(unit="episodes") as progress:
        stored_values(dataset(tiny_buffers, "demonstrations"), FRONT, tmp_path, 16, progress)
    [line] = filter(str.strip, capsys.readouterr().err.splitlines())
    assert line.startswith("demonstrations: front ")


def test_what_is_stored_is_not_decoded_again(
    tiny_buffers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An interrupted store resumes with the episodes that it lacks."""
    units = dataset(tiny_buffers, "distractors")
    expected = np.array(stored_values(units, FRONT, tmp_path / "whole", 16, QUIET))
    read, decoded = frame_store._read, []

    def broken(*given: Any) -> None:
        if len(decoded) == 5:
            raise KeyboardInterrupt
        decoded.append(given[2])
        read(*given)

    monkeypatch.setattr(frame_store, "_read", broken)
    with pytest.raises(KeyboardInterrupt):
        stored_values(units, FRONT, tmp_path, 16, QUIET)
    monkeypatch.setattr(
        frame_store, "_read", lambda *given: (decoded.append(given[2]), read(*given))
    )
    for _ in range(2):
        np.testing.assert_array_equal(stored_values(units, FRONT, tmp_path, 16, QUIET), expected)
    assert sorted(decoded) == list(range(17))


def test_damaged_frames_are_not_stored(tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffers")
    units = dataset(root, "distractors")
    one, other = (root / "distractors" / units.files_of(n, ["front"])[1] for n in (0, 1))
    one.write_bytes(other.read_bytes())
    with raises(HashMismatchError):
        stored_values(units, FRONT, tmp_path / "store", 16, QUIET)
    assert not [*(tmp_path / "store").glob("distractors-*/*/values.npy")]


def test_a_full_disk_is_an_error_before_anything_is_decoded(
    tiny_buffers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*given: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full)
    with raises(OSError):
        stored_values(dataset(tiny_buffers, "distractors"), FRONT, tmp_path, 16, QUIET)
    monkeypatch.undo()
    assert len(stored_values(dataset(tiny_buffers, "distractors"), FRONT, tmp_path, 16, QUIET))


def test_of_two_processes_one_waits_for_the_other(
    tiny_buffers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As the ranks of a training; threads have locks of their own, as processes do."""
    units = dataset(tiny_buffers, "distractors")
    read, decoded, begun = frame_store._read, list[Any](), Event()

    def slow(*given: Any) -> None:
        begun.set()
        decoded.append(given[2])
        time.sleep(0.02)
        read(*given)

    monkeypatch.setattr(frame_store, "_read", slow)
    monkeypatch.setattr(frame_store, "_PAUSE_S", 0.01)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(stored_values, units, FRONT, tmp_path, 16, QUIET)
        assert begun.wait(30)
        second = pool.submit(stored_values, units, FRONT, tmp_path, 16, QUIET)
        np.testing.assert_array_equal(first.result(60), second.result(60))
    assert sorted(decoded) == list(range(17))
