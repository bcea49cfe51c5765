"""Buffers: the very frames of their sessions in order, however they are requested."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.buffer_sets import (
    CONDITIONS,
    GOLDEN,
    LESSON,
    QUERIES,
    expected_frames,
    expected_states,
    stored_frames,
    stored_states,
    with_sessions,
)
from support.messages import raises

from robomme_interference_data import Buffer, DecodedCache, SessionEntry, load_buffer_set
from robomme_interference_data.errors import HashMismatchError, InvalidOptionError, UnknownNameError
from robomme_interference_data.storage.files import LocalFiles

BUFFER_SET = load_buffer_set(GOLDEN)
CAMERAS = ("front", "wrist")


def buffer(condition: str = "k3", episode: str = QUERIES[1], **options: object) -> Buffer:
    return load_buffer_set(GOLDEN, **options).load(episode, condition)  # type: ignore[arg-type]


def of_sessions(*entries: SessionEntry) -> Buffer:
    """A buffer that no condition has yet: any sessions in any order."""
    made = buffer()
    return Buffer(with_sessions(made.manifest, *entries), made.query, BUFFER_SET.datasets)


def unusual() -> Buffer:
    """A unit, half of the lesson, a held frame, and the other half."""
    lesson, *units = buffer().manifest.sessions
    return of_sessions(
        units[0],
        replace(lesson, stop=20, sha256="-"),
        replace(lesson, role="filler", start=19, stop=20, repeat=5, sha256="-"),
        replace(units[1], repeat=3),
        replace(lesson, start=20, sha256="-"),
    )


@pytest.mark.parametrize("episode", QUERIES)
@pytest.mark.parametrize("condition", CONDITIONS)
def test_lesson_first_then_the_units(condition: str, episode: str) -> None:
    made = buffer(condition, episode)
    k = int(condition[1:]) if condition != "no-history" else 0
    lesson = [] if condition == "no-history" else [("lesson", 0, LESSON)]
    frames = len(lesson) * LESSON + 32 * k
    assert (str(made.episode_id), made.condition, made.manifest.k) == (episode, condition, k)
    assert len(made) == frames
    assert made.cameras == CAMERAS
    starts = [LESSON + 32 * number for number in range(k)]
    assert [(one.role, one.start, one.stop) for one in made.sessions] == [
        *lesson,
        *(("distractor", start, start + 32) for start in starts),
    ]
    families = [session.family for session in made.sessions]
    assert len(set(families)) == len(families)  # eight other families: none twice
    for session in made.sessions[1:]:
        assert session.source.split == "train"
    for camera in CAMERAS:
        expected = expected_frames(made.manifest.sessions, camera)
        np.testing.assert_array_equal(made.frames(camera), expected)
    np.testing.assert_array_equal(made.states, expected_states(made.manifest.sessions))
    made.verify()


@pytest.mark.slow
@given(
    st.sampled_from(["no-history", "k0", "k3", "unusual"]),
    st.integers(1, 150),
    st.sampled_from([CAMERAS, ("wrist",), ()]),
    st.data(),
)
@settings(max_examples=20)
def test_chunks_of_any_frames_and_size(
    condition: str, size: int, cameras: tuple[str, ...], data: st.DataObject
) -> None:
    made = unusual() if condition == "unusual" else buffer(condition)
    places = st.integers(0, len(made))
    span, single = data.draw(st.tuples(places, places)), data.draw(st.sets(places, max_size=20))
    chosen = sorted({*range(*span), *single} - {len(made)})
    chunks = list(made.stream(size, cameras, chosen))
    assert [chunk.indices.tolist() for chunk in chunks] == [
        chosen[first : first + size] for first in range(0, len(chosen), size)
    ]
    entries = made.manifest.sessions
    for camera in cameras:
        whole = expected_frames(entries, camera)
        joined = np.concatenate([whole[:0], *(chunk.frames[camera] for chunk in chunks)])
        np.testing.assert_array_equal(joined, whole[chosen])
        np.testing.assert_array_equal(made.frames(camera), whole)
        for index in chosen[:1]:
            np.testing.assert_array_equal(made.frame(index, camera), whole[index])
    assert all(chunk.frames.keys() == set(cameras) for chunk in chunks)
    states = np.concatenate([made.states[:0], *(chunk.states for chunk in chunks)])
    np.testing.assert_array_equal(states, expected_states(entries)[chosen])
    index = np.concatenate([made.session_index[:0], *(chunk.session_index for chunk in chunks)])
    np.testing.assert_array_equal(index, made.session_index[chosen])


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_threads_do_not_matter(threads: int) -> None:
    made = buffer("k7", threads=threads)
    expected = expected_frames(made.manifest.sessions, "wrist")
    np.testing.assert_array_equal(made.frames("wrist"), expected)


def test_arrays_are_the_callers() -> None:
    made = buffer()
    first = made.frames()
    first[:] = 0
    assert made.frames().any()
    for chunk in made.stream(50):
        chunk.states[...] = 0
        chunk.session_index[...] = 0
    np.testing.assert_array_equal(made.states, expected_states(made.manifest.sessions))
    made.states[0] = 1
    np.testing.assert_array_equal(made.states, expected_states(made.manifest.sessions))
    assert made.session_index[-1] == 3
    made.verify()


@pytest.mark.parametrize("indices", [[-1, 3], range(100_000), [144]])
def test_frames_are_inside(indices: Sequence[int]) -> None:
    with raises(UnknownNameError):
        next(buffer().stream(8, None, indices))
    for index in (-1, 144):
        with raises(UnknownNameError):
            buffer().frame(index)


@pytest.mark.parametrize(
    "use",
    [
        lambda made, wrong: made.frame(wrong),
        lambda made, wrong: next(made.stream(wrong)),
        lambda made, wrong: next(made.stream(8, None, [wrong])),
    ],
)
@pytest.mark.parametrize("wrong", [1.5, True, "1", [1]])
def test_numbers_are_whole(use: Callable[[Buffer, Any], object], wrong: object) -> None:
    with raises(InvalidOptionError):
        use(buffer(), wrong)


@pytest.mark.parametrize("indices", [[3, 3], [4, 3], 3, "front"])
def test_indices_ascend_and_chunks_are_positive(indices: Any) -> None:
    with raises(InvalidOptionError):
        next(buffer().stream(8, None, indices))
    with raises(InvalidOptionError):
        next(buffer().stream(0))


@pytest.mark.parametrize(
    "use",
    [
        lambda made: made.frames(3),
        lambda made: made.frame(0, ["front"]),
        lambda made: next(made.stream(8, "front")),
        lambda made: made.query.frame(b"front"),
        lambda made: made.embeddings(["thumbnail"]),
        lambda made: made.query_embedding("thumbnail", 3),
    ],
)
def test_cameras_and_encoders_are_names(use: Callable[[Any], object]) -> None:
    with raises(InvalidOptionError):
        use(buffer())


def test_the_query_needs_no_buffer() -> None:
    query = BUFFER_SET.query("PatternLock/test/0")
    assert str(query.episode_id) == "PatternLock/test/0"
    assert query.goal == "watch the video carefully, then do the PatternLock task again"
    assert (query.difficulty, query.simulator, query.lesson_frames) == ("easy", "sample", LESSON)
    for camera in CAMERAS:
        frames = stored_frames("demonstrations", query.episode_id, camera)
        np.testing.assert_array_equal(query.frame(camera), frames[LESSON])
    states = stored_states("demonstrations", query.episode_id)
    np.testing.assert_array_equal(query.state(), states[LESSON])
    made = BUFFER_SET.load("PatternLock/test/0", "no-history")
    assert made.query.record == query.record
    assert made.manifest.query == query.first_frame
    assert query.seed == made.manifest.seed
    # It is never part of the buffer.
    assert all(
        entry.stop <= query.lesson_frames
        for entry in buffer("k7", "PatternLock/test/0").manifest.sessions
        if entry.source == query.episode_id
    )


@pytest.mark.parametrize("camera", ["observation.images.wrst", "top"])
def test_cameras_by_full_or_unknown_name(camera: str) -> None:
    made = buffer("k0")
    np.testing.assert_array_equal(made.frames("observation.images.front"), made.frames("front"))
    uses: list[Callable[[], object]] = [
        lambda: made.frames(camera),
        lambda: made.query.frame(camera),
        lambda: made.frame(0, camera),
        lambda: next(made.stream(8, (camera,))),
    ]
    for use in uses:
        with raises(UnknownNameError) as caught:
            use()
        assert "front, wrist" in (caught.value.hint or "")


def test_a_stream_fetches_its_files_before_the_first_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    made, fetched = buffer("k3"), []
    monkeypatch.setattr(LocalFiles, "fetch", lambda files, paths: fetched.append(sorted(paths)))
    stream = made.stream(8, ("front",), range(60, 90))  # of the first two units
    next(stream)
    lesson, units = fetched
    assert len(lesson) == 1 and lesson[0].startswith("data/")
    assert sum(path.startswith("data/") for path in units) == 3  # states are of all sessions
    assert sum(path.startswith("videos/observation.images.front") for path in units) == 2
    assert sum(map(len, stream)) == 22 and len(fetched) == 2


def test_verify_names_what_differs() -> None:
    made = buffer("k1")
    lesson, unit = made.manifest.sessions
    changed = with_sessions(made.manifest, lesson, replace(unit, sha256="0" * 64))
    other = Buffer(changed, made.query, BUFFER_SET.datasets)
    with raises(HashMismatchError):
        other.verify()


# --- with a cache ------------------------------------------------------------------------------


def test_what_is_cached_is_not_decoded(tmp_path: Path, own_buffers: Path) -> None:
    made = load_buffer_set(own_buffers, cache=tmp_path / "cache").load(QUERIES[1], "k1")
    before = made.frames("front")
    for video in own_buffers.glob("*/videos/observation.images.front/*/*.mp4"):
        video.unlink()
    again = load_buffer_set(own_buffers, cache=tmp_path / "cache").load(QUERIES[1], "k1")
    np.testing.assert_array_equal(again.frames("front"), before)
    chunks = [chunk.frames["front"] for chunk in again.stream(7, ("front",), range(40, 70))]
    np.testing.assert_array_equal(np.concatenate(chunks), before[40:70])
    held = replace(again.manifest.sessions[1], repeat=2)
    held_buffer = Buffer(
        with_sessions(again.manifest, held),
        again.query,
        load_buffer_set(own_buffers).datasets,
        cache=DecodedCache(tmp_path / "cache"),
    )
    np.testing.assert_array_equal(held_buffer.frames("front"), np.repeat(before[LESSON:], 2, 0))


def test_what_was_verified_never_takes_other_frames_from_the_cache(tmp_path: Path) -> None:
    cache = DecodedCache(tmp_path)
    expected = buffer("k1", cache=cache).frames()
    made = load_buffer_set(GOLDEN, cache=cache).load(QUERIES[1], "k1", verify=True)
    for read in (made.frames, lambda: np.concatenate([c.frames["front"] for c in made.stream(9)])):
        for path in tmp_path.iterdir():
            data = path.read_bytes()
            path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
        np.testing.assert_array_equal(read(), expected)


def test_a_full_disk_does_not_stop_loading(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    made = buffer("k1", cache=DecodedCache(tmp_path / "file"))
    with pytest.warns(RuntimeWarning, match="decoded frames"):
        frames = made.frames()
    np.testing.assert_array_equal(frames, expected_frames(made.manifest.sessions, "front"))
    assert sum(len(chunk) for chunk in made.stream()) == len(made)
