"""Buffers of a split: the very frames of their sessions in order, however they are asked for."""

from dataclasses import replace

import factories
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_buffers import BUFFERS, CAMERAS, buffer, check, expected_frames, opened

from robomme_interference_data import Buffer, sessions
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError


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
