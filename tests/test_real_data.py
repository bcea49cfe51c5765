"""Real RoboMME recordings, all the way: every pixel and number against h5py and the raw videos."""

import shutil
import subprocess
import sys
from pathlib import Path

import av
import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from recordings import build, opened, run_here

from robomme_interference_data import Dataset, load_buffer
from robomme_interference_data.build_dataset import build as build_module
from robomme_interference_data.build_dataset.build import Filters
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.verify import verify_split
from robomme_interference_data.constants import FAMILIES

pytestmark = pytest.mark.filterwarnings("ignore:Cannot enable progress bars")

LESSONS = ("PatternLock", "VideoUnmask")
RAW_LENGTH = {"PatternLock": 96, "VideoUnmaskSwap": 326}
DEMONSTRATION_LENGTH = {"PatternLock": 48, "VideoUnmaskSwap": 168}


@pytest.fixture(scope="module", autouse=True)
def _here():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_module, "run_tasks", run_here)
        yield


@pytest.fixture(scope="module")
def recordings(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two families' first training episode, as RoboMME's own recorder wrote them."""
    folder = tmp_path_factory.mktemp("h5")
    script = shared_data / "unpack_h5.py"
    subprocess.run([sys.executable, script, folder, *RAW_LENGTH], check=True, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def demonstrations(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("real") / "demonstrations"
    result = build("demonstrations", open_source(f"robomme-h5:{recordings}"), out)
    assert (result.episodes, result.frames, result.skipped) == (2, 169 + 49, ())
    return opened(out)


@pytest.fixture(scope="module")
def units(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    out = tmp_path_factory.mktemp("real") / "distractors"
    result = build("distractors", open_source(f"robomme-h5:{recordings}"), out)
    (skipped,) = result.skipped
    assert (skipped.episode_id, skipped.raw_length) == ("PatternLock/train/0", 96)
    assert skipped.reason == "96 raw frames; a unit needs 249"
    assert (result.episodes, result.frames) == (1, 32)
    return opened(out)


def raw(folder: Path, family: str, steps: range) -> dict[str, NDArray]:
    """The raw frames and vectors of episode 0, straight from the file."""
    with h5py.File(folder / f"record_dataset_{family}.h5", "r") as file:
        groups = [file[f"episode_0/timestep_{step}"] for step in steps]
        states = [[*g["obs/joint_state"][()], g["obs/gripper_state"][0]] for g in groups]
        return {
            "observation.images.front": np.stack([g["obs/front_rgb"][()] for g in groups]),
            "observation.images.wrist": np.stack([g["obs/wrist_rgb"][()] for g in groups]),
            "observation.state": np.array(states, np.float32),
            "action": np.array([g["action/joint_action"][()] for g in groups], np.float32),
        }


def check(dataset: Dataset, index: int, expected: dict[str, NDArray]) -> None:
    """Hold a stored episode against raw values, bit for bit."""
    length = dataset.record(index).length
    for feature, values in expected.items():
        assert len(values) == length
        if feature in dataset.cameras:
            for position, frame in enumerate(dataset.iter_frames(index, feature, 0, length)):
                assert np.array_equal(frame, values[position]), (feature, position)
        else:
            stored = dataset.read_vectors(index, feature, 0, length)
            assert stored.tobytes() == values.tobytes(), feature


# --- recordings ----------------------------------------------------------------------------------


def test_what_the_source_lists(recordings: Path) -> None:
    listed = open_source(f"robomme-h5:{recordings}").episodes()
    assert [str(e.id) for e in listed] == ["VideoUnmaskSwap/train/0", "PatternLock/train/0"]
    for episode, seed in zip(listed, (5000, 15_001), strict=True):
        assert (episode.seed, episode.simulator, episode.exact) == (seed, "robomme", True)
        assert episode.raw_length == RAW_LENGTH[episode.id.family]
        assert episode.demonstration_length == DEMONSTRATION_LENGTH[episode.id.family]
        assert episode.cameras == {"front": (256, 256), "wrist": (256, 256)}
        assert all(goal.startswith("watch the video carefully, then ") for goal in episode.goals)


def test_demonstrations(recordings: Path, demonstrations: Dataset) -> None:
    for record in demonstrations.records():
        start = DEMONSTRATION_LENGTH[record.id.family]
        assert (record.length, record.exec_start_idx, record.exact) == (start + 1, start, True)
        expected = raw(recordings, record.id.family, range(start + 1))
        check(demonstrations, record.episode_index, expected)


def test_the_query_frame_is_the_first_that_is_no_demonstration(
    recordings: Path, demonstrations: Dataset
) -> None:
    for record in demonstrations.records():
        with h5py.File(recordings / f"record_dataset_{record.id.family}.h5", "r") as file:
            flags = [
                bool(file[f"episode_0/timestep_{step}/info/is_video_demo"][()])
                for step in range(record.raw_length)
            ]
        assert flags.index(False) == record.exec_start_idx
        assert not any(flags[record.exec_start_idx :])


def test_units(recordings: Path, units: Dataset) -> None:
    check(units, 0, raw(recordings, "VideoUnmaskSwap", range(0, 256, 8)))


def test_lerobot_reads_the_same_pixels(recordings: Path, units: Dataset) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("local/units", root=units.files.root, video_backend="pyav")
    expected = raw(recordings, "VideoUnmaskSwap", range(0, 256, 8))
    for position in (0, 1, 15, 16, 17, 31):
        item = dataset[position]
        for camera in units.cameras:
            pixels = np.round(item[camera].numpy() * 255).astype(np.uint8).transpose(1, 2, 0)
            assert np.array_equal(pixels, expected[camera][position])


def test_the_truncated_recording_is_refused(recordings: Path, tmp_path: Path) -> None:
    name = "record_dataset_PatternLock.h5"
    data = (recordings / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) // 2])
    with pytest.raises(ValueError, match="is not a complete RoboMME recording"):
        open_source(f"robomme-h5:{tmp_path}").episodes()


# --- lessons of test episodes, and a whole split -------------------------------------------------


def lesson_frames(folder: Path, family: str) -> NDArray[np.uint8]:
    with av.open(str(folder / f"{family}_test_0_front.mkv")) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def as_frames_folder(lessons: Path, folder: Path, families: tuple[str, ...]) -> None:
    """Lay the lessons out as the `frames` source wants them."""
    rows = []
    for family in families:
        values = np.load(lessons / f"{family}_test_0.npz")
        video = folder / f"videos/front/{family}/test/0.mkv"
        video.parent.mkdir(parents=True)
        shutil.copy(lessons / f"{family}_test_0_front.mkv", video)
        rows += [
            {
                "episode_id": f"{family}/test/0",
                "frame_index": step,
                "state": state.tolist(),
                "goal": str(values["task_goal"][0]),
                "is_demo": step < values["exec_start_idx"],
                "seed": int(values["seed"]),
                "difficulty": str(values["difficulty"]),
                "simulator": "robomme",
                "exact": True,
            }
            for step, state in enumerate(values["state"])
        ]
    pq.write_table(pa.Table.from_pylist(rows), folder / "frames.parquet")


@pytest.fixture(scope="module")
def split(shared_data: Path, recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Test lessons of two families, and one unit of a third."""
    folder = tmp_path_factory.mktemp("split")
    as_frames_folder(shared_data / "lessons", folder / "lessons", LESSONS)
    root = folder / "split"
    build("demonstrations", open_source(f"frames:{folder / 'lessons'}"), root / "demonstrations")
    build(
        "distractors",
        open_source(f"robomme-h5:{recordings}"),
        root / "distractors",
        filters=Filters(split="train"),
        cameras=("front",),
    )
    datasets = opened(root / "demonstrations"), opened(root / "distractors")
    for _ in write_manifests(plan_manifests(*datasets, (0, 1)), root / "manifests"):
        pass
    return root


@pytest.mark.parametrize(("family", "start"), [("PatternLock", 86), ("VideoUnmask", 66)])
def test_a_buffer_of_real_frames(
    shared_data: Path, recordings: Path, split: Path, family: str, start: int
) -> None:
    lesson = lesson_frames(shared_data / "lessons", family)
    states = np.load(shared_data / f"lessons/{family}_test_0.npz")["state"]
    unit = raw(recordings, "VideoUnmaskSwap", range(0, 256, 8))
    buffer = load_buffer(f"{family}/test/0", k=1, split=split, verify=True)
    assert len(lesson) == start + 1
    assert buffer.exec_start_idx == start + 32
    assert np.array_equal(buffer.session_index, [0] * start + [1] * 32)
    frames = buffer.frames("front")
    assert np.array_equal(frames[:start], lesson[:start])
    assert np.array_equal(frames[start:], unit["observation.images.front"])
    assert buffer.states.tobytes() == states[:start].tobytes() + unit["observation.state"].tobytes()
    dataset = opened(split / "demonstrations")
    index = buffer.manifest.query.episode_index
    (query,) = dataset.iter_frames(index, "observation.images.front", start, start + 1)
    assert np.array_equal(query, lesson[start])


def test_the_real_split_verifies(split: Path) -> None:
    assert list(verify_split(split)) == []


@pytest.mark.slow
@pytest.mark.timeout(900)  # 3,000 frames of 256 × 256
def test_the_lessons_of_all_nine_families(shared_data: Path, tmp_path: Path) -> None:
    as_frames_folder(shared_data / "lessons", tmp_path / "lessons", FAMILIES)
    build("demonstrations", open_source(f"frames:{tmp_path / 'lessons'}"), tmp_path / "out")
    dataset = opened(tmp_path / "out")
    assert tuple(record.id.family for record in dataset.records()) == FAMILIES
    for record in dataset.records():
        values = np.load(shared_data / f"lessons/{record.id.family}_test_0.npz")
        assert record.exec_start_idx == values["exec_start_idx"]
        expected = {
            "observation.images.front": lesson_frames(shared_data / "lessons", record.id.family),
            "observation.state": values["state"],
        }
        check(dataset, record.episode_index, expected)
