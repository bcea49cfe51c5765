"""RoboMME's own recordings: what the official files may hold, and what may be wrong with them."""

import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.damage import flipped_bits
from support.messages import raises
from support.recordings import EPISODES, check_recording, write_h5

from robomme_interference_data.build_dataset.sources import Recording, Robot, open_source
from robomme_interference_data.build_dataset.sources.h5 import H5Source, identify
from robomme_interference_data.build_dataset.sources.robomme_families import ROBOT
from robomme_interference_data.errors import InvalidIdError, MissingExtraError, SourceError
from robomme_interference_data.schema.records import EvidenceSpan

h5py = pytest.importorskip("h5py")

NAME = "MoveCube/train/0"  # 12 steps, of them 5 of the demonstration
EPISODE = EPISODES[NAME]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A file with one episode."""
    write_h5(tmp_path, {NAME: EPISODE})
    return tmp_path / "record_dataset_MoveCube.h5"


def put(path: Path, name: str, value: Any) -> None:
    """Put another value in a place of the episode; None removes it."""
    with h5py.File(path, "r+") as file:
        del file["episode_0"][name]
        if value is not None:
            file["episode_0"][name] = value


def read(path: Path) -> Recording:
    source = open_source(f"robomme-h5:{path}")
    return source.read(source.episodes()[0], None)


@pytest.mark.parametrize("fingers", [1, 2])
def test_files_that_count_from_one(tmp_path: Path, fingers: int) -> None:
    write_h5(tmp_path, EPISODES, first=1, fingers=fingers)
    (tmp_path / "notes.h5").write_bytes(b"not ours")
    source = open_source(f"robomme-h5:{tmp_path}")
    assert [str(episode.id) for episode in source.episodes()] == list(EPISODES)
    for episode in source.episodes():
        check_recording(source.read(episode, None), EPISODES[str(episode.id)])


def test_only_robommes_families_have_robommes_rate_and_names(path: Path) -> None:
    shutil.copy(path, path.parent / "record_dataset_OpenDrawer.h5")
    source = open_source(f"robomme-h5:{path.parent}")
    known, unknown = (source.read(episode, None) for episode in source.episodes())
    assert (known.robot, known.simulator) == (ROBOT, "robomme")
    assert (known.robot.fps, len(known.robot.names["action"])) == (10, 8)
    assert (unknown.robot, unknown.simulator) == (Robot(), None)


@pytest.mark.parametrize(
    ("goal", "texts"),
    [
        (np.bytes_(b"fixed bytes"), ("fixed bytes",)),
        (["one", "other"], ("one", "other")),
        (np.array([b"one", b"other"]), ("one", "other")),
        ("nimm den Würfel", ("nimm den Würfel",)),
    ],
)
def test_texts_of_any_type(path: Path, goal: Any, texts: tuple[str, ...]) -> None:
    put(path, "setup/task_goal", goal)
    put(path, "setup/difficulty", np.bytes_(b"easy"))
    recording = read(path)
    assert (recording.goals, recording.difficulty) == (texts, "easy")


def test_seed_difficulty_and_a_camera_may_be_missing(path: Path) -> None:
    for name in ("seed", "difficulty"):
        put(path, f"setup/{name}", None)
    for step in range(len(EPISODE)):
        put(path, f"timestep_{step}/obs/wrist_rgb", None)
    recording = read(path)
    assert (recording.seed, recording.difficulty) == (None, None)
    assert {tuple(frame.images) for frame in recording.frames} == {("front",)}


@pytest.mark.parametrize(
    ("seed", "expected"), [("7", 7), (7.0, 7), (np.array([7]), 7), (np.nan, None)]
)
def test_seeds_of_any_type(path: Path, seed: Any, expected: int | None) -> None:
    put(path, "setup/seed", seed)
    assert read(path).seed == expected


def test_subgoals_of_the_demonstration_are_evidence(path: Path) -> None:
    assert read(path).evidence is None  # there are none
    subgoals = ["static", "pick up the peg", "pick up the peg", "hook it", "hook it", "hook it"]
    for name in ("grounded_subgoal", "simple_subgoal"):  # the second one counts
        with h5py.File(path, "r+") as file:
            for step, text in enumerate(subgoals):
                file[f"episode_0/timestep_{step}/info/{name}"] = (
                    text if name[0] == "s" else f"{text} at <1, 2>"
                )
    assert read(path).evidence == (  # five frames are of the demonstration
        EvidenceSpan(0, "pick up the peg", 1, 3),
        EvidenceSpan(1, "hook it", 3, 5),
    )


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("setup/task_goal", None),
        ("setup/task_goal", np.bytes_(b"\xff\xfe")),
        ("setup/seed", "seven"),
        ("setup/seed", 7.5),
        ("timestep_7/info/is_video_demo", None),
        ("timestep_7/obs/joint_state", "text"),
    ],
)
def test_missing_or_invalid_values(path: Path, place: str, value: Any) -> None:
    put(path, place, value)
    with raises(SourceError) as raised:
        list(read(path).frames)
    assert raised.value.message.startswith(str(path))
    assert "Record or download the file again" in str(raised.value.hint)
    if "7/obs/" in place:  # what is met while frames are read says where
        assert "episode_0/timestep_7 is not" in raised.value.message


@pytest.mark.parametrize(
    ("place", "value"), [("timestep_4", None), ("timestep_8/info/is_video_demo", True)]
)
def test_unusable_recordings(path: Path, place: str, value: Any) -> None:
    put(path, place, value)
    with raises(SourceError):
        read(path)


@pytest.mark.parametrize("keep", [0, -90])
def test_files_that_are_not_whole(path: Path, keep: int) -> None:
    path.write_bytes(path.read_bytes()[:keep])
    with raises(SourceError):
        read(path)


@pytest.mark.parametrize(
    ("of", "flag"),
    [
        (str, "False"),
        (lambda shown: np.bytes_(str(int(shown))), "0"),
        (float, 0.0),
        (lambda shown: np.array([shown]), [False]),
        (np.uint8, 0),
    ],
)
def test_marks_of_any_type(path: Path, of: Any, flag: Any) -> None:
    """The text "False" is false."""
    for step in range(len(EPISODE)):
        put(path, f"timestep_{step}/info/is_video_demo", of(step < EPISODE.lesson))
    check_recording(read(path), EPISODE)


@pytest.mark.parametrize("value", ["maybe", "", 2, np.nan, np.array([True, False])])
def test_marks_without_one_meaning(path: Path, value: Any) -> None:
    put(path, "timestep_3/info/is_video_demo", value)
    with raises(SourceError):
        read(path)


def test_a_file_that_another_program_writes(path: Path) -> None:
    fcntl = pytest.importorskip("fcntl")
    with path.open("rb+") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with raises(SourceError) as raised:
            read(path)
    assert "HDF5_USE_FILE_LOCKING" in str(raised.value.hint)


@pytest.mark.parametrize("name", ["MoveCube (1)", "MoveCube - Copy", "MoveCube(2)"])
def test_a_second_download_of_a_file(path: Path, name: str) -> None:
    shutil.copyfile(path, path.with_stem(f"record_dataset_{name}"))
    with raises(InvalidIdError) as raised:
        read(path.parent)
    assert "remove it" in str(raised.value.hint)


def test_nothing_to_read(path: Path) -> None:
    for camera in ("front", "wrist"):
        put(path, f"timestep_0/obs/{camera}_rgb", None)
    with raises(SourceError):
        read(path)
    with h5py.File(path, "r+") as file:
        del file["episode_0"]
    with raises(SourceError):
        read(path)
    path.rename(path.with_stem("other"))
    with raises(SourceError):
        read(path.parent)


def test_any_flipped_bit_is_one_clear_error_or_none(path: Path) -> None:
    for _ in flipped_bits(path, 30):
        try:
            list(read(path).frames)
        except SourceError as error:
            assert "\n" not in error.message


def test_no_family_and_no_h5py(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path.rename(path.with_stem("record_dataset_Move Cube"))
    with raises(InvalidIdError):
        read(path.parent)
    monkeypatch.delitem(sys.modules, H5Source.__module__)
    monkeypatch.setitem(sys.modules, "h5py", None)
    with raises(MissingExtraError):
        read(path.parent)


@pytest.mark.parametrize(
    ("family", "seeds", "expected"),
    [
        # train: 1000 · code + 100 · index + attempt; MoveCube's code is 14
        ("MoveCube", {7: 14_799}, "train/7"),
        ("VideoUnmaskSwap", {3: 5301, 0: 5000}, "train/3 train/0"),
        ("RouteStick", {100: 25_900}, "train/99"),
        # test: 500,000 + 10,000 · code + 100 · index + attempt; PatternLock's code is 15
        ("PatternLock", {1: 650_000, 50: 654_902}, "test/0 test/49"),
        # val: 1,000,000 + 10,000 · code + 100 · index + attempt; a few are 100 higher
        ("RouteStick", {5: 1_160_500, 6: 1_160_700, 7: 1_160_700}, "val/5 val/6 val/7"),
        # one file with several splits
        ("MoveCube", {1: 14_000, 2: 640_100, 3: 1_140_200}, "train/0 test/1 val/2"),
        # no seeds, or a family that RoboMME does not have: numbering says it
        ("MoveCube", {1: None, 4: None}, "train/0 train/3"),
        ("OpenDrawer", {1: 7, 2: 8}, "train/0 train/1"),
        # seeds of another rule contradict each other: numbering says it
        ("MoveCube", {1: 3, 2: 999}, "train/0 train/1"),
        # where there is an episode 0, numbers are indices whatever the seeds say
        ("MoveCube", {0: 14_100, 1: 14_200}, "train/0 train/1"),
    ],
)
def test_identify(family: str, seeds: dict[int, int | None], expected: str) -> None:
    found = identify(family, seeds)
    assert list(found) == list(seeds)
    assert [str(name) for name in found.values()] == [f"{family}/{n}" for n in expected.split()]
