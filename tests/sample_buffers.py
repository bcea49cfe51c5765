"""Buffers of the sample split, as it has them and made up, and the frames that they must give."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import factories
import numpy as np
from numpy.typing import NDArray

from robomme_interference_data import Buffer, SessionEntry, Split, load_buffer, load_split
from robomme_interference_data.digest import combine
from robomme_interference_data.schema import BufferManifest

CAMERAS = ("front", "wrist")
EPISODE = "VideoUnmask/test/1"
QUERY = "VideoRepick/test/1"  # its lesson has 36 frames
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


def load(k: int = 3, query: str = QUERY) -> Buffer:
    return load_buffer(query, k, factories.split())


def reshaped(buffer: Buffer, frames: list[int], **changes: object) -> Buffer:
    """The buffer with other sessions: the lesson and then its units in turn, so many frames each.

    More frames than are stored are had by holding each of them.
    """
    entries = []
    for number, count in enumerate(frames):
        known = buffer.manifest.sessions
        entry = known[0] if number == 0 else known[1 + (number - 1) % (len(known) - 1)]
        repeat = -(-count // entry.stop)
        entries.append(replace(entry, stop=count // repeat, repeat=repeat))
    manifest = replace(
        buffer.manifest,
        k=max(0, len(entries) - 1),
        sessions=tuple(entries),
        history_frames=sum(entry.num_frames for entry in entries),
        **changes,
    )
    return Buffer(manifest, buffer._datasets)
