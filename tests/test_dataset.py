"""Datasets are read as LeRobot's own reader reads them, and hold the frames of their source."""

from functools import cache
from typing import Any

import factories
import numpy as np
import pytest
from factories import CAMERAS
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from robomme_interference_data import Dataset, EpisodeId
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.digest import combine, feature_digest
from robomme_interference_data.errors import TruncatedVideoError, UnknownNameError
from robomme_interference_data.files import LocalFiles

VECTORS = ("action", "observation.state")
KINDS = ("demonstrations", "distractors")


def open_dataset(kind: str) -> Dataset:
    return Dataset(LocalFiles(factories.split() / kind))


def frames_of(dataset: Dataset, index: int, camera: str) -> NDArray[np.uint8]:
    length = dataset.record(index).length
    return np.stack(list(dataset.iter_frames(index, camera, 0, length)))


@cache
def source_frames(episode: EpisodeId) -> dict[str, NDArray[Any]]:
    """All raw frames, states and actions of a recorded episode, by feature."""
    source = open_source(f"frames:{factories.sample()}")
    (listed,) = [one for one in source.episodes() if one.id == episode]
    frames = list(source.read(listed))
    assert len(frames) == listed.raw_length
    return {
        **{
            f"observation.images.{camera}": np.stack([frame.images[camera] for frame in frames])
            for camera in ("front", "wrist")
        },
        "observation.state": np.stack([frame.state for frame in frames]),
        "action": np.stack([frame.action for frame in frames if frame.action is not None]),
    }


def raw_indices(kind: str, length: int) -> list[int]:
    """Raw frames of a stored episode: all of the lesson and one more, or every eighth of 256."""
    return list(range(length)) if kind == "demonstrations" else list(range(0, 256, 8))


# --- what is stored -----------------------------------------------------------------------------


def test_what_the_split_holds() -> None:
    demonstrations, distractors = map(open_dataset, KINDS)
    assert [str(record.id) for record in demonstrations.records()] == [
        f"{family}/test/{index}" for family in factories.FAMILIES for index in (0, 1)
    ]
    assert (
        [str(record.id) for record in distractors.records()]
        == [
            "VideoRepick/train/0",  # VideoRepick/train/1 has 200 raw frames: no unit
            *(f"{family}/train/{index}" for family in factories.FAMILIES[1:] for index in (0, 1)),
        ]
    )
    for dataset, kind, count in ((demonstrations, KINDS[0], 8), (distractors, KINDS[1], 7)):
        assert dataset.kind == kind
        assert len(dataset) == count
        assert dataset.cameras == CAMERAS
        assert dataset.features == {
            **dict.fromkeys(CAMERAS, (64, 64, 3)),
            **dict.fromkeys(VECTORS, (8,)),
        }
        assert len(dataset.revision) == 64


def test_records_say_what_the_source_says() -> None:
    listed = {one.id: one for one in open_source(f"frames:{factories.sample()}").episodes()}
    for kind in KINDS:
        dataset = open_dataset(kind)
        for index, record in enumerate(dataset.records()):
            episode = listed[record.id]
            assert record.episode_index == index
            assert record.goals == episode.goals
            assert record.goals[0] == (
                f"watch the video carefully, then do the {record.id.family} task again"
            )
            assert (record.seed, record.difficulty) == (episode.seed, episode.difficulty)
            assert record.simulator == "sample"
            assert record.raw_length == 260
            assert record.exact
            if kind == "demonstrations":
                lesson = 20 + 16 * (record.id.index % 2)
                assert (record.exec_start_idx, record.length) == (lesson, lesson + 1)
                assert record.lesson_feature_sha256.keys() == {*CAMERAS, *VECTORS}
                assert record.lesson_sha256 == combine(record.lesson_feature_sha256)
            else:
                assert (record.exec_start_idx, record.length) == (None, 32)
                assert (record.lesson_feature_sha256, record.lesson_sha256) == ({}, None)
            assert record.sha256 == combine(record.feature_sha256)


@pytest.mark.parametrize("kind", KINDS)
def test_frames_are_those_of_the_source(kind: str) -> None:
    dataset = open_dataset(kind)
    for record in dataset.records():
        chosen = raw_indices(kind, record.length)
        for feature, values in source_frames(record.id).items():
            stored = (
                frames_of(dataset, record.episode_index, feature)
                if feature in CAMERAS
                else dataset.read_vectors(record.episode_index, feature, 0, record.length)
            )
            assert stored.dtype == values.dtype
            np.testing.assert_array_equal(stored, values[chosen])


@pytest.mark.parametrize(("kind", "episodes"), [(KINDS[0], (0, 3, 7)), (KINDS[1], (0, 6))])
def test_frames_are_those_of_lerobots_reader(kind: str, episodes: tuple[int, ...]) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = factories.split() / kind
    theirs = LeRobotDataset("test/split", root=root, video_backend="pyav")
    ours = open_dataset(kind)
    assert theirs.num_episodes == len(ours)
    for index in episodes:
        record = ours.record(index)
        first = sum(ours.record(one).length for one in range(index))
        own = {
            **{camera: frames_of(ours, index, camera) for camera in CAMERAS},
            **{name: ours.read_vectors(index, name, 0, record.length) for name in VECTORS},
        }
        for position in range(record.length):
            item = theirs[first + position]
            assert int(item["episode_index"]) == index
            assert int(item["frame_index"]) == position
            assert item["task"] == record.goals[0]
            for camera in CAMERAS:  # float (3, H, W) from 0 to 1
                image = (item[camera].permute(1, 2, 0).numpy() * 255).round().astype(np.uint8)
                np.testing.assert_array_equal(image, own[camera][position])
            for name in VECTORS:
                np.testing.assert_array_equal(item[name].numpy(), own[name][position])


@given(data=st.data())
@settings(max_examples=40)
def test_spans_are_parts_of_the_whole(data: st.DataObject) -> None:
    dataset = open_dataset(data.draw(st.sampled_from(KINDS)))
    index = data.draw(st.integers(0, len(dataset) - 1))
    length = dataset.record(index).length
    start = data.draw(st.integers(0, length))
    stop = data.draw(st.integers(start, length))
    camera = data.draw(st.sampled_from(CAMERAS))
    whole = source_frames(dataset.record(index).id)
    chosen = raw_indices(dataset.kind, length)[start:stop]
    found = list(dataset.iter_frames(index, camera, start, stop))
    np.testing.assert_array_equal(np.array(found).reshape(-1, 64, 64, 3), whole[camera][chosen])
    out = np.zeros((stop - start, 64, 64, 3), np.uint8)
    dataset.read_frames(index, camera, start, out)
    np.testing.assert_array_equal(out, whole[camera][chosen])
    states = dataset.read_vectors(index, "observation.state", start, stop)
    assert states.dtype == np.float32
    assert states.flags.c_contiguous
    np.testing.assert_array_equal(states, whole["observation.state"][chosen])


def test_digests_are_those_of_the_decoded_arrays() -> None:
    for kind in KINDS:
        dataset = open_dataset(kind)
        for record in list(dataset.records())[:3]:
            index, length = record.episode_index, record.length
            arrays: dict[str, NDArray[Any]] = {
                **{camera: frames_of(dataset, index, camera) for camera in CAMERAS},
                **{name: dataset.read_vectors(index, name, 0, length) for name in VECTORS},
            }

            def by_hand(
                start: int, stop: int, arrays: dict[str, NDArray[Any]] = arrays
            ) -> dict[str, str]:
                return {name: feature_digest(values[start:stop]) for name, values in arrays.items()}

            assert by_hand(0, length) == record.feature_sha256
            assert dataset.digests(index, 0, length) == record.feature_sha256
            assert dataset.span_digests(index, 3, 11) == by_hand(3, 11)
            assert dataset.digests(index, 3, 11) is None
            prefixes = dataset.prefix_digests(index, [length, 5])
            assert prefixes == [by_hand(0, length), by_hand(0, 5)]
            if record.exec_start_idx is not None:
                lesson = by_hand(0, record.exec_start_idx)
                assert record.lesson_feature_sha256 == lesson
                assert dataset.digests(index, 0, record.exec_start_idx) == lesson


# --- what is not there -------------------------------------------------------------------------


def test_index_of() -> None:
    dataset = open_dataset("demonstrations")
    assert dataset.index_of(EpisodeId("MoveCube", "test", 1)) == 5
    with pytest.raises(UnknownNameError, match="MoveCube/test/2 is not in the demonstrations"):
        dataset.index_of(EpisodeId("MoveCube", "test", 2))
    with pytest.raises(UnknownNameError) as caught:
        dataset.index_of(EpisodeId("MoveCub", "test", 1))
    assert "'MoveCube/test/1'" in str(caught.value.hint)


@pytest.mark.parametrize("index", [-1, 8, 10**6])
def test_unknown_episode_index(index: int) -> None:
    with pytest.raises(UnknownNameError, match=f"episode {index} is not in .* has 8 episodes"):
        open_dataset("demonstrations").record(index)


def test_unknown_camera() -> None:
    dataset = open_dataset("demonstrations")
    with pytest.raises(UnknownNameError, match=r"camera 'observation\.images\.fron'") as caught:
        list(dataset.iter_frames(0, "observation.images.fron", 0, 1))
    assert "'observation.images.front'" in str(caught.value.hint)


@pytest.mark.parametrize(
    ("start", "stop"), [(0, 22), (20, 22), (21, 22), (-1, 5), (-3, -1), (5, 4)]
)
def test_frames_that_an_episode_does_not_have(start: int, stop: int) -> None:
    """Neighbours in the same video file must not come instead."""
    dataset = open_dataset("demonstrations")
    for episode in (0, 2):
        assert dataset.record(episode).length == 21
        for read in (
            lambda: list(dataset.iter_frames(episode, CAMERAS[0], start, stop)),  # noqa: B023
            lambda: dataset.read_vectors(episode, "action", start, stop),  # noqa: B023
        ):
            with pytest.raises(
                TruncatedVideoError, match=f"21 stored frames .* {start} to {stop - 1} were asked"
            ):
                read()
