"""RoboMME's own recordings: small files in the official layout, and what may be wrong with them."""

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recordings import build, opened, run_here

from robomme_interference_data.build_dataset import build as build_module
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.sources.robomme_h5 import RoboMMEH5Source, identify
from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    MissingExtraError,
    SourceError,
)

GOALS = ["watch the video, then do it", "do it again"]


def image(number: int, step: int, camera: str) -> np.ndarray:
    """A view `(4, 6, 3) uint8`, unlike any other."""
    seed = 1000 * number + 10 * step + (camera == "wrist")
    return np.random.default_rng(seed).integers(0, 256, (4, 6, 3), dtype=np.uint8)


def add_step(group: h5py.Group, number: int, step: int, *, demo: bool, stick: bool) -> None:
    """Write one time step as RoboMME's recorder does."""
    position = np.arange(7, dtype=np.float32) + np.float32(0.1) * step
    gripper = np.zeros(2) if stick else np.full(2, 0.04, np.float32)
    waypoint = np.zeros(7) if step % 2 else np.full(7, np.nan, np.float32)
    for name, value in {
        "obs/front_rgb": image(number, step, "front"),
        "obs/wrist_rgb": image(number, step, "wrist"),
        "obs/front_depth": np.zeros((4, 6, 1), np.int16),
        "obs/joint_state": position,
        "obs/gripper_state": gripper,
        "action/joint_action": np.append(position.astype(np.float64) + 1 / 3, -1.0),
        "action/waypoint_action": waypoint,
        "info/is_video_demo": demo,
        "info/simple_subgoal": "pick it",
    }.items():
        group[f"timestep_{step}/{name}"] = value


def record(
    folder: Path,
    family: str = "MoveCube",
    *,
    numbers: tuple[int, ...] = (0,),
    seeds: dict[int, int] | None = None,
    steps: int = 12,
    first: int = 0,
    demo: int = 5,
    stick: bool = False,
) -> Path:
    """Write a small recording; its keys come in no order that can be trusted."""
    folder.mkdir(exist_ok=True)
    path = folder / f"record_dataset_{family}.h5"
    with h5py.File(path, "w") as file:
        for number in reversed(numbers):
            group = file.create_group(f"episode_{number}")
            group["setup/seed"] = 14_000 + 100 * number if seeds is None else seeds[number]
            group["setup/difficulty"] = "hard"
            group["setup/task_goal"] = GOALS
            for step in reversed(range(first, first + steps)):
                add_step(group, number, step, demo=step < first + demo, stick=stick)
    return path


def edit(path: Path, change: Callable[[Any], Any]) -> None:
    """Change the first episode of a recording."""
    with h5py.File(path, "r+") as file:
        change(file["episode_0"])


def listed(folder: Path) -> list[Any]:
    return open_source(f"robomme-h5:{folder}").episodes()


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


# --- what is refused -----------------------------------------------------------------------------


def refused(folder: Path) -> str:
    with pytest.raises(SourceError) as raised:
        listed(folder)
    return str(raised.value)


@pytest.mark.parametrize(
    "missing",
    [
        "setup",
        "setup/task_goal",
        "timestep_0/obs",
        "timestep_7/info",
        "timestep_7/info/is_video_demo",
    ],
)
def test_a_missing_piece(tmp_path: Path, missing: str) -> None:
    def change(group: h5py.Group) -> None:
        del group[missing]

    path = record(tmp_path)
    edit(path, change)
    message = refused(tmp_path)
    assert message.startswith(f"{path}: episode_0 is not a complete RoboMME recording: ")
    assert "Record or download the file again" in message


@pytest.mark.parametrize("step", [5, 11])
@pytest.mark.parametrize(
    "missing",
    [
        "obs/front_rgb",
        "obs/wrist_rgb",
        "obs/joint_state",
        "obs/gripper_state",
        "action/joint_action",
    ],
)
def test_a_piece_that_is_missing_only_when_it_is_read(
    tmp_path: Path, missing: str, step: int
) -> None:
    path = record(tmp_path)

    def change(group: h5py.Group) -> None:
        del group[f"timestep_{step}/{missing}"]

    edit(path, change)
    source = open_source(f"robomme-h5:{tmp_path}")
    frames = source.read(source.episodes()[0])
    for _ in range(step):
        next(frames)
    with pytest.raises(
        SourceError, match=rf"MoveCube.h5: episode_0/timestep_{step} cannot be read"
    ):
        next(frames)


@pytest.mark.parametrize("step", [0, 4, 10])
def test_a_gap(tmp_path: Path, step: int) -> None:
    def change(group: h5py.Group) -> None:
        del group[f"timestep_{step}"]

    edit(record(tmp_path), change)
    if step == 0:  # then it begins at 1, as some files do
        assert listed(tmp_path)[0].raw_length == 11
    else:
        assert "episode_0 does not hold consecutive timestep_<T> groups" in refused(tmp_path)


def test_no_steps(tmp_path: Path) -> None:
    edit(record(tmp_path, steps=1), lambda group: group.pop("timestep_0"))
    assert "does not hold consecutive timestep_<T> groups" in refused(tmp_path)


@pytest.mark.parametrize("again", [5, 8, 11])
def test_demonstration_frames_that_come_back(tmp_path: Path, again: int) -> None:
    def change(group: h5py.Group) -> None:
        group["timestep_4/info/is_video_demo"][()] = False
        group[f"timestep_{again}/info/is_video_demo"][()] = True

    edit(record(tmp_path), change)
    message = refused(tmp_path)
    assert "demonstration frames come after live ones" in message
    assert f"set again at timestep_{again})" in message


def test_no_camera(tmp_path: Path) -> None:
    def change(group: h5py.Group) -> None:
        for camera in ("front", "wrist"):
            del group[f"timestep_0/obs/{camera}_rgb"]

    edit(record(tmp_path), change)
    assert "episode_0 has no front_rgb or wrist_rgb" in refused(tmp_path)


def test_no_goal(tmp_path: Path) -> None:
    def change(group: h5py.Group) -> None:
        del group["setup/task_goal"]
        group["setup"].create_dataset("task_goal", shape=(0,), dtype=h5py.string_dtype())

    edit(record(tmp_path), change)
    assert "episode_0 has no task_goal" in refused(tmp_path)


def test_a_goal_that_is_not_text(tmp_path: Path) -> None:
    def change(group: h5py.Group) -> None:
        del group["setup/task_goal"]
        group["setup/task_goal"] = np.bytes_(b"\xff\xfe")

    edit(record(tmp_path), change)
    assert "episode_0 is not a complete RoboMME recording: " in refused(tmp_path)


def test_no_episodes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "record_dataset_MoveCube.h5", "w") as file:
        file["note"] = "empty"
    assert "record_dataset_MoveCube.h5 holds no episode_<N> group" in refused(tmp_path)


@pytest.mark.parametrize("keep", [0, 100, 0.5, 0.99])
def test_a_truncated_file(tmp_path: Path, keep: float) -> None:
    path = record(tmp_path)
    data = path.read_bytes()
    path.write_bytes(data[: int(keep * len(data)) if keep < 1 else int(keep)])
    assert refused(tmp_path).startswith(f"{path} is not a complete RoboMME recording: ")


@pytest.mark.parametrize("harm", ["truncated", "removed", "episode removed"])
def test_a_file_that_changes_after_it_was_listed(tmp_path: Path, harm: str) -> None:
    path = record(tmp_path)
    source = open_source(f"robomme-h5:{tmp_path}")
    (episode,) = source.episodes()
    if harm == "truncated":
        path.write_bytes(path.read_bytes()[:2000])
    elif harm == "removed":
        path.unlink()
    else:
        with h5py.File(path, "r+") as file:
            del file["episode_0"]
    with pytest.raises(SourceError, match=r"MoveCube.h5: episode_0\S* cannot be read"):
        next(source.read(episode))


def test_a_folder_without_recordings(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"holds no record_dataset_<Family>\.h5 file") as raised:
        open_source(f"robomme-h5:{tmp_path}")
    assert "--source robomme-h5:FOLDER" in str(raised.value)
    with pytest.raises(InvalidOptionError, match="does not exist"):
        open_source(f"robomme-h5:{tmp_path / 'missing'}")


def test_a_family_that_is_no_name(tmp_path: Path) -> None:
    record(tmp_path, "Move Cube")
    with pytest.raises(InvalidIdError, match="'Move Cube' is not a family name"):
        listed(tmp_path)


def test_without_h5py(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record(tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    with pytest.raises(MissingExtraError, match="needs h5py") as raised:
        RoboMMEH5Source(tmp_path)
    assert 'pip install "robomme-interference-data[build]"' in str(raised.value)
