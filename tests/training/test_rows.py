"""Rows of datasets: resized, compared with the digests, and only those that are used are stored."""

from pathlib import Path

import numpy as np
import pytest
from support.buffer_sets import copy_buffer_set, dataset, stored_frames, stored_states
from support.messages import raises

from robomme_interference_data import DecodedCache
from robomme_interference_data.errors import HashMismatchError, InvalidOptionError
from robomme_interference_data.training import resize
from robomme_interference_data.training.rows import PADDING, StoredRows

FRONT, STATE = "observation.images.front", "observation.state"
UNIT_BYTES = 32 * 3 * 16 * 16


def rows_of(root: Path, kind: str, cache: DecodedCache, size: int | None = 16) -> StoredRows:
    return StoredRows({kind: dataset(root, kind)}, cache, size)


def test_resize_by_hand() -> None:
    image = np.zeros((1, 4, 4, 3), np.uint8)
    image[0, :2, :2, 0] = [[1, 2], [3, 4]]  # mean 2.5, rounded to even
    image[0, :2, 2:, 1] = [[255, 255], [255, 254]]  # 254.75
    small = resize(image, 2)
    assert small.shape == (1, 3, 2, 2) and small.dtype == np.uint8
    assert small[0].tolist() == [[[2, 0], [0, 0]], [[0, 255], [0, 0]], [[0, 0], [0, 0]]]
    np.testing.assert_array_equal(resize(image, None), image.transpose(0, 3, 1, 2))
    # 4 pixels to 3: each is the mean of a pixel and a third, (3 · 0 + 10) / 4 = 2.5 at the left.
    row = np.array([0, 10, 20, 30], np.uint8)[None, None, :, None].repeat(4, 1).repeat(3, 3)
    assert resize(row, 3)[0, 0, 0].tolist() == [2, 15, 28]


@pytest.mark.parametrize("kind", ["demonstrations", "distractors"])
@pytest.mark.parametrize("size", [None, 16, 12])
def test_all_frames_in_order(size: int | None, kind: str, tiny_buffers: Path, tmp_path: Path):
    stored = rows_of(tiny_buffers, kind, DecodedCache(tmp_path), size)
    for record in dataset(tiny_buffers, kind).records():
        rows = stored.first(kind, record.episode_index) + np.arange(record.length)
        frames = stored_frames(kind, record.episode_id, "front")
        assert len(frames) == record.length  # of a demonstration, with the query frame
        np.testing.assert_array_equal(stored.take(FRONT, rows), resize(frames, size))
        np.testing.assert_array_equal(
            stored.take(STATE, rows), stored_states(kind, record.episode_id)
        )


def test_rows_of_several_sessions_and_padding(tiny_buffers: Path, tmp_path: Path) -> None:
    stored = rows_of(tiny_buffers, "distractors", DecodedCache(tmp_path))
    rows = np.array([[stored.first("distractors", 3) + 5, PADDING], [2, 1]])
    taken = stored.take(FRONT, rows)
    assert taken.shape == (2, 2, 3, 16, 16) and not taken[0, 1].any()
    units = [*dataset(tiny_buffers, "distractors").records()]
    for place, unit, frame in (((0, 0), 3, 5), ((1, 0), 0, 2), ((1, 1), 0, 1)):
        frames = stored_frames("distractors", units[unit].episode_id, "front")
        np.testing.assert_array_equal(taken[place], resize(frames[frame][None], 16)[0])
    assert not stored.take(STATE, np.array([PADDING])).any()


def test_only_what_is_used_is_stored_and_not_decoded_again(
    own_buffers: Path, tmp_path: Path
) -> None:
    cache, used = tmp_path / "cache", np.array([5, 40, 41])  # of units 0 and 1
    stored = rows_of(own_buffers, "distractors", DecodedCache(cache))
    stored.prepare([FRONT, STATE], used, quiet=True)
    expected = stored.take(FRONT, used)
    assert [path.stat().st_size for path in cache.iterdir()] == [UNIT_BYTES + 32] * 2
    for video in own_buffers.glob("distractors/videos/*/*/*.mp4"):
        video.unlink()
    again = rows_of(own_buffers, "distractors", DecodedCache(cache))
    again.prepare([FRONT, STATE], used, quiet=True)
    np.testing.assert_array_equal(again.take(FRONT, used), expected)


def test_a_bar_fits_into_a_line(
    tiny_buffers: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    stored = rows_of(tiny_buffers, "demonstrations", DecodedCache(tmp_path))
    stored.prepare([FRONT], np.array([0]), quiet=False)
    [line] = filter(str.strip, capsys.readouterr().err.splitlines())
    assert line.startswith("front ")


def test_damaged_frames_are_not_stored(tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffers")
    units = dataset(root, "distractors")
    one, other = (root / "distractors" / units.files_of(n, ["front"])[1] for n in (0, 1))
    one.write_bytes(other.read_bytes())
    stored = rows_of(root, "distractors", DecodedCache(tmp_path / "cache"))
    with raises(HashMismatchError):
        stored.prepare([FRONT], np.array([0]), quiet=True)
    assert not [*(tmp_path / "cache").iterdir()]


def test_a_cache_that_is_too_small(tiny_buffers: Path, tmp_path: Path) -> None:
    used = np.array([5, 40])
    fits = DecodedCache(tmp_path, max_bytes=2 * UNIT_BYTES + 64)
    rows_of(tiny_buffers, "distractors", fits).prepare([FRONT], used, quiet=True)
    small = DecodedCache(tmp_path / "none", max_bytes=2 * UNIT_BYTES - 1)
    with raises(InvalidOptionError) as raised:
        rows_of(tiny_buffers, "distractors", small).prepare([FRONT], used, quiet=True)
    assert raised.value.option == "cache" and not small.folder.exists()
