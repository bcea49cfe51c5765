"""Buffers: the very frames of their sessions in order, however they are asked for."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import factories
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from robomme_interference_data import (
    Buffer,
    DecodedCache,
    SessionEntry,
    Split,
    load_split,
    sessions,
)
from robomme_interference_data.digest import combine
from robomme_interference_data.errors import (
    HashMismatchError,
    InvalidOptionError,
    TruncatedVideoError,
    UnknownNameError,
)
from robomme_interference_data.schema import BufferManifest

CAMERAS = ("front", "wrist")
EPISODE = "VideoUnmask/test/1"
BUFFERS = [
    (f"{family}/test/{index}", k)
    for family in factories.FAMILIES
    for index in (0, 1)
    for k in factories.K
]


@cache
def opened() -> Split:
    return load_split(factories.split())


def buffer(k: int = 3, episode: str = EPISODE, **options: object) -> Buffer:
    return Buffer(opened().manifest(episode, k), opened().datasets, **options)  # type: ignore[arg-type]


@cache
def stored_frames(entry: SessionEntry, camera: str) -> NDArray[np.uint8]:
    """The frames of a session, each once, by a plain read of the whole episode."""
    dataset = opened().datasets[entry.dataset]
    length = dataset.record(entry.episode_index).length
    frames = dataset.iter_frames(entry.episode_index, f"observation.images.{camera}", 0, length)
    return np.stack(list(frames))[entry.start : entry.stop]


def expected_frames(entries: Sequence[SessionEntry], camera: str) -> NDArray[np.uint8]:
    parts = [np.repeat(stored_frames(entry, camera), entry.repeat, axis=0) for entry in entries]
    return np.concatenate([np.empty((0, 64, 64, 3), np.uint8), *parts])


def expected_states(entries: Sequence[SessionEntry]) -> NDArray[np.float32]:
    parts = [
        np.repeat(
            opened()
            .datasets[entry.dataset]
            .read_vectors(entry.episode_index, "observation.state", entry.start, entry.stop),
            entry.repeat,
            axis=0,
        )
        for entry in entries
    ]
    return np.concatenate([np.empty((0, 8), np.float32), *parts])


def check(made: Buffer, entries: Sequence[SessionEntry]) -> None:
    """A buffer gives its frames and states, whole and in chunks, for both cameras."""
    states = expected_states(entries)
    index = np.concatenate(
        [
            np.empty(0, np.int64),
            *(np.full(entry.num_frames, place) for place, entry in enumerate(entries)),
        ]
    )
    assert len(made) == made.exec_start_idx == len(states)
    np.testing.assert_array_equal(made.states, states)
    assert made.states.dtype == np.float32
    np.testing.assert_array_equal(made.session_index, index)
    assert made.session_index.dtype == np.int64
    frames = {camera: expected_frames(entries, camera) for camera in CAMERAS}
    for camera in CAMERAS:
        found = made.frames(camera)
        assert (found.dtype, found.shape) == (np.uint8, (len(states), 64, 64, 3))
        np.testing.assert_array_equal(found, frames[camera])
    for size in (7, len(states) + 5):
        position = 0
        for chunk in made.stream(size):
            assert chunk.start == position
            stop = min(position + size, len(states))
            assert len(chunk) == stop - position
            assert chunk.frames.keys() == set(CAMERAS)
            for camera in CAMERAS:
                np.testing.assert_array_equal(chunk.frames[camera], frames[camera][position:stop])
            np.testing.assert_array_equal(chunk.states, states[position:stop])
            np.testing.assert_array_equal(chunk.session_index, index[position:stop])
            position = stop
        assert position == len(states)


# --- buffers of the split -----------------------------------------------------------------------


@pytest.mark.parametrize(("episode", "k"), BUFFERS)
def test_lesson_first_then_the_units(episode: str, k: int) -> None:
    made = buffer(k, episode)
    lesson = 20 + 16 * made.episode_id.index
    assert (str(made.episode_id), made.k) == (episode, k)
    assert len(made) == made.exec_start_idx == lesson + 32 * k
    assert made.cameras == CAMERAS
    roles = [(session.role, session.start, session.stop) for session in made.sessions]
    assert roles == [
        ("lesson", 0, lesson),
        *(("distractor", lesson + 32 * n, lesson + 32 * (n + 1)) for n in range(k)),
    ]
    assert made.sessions[0].source == made.episode_id
    assert made.sessions[0].family == made.episode_id.family
    families = [session.family for session in made.sessions]
    assert len(set(families)) == k + 1  # with four families, k=3 takes each of the others once
    for session in made.sessions[1:]:
        assert session.source.split == "train"
        assert session.entry.dataset == "distractors"
        assert session.span == (session.start, session.stop)
    assert made.goal.startswith("watch the video carefully")


def test_every_buffer_of_the_split_gives_its_frames() -> None:
    for episode in ("VideoRepick/test/0", "PatternLock/test/1"):
        for k in factories.K:
            made = buffer(k, episode)
            check(made, made.manifest.sessions)


def test_repr() -> None:
    assert repr(buffer(3)) == (
        "Buffer(VideoUnmask/test/1, k=3, frames=132, sessions=4, cameras=['front', 'wrist'])"
    )


@given(st.sampled_from(BUFFERS), st.integers(1, 150), st.sampled_from([CAMERAS, ("wrist",), ()]))
@settings(max_examples=15)
def test_chunks_of_any_size(chosen: tuple[str, int], size: int, cameras: tuple[str, ...]) -> None:
    episode, k = chosen
    made = buffer(k, episode)
    chunks = list(made.stream(size, cameras))
    assert [chunk.start for chunk in chunks] == list(range(0, len(made), size))
    assert all(chunk.frames.keys() == set(cameras) for chunk in chunks)
    for camera in cameras:
        joined = np.concatenate([chunk.frames[camera] for chunk in chunks])
        np.testing.assert_array_equal(joined, made.frames(camera))
    np.testing.assert_array_equal(np.concatenate([chunk.states for chunk in chunks]), made.states)
    np.testing.assert_array_equal(
        np.concatenate([chunk.session_index for chunk in chunks]), made.session_index
    )


def test_stream_may_be_left_early() -> None:
    made = buffer(3)
    stream = made.stream(10)
    next(stream)
    stream.close()  # type: ignore[attr-defined]
    assert len(list(made.stream(50))) == 3


@pytest.mark.parametrize("repeat", [1, 3])
def test_a_span_is_the_same_frames_of_the_whole(repeat: int) -> None:
    made = buffer(3)
    held = [replace(entry, repeat=repeat) for entry in made.manifest.sessions]
    frames = sum(entry.num_frames for entry in held)
    manifest = replace(made.manifest, sessions=tuple(held), history_frames=frames)
    made = Buffer(manifest, made._datasets)
    whole, states = made.frames("front"), made.states
    bound = made.sessions[1].start
    for start, stop in [(0, 1), (bound - 2, bound + 2), (bound, bound + 4), (5, frames), (7, 7)]:
        chunks = list(made.stream(3, ("front",), start, stop))
        assert [c.start for c in chunks] == list(range(start, stop, 3))
        got = [chunk.frames["front"] for chunk in chunks]
        np.testing.assert_array_equal(np.concatenate([whole[:0], *got]), whole[start:stop])
        got = [chunk.states for chunk in chunks]
        np.testing.assert_array_equal(np.concatenate([states[:0], *got]), states[start:stop])


@pytest.mark.parametrize("span", [(-1, 3), (4, 3), (0, 100_000)])
def test_a_span_must_be_inside(span: tuple[int, int]) -> None:
    with pytest.raises(InvalidOptionError, match=r"are not inside the buffer of"):
        next(buffer(1).stream(8, None, *span))


@pytest.mark.parametrize("chunk", [0, -1])
def test_chunk_must_be_positive(chunk: int) -> None:
    with pytest.raises(InvalidOptionError, match=f"chunk={chunk}; expected 1 or more"):
        next(buffer().stream(chunk))


@pytest.mark.parametrize("piece", [1, 7, 16, 128])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_do_not_matter(threads: int, piece: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sessions, "_PIECE", piece)  # frames that one thread decodes at a time
    made = buffer(3, threads=threads)
    for camera in CAMERAS:
        np.testing.assert_array_equal(
            made.frames(camera), expected_frames(made.manifest.sessions, camera)
        )


@pytest.mark.parametrize("threads", [0, -3])
def test_threads_must_be_positive(threads: int) -> None:
    with pytest.raises(InvalidOptionError, match=f"threads={threads}; expected 1 or more"):
        buffer(3, threads=threads)


def test_frames_are_a_new_array_each_time() -> None:
    made = buffer(0)
    first = made.frames()
    first[:] = 0
    assert made.frames().any()


def test_single_frames() -> None:
    made = buffer(1)
    for camera in CAMERAS:
        frames = made.frames(camera)
        for index in range(len(made)):
            np.testing.assert_array_equal(made.frame(index, camera), frames[index])
    for index in (-1, len(made)):
        with pytest.raises(UnknownNameError, match=f"frame {index} is not in the buffer"):
            made.frame(index)


def test_query_frame_is_stored_after_the_lesson_and_not_part_of_it() -> None:
    for episode, k in BUFFERS:
        made = buffer(k, episode)
        query = made.manifest.query
        dataset = opened().datasets[query.dataset]
        record = dataset.record(query.episode_index)
        assert query.frame == record.exec_start_idx == record.length - 1
        assert record.id == made.episode_id
        for camera in CAMERAS:
            (last,) = dataset.iter_frames(
                query.episode_index,
                f"observation.images.{camera}",
                record.length - 1,
                record.length,
            )
            np.testing.assert_array_equal(made.query_frame(camera), last)
        for session in made.sessions:
            entry = session.entry
            if (entry.dataset, entry.episode_index) == (query.dataset, query.episode_index):
                assert entry.stop <= query.frame


@pytest.mark.parametrize("camera", ["front", "observation.images.front"])
def test_cameras_by_short_or_full_name(camera: str) -> None:
    np.testing.assert_array_equal(
        buffer(0).frames(camera), expected_frames(buffer(0).manifest.sessions, "front")
    )


@pytest.mark.parametrize(
    ("camera", "hint"),
    [
        ("frnt", "Did you mean 'front'?"),
        ("observation.images.wrst", "Did you mean 'wrist'?"),
        ("top", "Known: front, wrist"),
        ("", "Known: front, wrist"),
    ],
)
def test_unknown_camera(camera: str, hint: str) -> None:
    made = buffer()
    for use in (
        lambda: made.frames(camera),
        lambda: made.query_frame(camera),
        lambda: made.frame(0, camera),
        lambda: next(made.stream(8, (camera,))),
    ):
        with pytest.raises(
            UnknownNameError, match=r"is not in the buffer of VideoUnmask/test/1"
        ) as c:
            use()
        assert c.value.hint == hint


# --- buffers by hand: what the format must carry for later splits ------------------------------


def by_hand(*entries: SessionEntry, **options: object) -> Buffer:
    original = opened().manifest(EPISODE, 3)
    history = sum(entry.num_frames for entry in entries)
    manifest: BufferManifest = replace(original, sessions=entries, history_frames=history)
    return Buffer(manifest, opened().datasets, **options)  # type: ignore[arg-type]


def span(entry: SessionEntry, start: int, stop: int, repeat: int = 1, **roles: str) -> SessionEntry:
    """Another span of the same episode, with the digest that belongs to it."""
    dataset = opened().datasets[entry.dataset]
    digest = combine(dataset.span_digests(entry.episode_index, start, stop))
    return replace(entry, start=start, stop=stop, repeat=repeat, sha256=digest, **roles)


@cache
def made_up(name: str) -> list[SessionEntry]:
    sessions = opened().manifest(EPISODE, 3).sessions
    lesson, first, second, third = sessions
    return {
        "as planned": list(sessions),
        "nothing": [],
        "lesson last": [first, second, lesson],
        "lesson in the middle": [first, lesson, second],
        "lesson absent": [first, second, third],
        "lesson in two parts": [span(lesson, 0, 17), first, span(lesson, 17, 36)],
        "parts overlap": [span(lesson, 0, 20), span(lesson, 10, 36)],
        "the same unit twice": [lesson, first, first],
        "held frame": [lesson, span(lesson, 35, 36, repeat=32, role="filler"), second],
        "every frame held": [span(lesson, 5, 9, repeat=3), first],
        "only a held frame": [span(second, 31, 32, repeat=100, role="filler")],
        "contradiction": [lesson, span(first, 4, 20, role="contradiction")],
        "many": [lesson, *([first, second, third] * 21)],
        "single frames": [span(lesson, n, n + 1) for n in (7, 3, 3, 35)],
    }[name]


NAMES = [
    "as planned",
    "nothing",
    "lesson last",
    "lesson in the middle",
    "lesson absent",
    "lesson in two parts",
    "parts overlap",
    "the same unit twice",
    "held frame",
    "every frame held",
    "only a held frame",
    "contradiction",
    "single frames",
]


@pytest.mark.parametrize("name", NAMES)
def test_made_up_buffers(name: str) -> None:
    entries = made_up(name)
    made = by_hand(*entries, threads=3)
    check(made, entries)
    made.verify()
    assert [session.entry for session in made.sessions] == entries
    for index in range(0, len(made), 5):
        np.testing.assert_array_equal(made.frame(index), expected_frames(entries, "front")[index])


def test_sixty_three_distractors() -> None:
    entries = made_up("many")
    made = by_hand(*entries)
    assert len(made) == 36 + 63 * 32
    np.testing.assert_array_equal(made.frames("wrist"), expected_frames(entries, "wrist"))


def test_a_span_that_the_episode_does_not_have() -> None:
    lesson = opened().manifest(EPISODE, 3).sessions[0]
    made = by_hand(replace(lesson, stop=40))  # 37 frames are stored
    for use in (
        made.frames,
        made.verify,
        lambda: made.states,
        lambda: list(made.stream(16)),
    ):
        with pytest.raises(TruncatedVideoError, match="VideoUnmask/test/1 has 37 stored frames"):
            use()


# --- verification ----------------------------------------------------------------------------


def test_verify_accepts_the_split() -> None:
    for episode, k in BUFFERS[-6:]:
        buffer(k, episode).verify()


@pytest.mark.parametrize("place", [0, 1, 3])
def test_verify_names_the_session(place: int) -> None:
    entries = list(opened().manifest(EPISODE, 3).sessions)
    entries[place] = replace(entries[place], sha256="0" * 64)
    with pytest.raises(HashMismatchError) as caught:
        by_hand(*entries).verify()
    entry = entries[place]
    assert f"{EPISODE} at k=3: {entry.role} {entry.source} " in caught.value.message
    assert f"frames 0 to {entry.stop - 1}" in caught.value.message
    # The data is as the dataset recorded it, so the manifest is what differs.
    assert caught.value.message.endswith("differing: the manifest itself")
    assert "robomme-interference verify SPLIT" in str(caught.value.hint)


def test_verify_notices_other_frames_under_the_same_digest() -> None:
    lesson, first, *_ = opened().manifest(EPISODE, 3).sessions
    with pytest.raises(HashMismatchError):
        by_hand(lesson, replace(first, start=1)).verify()
    with pytest.raises(HashMismatchError):
        by_hand(lesson, replace(first, episode_index=first.episode_index ^ 1)).verify()


# --- cache -----------------------------------------------------------------------------------


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
