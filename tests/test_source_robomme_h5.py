"""RoboMME's own recordings: small files in the official layout, and what may be wrong with them."""

import pickle
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from h5_recordings import GOALS, edit, image, listed, record
from hypothesis import given
from hypothesis import strategies as st
from recordings import build, opened, run_here

from robomme_interference_data.build_dataset import build as build_module
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.sources.robomme_h5 import identify

# --- what is listed ------------------------------------------------------------------------------


def test_an_episode(tmp_path: Path) -> None:
    path = record(tmp_path)
    (episode,) = listed(tmp_path)
    assert str(episode.id) == "MoveCube/train/0"
    assert episode.goals == tuple(GOALS)
    assert (episode.raw_length, episode.demonstration_length) == (12, 5)
    assert (episode.seed, episode.difficulty, episode.simulator) == (14_000, "hard", "robomme")
    assert episode.exact is True
    assert episode.cameras == {"front": (4, 6), "wrist": (4, 6)}
    assert (episode.state_size, episode.action_size) == (8, 8)
    assert type(episode.seed) is int
    assert open_source(f"robomme-h5:{path}").episodes() == [episode]  # the file itself


def test_several_files_and_episodes_in_canonical_order(tmp_path: Path) -> None:
    record(tmp_path, "PatternLock", numbers=(0, 1), seeds={0: 15_000, 1: 15_100})
    record(tmp_path, "MoveCube", numbers=tuple(range(12)))
    (tmp_path / "notes.h5").write_bytes(b"not ours")
    names = [str(episode.id) for episode in listed(tmp_path)]
    assert names == [
        *(f"MoveCube/train/{i}" for i in range(12)),
        "PatternLock/train/0",
        "PatternLock/train/1",
    ]


@pytest.mark.parametrize("demo", [0, 12])
def test_all_or_nothing_is_demonstration(tmp_path: Path, demo: int) -> None:
    record(tmp_path, demo=demo)
    assert listed(tmp_path)[0].demonstration_length == demo


@pytest.mark.parametrize(
    ("value", "texts"),
    [
        ("plain text", ("plain text",)),
        (np.bytes_(b"fixed bytes"), ("fixed bytes",)),
        (["one", "other"], ("one", "other")),
        (np.array([b"one", b"other"]), ("one", "other")),
        ("nimm den Würfel", ("nimm den Würfel",)),
    ],
)
def test_goals_of_any_type(tmp_path: Path, value: Any, texts: tuple[str, ...]) -> None:
    def change(group: h5py.Group) -> None:
        del group["setup/task_goal"], group["setup/difficulty"]
        group["setup/task_goal"] = value
        group["setup/difficulty"] = np.bytes_(b"easy")

    edit(record(tmp_path), change)
    (episode,) = listed(tmp_path)
    assert (episode.goals, episode.difficulty) == (texts, "easy")


def test_seed_and_difficulty_may_be_missing(tmp_path: Path) -> None:
    def change(group: h5py.Group) -> None:
        del group["setup/seed"], group["setup/difficulty"]

    edit(record(tmp_path), change)
    (episode,) = listed(tmp_path)
    assert (episode.seed, episode.difficulty) == (None, None)
    assert str(episode.id) == "MoveCube/train/0"


def test_one_camera(tmp_path: Path) -> None:
    def change(group: h5py.Group) -> None:
        for step in range(12):
            del group[f"timestep_{step}/obs/wrist_rgb"]

    edit(record(tmp_path), change)
    source = open_source(f"robomme-h5:{tmp_path}")
    (episode,) = source.episodes()
    assert episode.cameras == {"front": (4, 6)}
    assert {tuple(frame.images) for frame in source.read(episode)} == {("front",)}


def test_the_key_changes_with_the_file(tmp_path: Path) -> None:
    path = record(tmp_path)
    before = listed(tmp_path)[0].key
    assert listed(tmp_path)[0].key == before
    edit(path, lambda group: group.create_dataset("setup/note", data="recorded again"))
    assert listed(tmp_path)[0].key != before


def test_a_source_travels_to_worker_processes(tmp_path: Path) -> None:
    record(tmp_path)
    source = pickle.loads(pickle.dumps(open_source(f"robomme-h5:{tmp_path}")))
    (episode,) = pickle.loads(pickle.dumps(source.episodes()))
    assert sum(1 for _ in source.read(episode)) == 12
    assert source.provenance == {"kind": "robomme-h5"}


# --- what is read --------------------------------------------------------------------------------


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("stick", [False, True])
def test_frames(tmp_path: Path, first: int, stick: bool) -> None:
    record(tmp_path, first=first, stick=stick)
    source = open_source(f"robomme-h5:{tmp_path}")
    (episode,) = source.episodes()
    frames = list(source.read(episode))
    assert len(frames) == 12
    for number, frame in enumerate(frames):
        step = first + number  # 10 and 11 come after 9, not after 1
        for camera in ("front", "wrist"):
            assert np.array_equal(frame.images[camera], image(0, step, camera))
            assert frame.images[camera].dtype == np.uint8
        position = np.arange(7, dtype=np.float32) + np.float32(0.1) * step
        gripper = np.float32(0 if stick else 0.04)
        assert frame.state.dtype == frame.action.dtype == np.float32
        assert frame.state.tobytes() == np.append(position, gripper).astype(np.float32).tobytes()
        expected = np.append(position.astype(np.float64) + 1 / 3, -1.0).astype(np.float32)
        assert frame.action.tobytes() == expected.tobytes()
        assert frame.is_demonstration is (number < 5)


def test_reading_may_stop_early_and_releases_the_file(tmp_path: Path) -> None:
    path = record(tmp_path)
    source = open_source(f"robomme-h5:{tmp_path}")
    frames = source.read(source.episodes()[0])
    next(frames)
    frames.close()
    with h5py.File(path, "r+") as file:  # HDF5 would refuse to open what is still open elsewhere
        assert "episode_0" in file


def test_building(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(build_module, "run_tasks", run_here)
    record(tmp_path / "h5", numbers=(0, 1), steps=250)
    record(tmp_path / "h5", "PatternLock", steps=248)
    source = open_source(f"robomme-h5:{tmp_path / 'h5'}")
    result = build("distractors", source, tmp_path / "units")
    assert [skipped.episode_id for skipped in result.skipped] == ["PatternLock/train/0"]
    dataset = opened(tmp_path / "units")
    assert [str(record.id) for record in dataset.records()] == [
        "MoveCube/train/0",
        "MoveCube/train/1",
    ]
    for number in range(2):
        frames = dataset.iter_frames(number, "observation.images.wrist", 0, 32)
        for position, frame in enumerate(frames):
            assert np.array_equal(frame, image(number, 8 * position, "wrist"))


# --- numbers, splits and seeds -------------------------------------------------------------------


def ids(family: str, seeds: dict[int, int | None]) -> dict[int, str]:
    return {number: str(name) for number, name in identify(family, seeds).items()}


@pytest.mark.parametrize(
    ("family", "seeds", "expected"),
    [
        # train: 1000 · code + 100 · index + attempt; MoveCube's code is 14
        ("MoveCube", {0: 14_000, 1: 14_100}, {0: "train/0", 1: "train/1"}),
        ("MoveCube", {1: 14_000, 2: 14_103}, {1: "train/0", 2: "train/1"}),
        ("MoveCube", {7: 14_700}, {7: "train/7"}),
        ("MoveCube", {7: 14_699}, {7: "train/6"}),
        ("PickXtimes", {99: 10_900}, {99: "train/99"}),
        ("RouteStick", {100: 25_900}, {100: "train/99"}),
        # test: 500,000 + 10,000 · code + 100 · index + attempt; PatternLock's code is 15
        ("PatternLock", {0: 650_000, 49: 654_901}, {0: "test/0", 49: "test/49"}),
        ("PatternLock", {1: 650_000, 50: 654_902}, {1: "test/0", 50: "test/49"}),
        # val: 1,000,000 + 10,000 · code + 100 · index + attempt; a few are 100 higher
        ("RouteStick", {0: 1_160_000, 3: 1_160_301}, {0: "val/0", 3: "val/3"}),
        (
            "RouteStick",
            {5: 1_160_500, 6: 1_160_700, 7: 1_160_700},
            {5: "val/5", 6: "val/6", 7: "val/7"},
        ),
        (
            "RouteStick",
            {1: 1_160_100, 2: 1_160_100, 3: 1_160_200},
            {1: "val/0", 2: "val/1", 3: "val/2"},
        ),
        # one file with several splits
        (
            "MoveCube",
            {1: 14_000, 2: 640_100, 3: 1_140_200},
            {1: "train/0", 2: "test/1", 3: "val/2"},
        ),
        # no seeds, or a family that RoboMME does not have: numbering says it
        ("MoveCube", {0: None, 4: None}, {0: "train/0", 4: "train/4"}),
        ("MoveCube", {1: None, 4: None}, {1: "train/0", 4: "train/3"}),
        ("MoveCube", {4: None}, {4: "train/4"}),
        ("OpenDrawer", {1: 7, 2: 8}, {1: "train/0", 2: "train/1"}),
        ("OpenDrawer", {0: 7, 2: 8}, {0: "train/0", 2: "train/2"}),
        # seeds of another rule contradict each other: numbering says it
        ("MoveCube", {1: 3, 2: 999}, {1: "train/0", 2: "train/1"}),
        # where there is an episode 0, numbers are indices whatever the seeds say
        ("MoveCube", {0: 14_100, 1: 14_200}, {0: "train/0", 1: "train/1"}),
    ],
)
def test_identify(family: str, seeds: dict, expected: dict) -> None:
    assert ids(family, seeds) == {n: f"{family}/{name}" for n, name in expected.items()}


@given(
    code=st.sampled_from([(14, "MoveCube"), (5, "VideoUnmaskSwap"), (16, "RouteStick")]),
    split=st.sampled_from([("train", 0, 1000), ("test", 500_000, 10_000), ("val", 10**6, 10_000)]),
    first=st.integers(0, 1),
    indices=st.sets(st.integers(0, 49), min_size=1),
    data=st.data(),
)
def test_identify_finds_split_and_index(code, split, first, indices, data) -> None:
    name, base, scale = split
    seeds, expected = {}, {}
    for index in data.draw(st.permutations(sorted(indices))):
        attempt = data.draw(st.integers(0, 99))
        seeds[index + first] = base + scale * code[0] + 100 * index + attempt
        expected[index + first] = f"{code[1]}/{name}/{index}"
    assert ids(code[1], seeds) == expected


def test_numbering_from_one(tmp_path: Path) -> None:
    seeds = {1: 14_000, 2: 14_100, 10: 14_900, 11: 15_000}
    record(tmp_path, numbers=(1, 2, 10, 11), seeds=seeds, first=1)
    source = open_source(f"robomme-h5:{tmp_path}")
    episodes = source.episodes()
    assert [episode.id.index for episode in episodes] == [0, 1, 9, 10]
    assert [episode.seed for episode in episodes] == [14_000, 14_100, 14_900, 15_000]
    for episode, number in zip(episodes, (1, 2, 10, 11), strict=True):
        first = next(source.read(episode))
        assert np.array_equal(first.images["front"], image(number, 1, "front"))
