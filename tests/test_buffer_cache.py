"""Buffers with a cache of decoded frames: the same frames, whatever is in the cache."""

from pathlib import Path

import numpy as np
import pytest
from sample_buffers import BUFFERS, buffer, by_hand, check, expected_frames, made_up, opened

from robomme_interference_data import DecodedCache


@pytest.mark.parametrize("name", ["as planned", "lesson in two parts", "held frame", "nothing"])
def test_cache_on_and_off_are_equal(name: str, tmp_path: Path) -> None:
    entries = made_up(name)
    cache = DecodedCache(tmp_path / "cache")
    check(by_hand(*entries, cache=cache), entries)  # writes
    check(by_hand(*entries, cache=cache), entries)  # reads
    whole = [
        entry
        for entry in entries
        if opened().datasets[entry.dataset].digests(entry.episode_index, entry.start, entry.stop)
    ]
    # Whole sessions are kept, for both cameras; spans without a recorded digest are not.
    files = list(cache.folder.glob("*")) if cache.folder.exists() else []
    assert len(files) == 2 * len(whole)


def test_cached_frames_need_no_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cache = DecodedCache(tmp_path)
    expected = buffer(3, cache=cache).frames()
    made = buffer(3, cache=cache)

    def no_decoding(*_: object) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(type(opened().datasets["demonstrations"]), "read_frames", no_decoding)
    np.testing.assert_array_equal(made.frames(), expected)
    streamed = [chunk.frames["front"] for chunk in made.stream(7, ("front",), 3, 90)]
    np.testing.assert_array_equal(np.concatenate(streamed), expected[3:90])
    with pytest.raises(AssertionError, match="decoded"):
        made.frames("wrist")
    with pytest.raises(AssertionError, match="decoded"):
        next(made.stream(7, ("wrist",)))


def test_damaged_cache_files_are_decoded_again(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path)
    expected = buffer(3, cache=cache).frames()
    files = sorted(tmp_path.iterdir())
    assert len(files) == 4
    sizes = [path.stat().st_size for path in files]
    files[0].write_bytes(b"")
    files[1].write_bytes(files[1].read_bytes()[:-1])
    files[2].write_bytes(b"garbage")
    files[3].unlink()
    np.testing.assert_array_equal(buffer(3, cache=cache).frames(), expected)
    assert [path.stat().st_size for path in sorted(tmp_path.iterdir())] == sizes


def test_a_cache_too_small_for_the_buffer_still_works(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path, max_bytes=2 * 32 * 64 * 64 * 3)
    for episode, k in BUFFERS[:6]:
        made = buffer(k, episode, cache=cache)
        np.testing.assert_array_equal(
            made.frames(), expected_frames(made.manifest.sessions, "front")
        )
        assert sum(path.stat().st_size for path in tmp_path.iterdir()) <= cache.max_bytes
