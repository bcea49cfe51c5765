"""Real RoboMME recordings, all the way: every pixel and number against h5py and the raw videos."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from robomme_interference_data import Dataset, load_buffer
from robomme_interference_data.build_dataset.build import BuildPlan, BuildResult, build_dataset
from robomme_interference_data.build_dataset.config import list_episodes
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.verify import verify_split
from robomme_interference_data.console import WorkProgress
from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.execution import Serial
from robomme_interference_data.files import LocalFiles

h5py = pytest.importorskip("h5py")
pytestmark = pytest.mark.filterwarnings("ignore:Cannot enable progress bars")

LENGTHS = {"PatternLock": (96, 48), "VideoUnmaskSwap": (326, 168)}
"""Family to the raw frames and the demonstration frames of its first training episode."""
UNIT = range(0, 256, 8)


def build(kind: str, specification: str, out: Path, split: str | None = None) -> BuildResult:
    sources = (open_source(specification),)
    cameras = ("front",) if kind == "distractors" and split else None
    plan = BuildPlan(kind, sources, list_episodes(sources, split=split), cameras)
    return build_dataset(plan, out, Serial(), WorkProgress(unit="episodes"))


def opened(folder: Path) -> Dataset:
    return Dataset(LocalFiles(folder))


@pytest.fixture(scope="module")
def recordings(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two families' first training episode, as RoboMME's own recorder wrote them."""
    folder = tmp_path_factory.mktemp("h5")
    script = shared_data / "unpack_h5.py"
    subprocess.run([sys.executable, script, folder, *LENGTHS], check=True, capture_output=True)
    return folder


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
    assert set(dataset.features) == set(expected)
    for feature, values in expected.items():
        assert len(values) == length
        if feature.startswith("observation.images."):
            for position, frame in enumerate(dataset.iter_frames(index, feature, 0, length)):
                assert np.array_equal(frame, values[position]), (feature, position)
        else:
            stored = dataset.read_vectors(index, feature, 0, length)
            assert stored.tobytes() == values.tobytes(), feature


def test_every_frame_is_read(recordings: Path) -> None:
    source = open_source(f"robomme-h5:{recordings}")
    seeds = {"VideoUnmaskSwap": 5000, "PatternLock": 15_001}
    for episode, family in zip(source.episodes(), seeds, strict=True):
        recording = source.read(episode, None)
        assert (str(episode.id), recording.seed) == (f"{family}/train/0", seeds[family])
        assert all(goal.startswith("watch the video carefully, then ") for goal in recording.goals)
        length, lesson = LENGTHS[family]
        expected = raw(recordings, family, range(length))
        for number, frame in enumerate(recording.frames):
            for camera, image in frame.images.items():
                assert np.array_equal(image, expected[f"observation.images.{camera}"][number])
            assert np.array_equal(frame.state, expected["observation.state"][number])
            assert np.array_equal(frame.action, expected["action"][number])
            assert frame.is_demonstration == (number < lesson)
        assert number == length - 1


def test_demonstrations(recordings: Path, tmp_path: Path) -> None:
    shutil.copy(recordings / "record_dataset_PatternLock.h5", tmp_path)
    result = build("demonstrations", f"robomme-h5:{tmp_path}", tmp_path / "out")
    assert (result.episodes, result.frames, result.skipped) == (1, 49, {})
    (record,) = opened(tmp_path / "out").records()
    assert (record.length, record.exec_start_idx, record.exact) == (49, 48, True)
    assert (record.seed, record.simulator) == (15_001, "robomme")
    check(opened(tmp_path / "out"), 0, raw(recordings, "PatternLock", range(49)))


def test_units_and_how_lerobot_reads_them(recordings: Path, tmp_path: Path) -> None:
    result = build("distractors", f"robomme-h5:{recordings}", tmp_path / "out")
    assert (result.episodes, result.frames) == (1, 32)
    assert result.skipped == {"PatternLock/train/0": "96 raw frames; a unit needs 249"}
    units, expected = opened(tmp_path / "out"), raw(recordings, "VideoUnmaskSwap", UNIT)
    check(units, 0, expected)
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("local/units", root=tmp_path / "out", video_backend="pyav")
    for position in (0, 1, 15, 16, 17, 31):
        item = dataset[position]
        for camera in ("observation.images.front", "observation.images.wrist"):
            pixels = np.round(item[camera].numpy() * 255).astype(np.uint8).transpose(1, 2, 0)
            assert np.array_equal(pixels, expected[camera][position])


# --- lessons of test episodes, and a whole split -------------------------------------------------


def lesson_frames(folder: Path, family: str) -> NDArray[np.uint8]:
    with av.open(str(folder / f"{family}_test_0_front.mkv")) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


@pytest.fixture
def as_frames_folder(shared_data: Path, tmp_path: Path) -> Callable[..., Path]:
    """Lay lessons out as the `frames` source wants them."""
    lessons = shared_data / "lessons"

    def write(*families: str) -> Path:
        rows = []
        for family in families:
            values = np.load(lessons / f"{family}_test_0.npz")
            video = tmp_path / f"lessons/videos/front/{family}/test/0.mkv"
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
                }
                for step, state in enumerate(values["state"])
            ]
        pq.write_table(pa.Table.from_pylist(rows), tmp_path / "lessons/frames.parquet")
        return tmp_path / "lessons"

    return write


def test_a_split_of_real_frames(
    shared_data: Path, recordings: Path, as_frames_folder: Callable[..., Path], tmp_path: Path
) -> None:
    """Test lessons of two families, and one unit of a third."""
    split, starts = tmp_path / "split", {"PatternLock": 86, "VideoUnmask": 66}
    folder = as_frames_folder(*starts)
    build("demonstrations", f"frames:{folder}", split / "demonstrations")
    build("distractors", f"robomme-h5:{recordings}", split / "distractors", "train")
    for _ in write_manifests(plan_manifests(split, ("k0", "k1"), 0, None), split):
        pass
    assert list(verify_split(split)) == []
    unit = raw(recordings, "VideoUnmaskSwap", UNIT)
    for family, start in starts.items():
        lesson = lesson_frames(shared_data / "lessons", family)
        states = np.load(shared_data / f"lessons/{family}_test_0.npz")["state"]
        buffer = load_buffer(f"{family}/test/0", k=1, split=split, verify=True)
        assert (len(lesson), buffer.exec_start_idx) == (start + 1, start + 32)
        frames = buffer.frames("front")
        assert np.array_equal(frames[:start], lesson[:start])
        assert np.array_equal(frames[start:], unit["observation.images.front"])
        expected = states[:start].tobytes() + unit["observation.state"].tobytes()
        assert buffer.states.tobytes() == expected
        assert np.array_equal(buffer.query.frame("front"), lesson[start])


@pytest.mark.slow
@pytest.mark.timeout(900)  # 3,000 frames of 256 × 256
def test_the_lessons_of_all_nine_families(
    shared_data: Path, as_frames_folder: Callable[..., Path], tmp_path: Path
) -> None:
    build("demonstrations", f"frames:{as_frames_folder(*FAMILIES)}", tmp_path / "out")
    dataset = opened(tmp_path / "out")
    assert tuple(record.episode_id.family for record in dataset.records()) == FAMILIES
    for record in dataset.records():
        family = record.episode_id.family
        values = np.load(shared_data / f"lessons/{family}_test_0.npz")
        assert record.exec_start_idx == values["exec_start_idx"]
        expected = {
            "observation.images.front": lesson_frames(shared_data / "lessons", family),
            "observation.state": values["state"],
        }
        check(dataset, record.episode_index, expected)
