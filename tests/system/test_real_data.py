"""Real RoboMME recordings, all the way: every pixel and number against h5py and the raw videos."""

import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.build_dataset.dataset.build import build_dataset
from robomme_interference_data.build_dataset.dataset.plan import DatasetPlan
from robomme_interference_data.build_dataset.manifests import plan_manifests, write_manifests
from robomme_interference_data.build_dataset.plan.episodes import choose_episodes
from robomme_interference_data.build_dataset.plan.planned import datasets_in
from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.runtime.executor import Serial

h5py = pytest.importorskip("h5py")

pytestmark = pytest.mark.slow

LENGTHS = {"VideoUnmaskSwap": (5000, 326, 168), "PatternLock": (15_001, 96, 48)}
"""Of a family's first training episode: seed, raw frames, and those of the demonstration."""


@pytest.fixture(scope="module")
def recordings(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two episodes as RoboMME's own recorder wrote them."""
    folder = tmp_path_factory.mktemp("h5")
    script = shared_data / "unpack_h5.py"
    subprocess.run([sys.executable, script, folder, *LENGTHS], check=True, capture_output=True)
    return folder


def test_every_frame_of_a_recording(recordings: Path) -> None:
    source = open_source(f"robomme-h5:{recordings}")
    for episode, (family, (seed, length, lesson)) in zip(
        source.episodes(), LENGTHS.items(), strict=True
    ):
        recording = source.read(episode, None)
        assert (str(episode.id), recording.seed) == (f"{family}/train/0", seed)
        assert all(goal.startswith("watch the video carefully, then ") for goal in recording.goals)
        frames = list(recording.frames)
        assert [frame.is_demonstration for frame in frames] == [n < lesson for n in range(length)]
        with h5py.File(recordings / f"record_dataset_{family}.h5", "r") as file:
            for step, frame in enumerate(frames):
                group = file[f"episode_0/timestep_{step}"]
                assert frame.is_demonstration == group["info/is_video_demo"][()]
                for camera, image in frame.images.items():
                    assert np.array_equal(image, group[f"obs/{camera}_rgb"][()])
                state = [*group["obs/joint_state"][()], group["obs/gripper_state"][0]]
                assert np.array_equal(frame.state, np.array(state, np.float32))
                action = group["action/joint_action"][()].astype(np.float32)
                assert np.array_equal(frame.action, action)


def write_lessons(lessons: Path, folder: Path, starts: dict[str, int]) -> None:
    """Lay lessons of test episodes out as the `frames` source wants them."""
    rows = []
    for family, start in starts.items():
        values = np.load(lessons / f"{family}_test_0.npz")
        assert values["exec_start_idx"] == start
        video = folder / f"videos/front/{family}/test/0.mkv"
        video.parent.mkdir(parents=True)
        copy_at_rate(lessons / f"{family}_test_0_front.mkv", video, 10)
        rows += [
            {
                "episode_id": f"{family}/test/0",
                "frame_index": step,
                "state": state.tolist(),
                "goal": str(values["task_goal"][0]),
                "is_demo": step < start,
                "simulator": "robomme",
            }
            for step, state in enumerate(values["state"])
        ]
    pq.write_table(pa.Table.from_pylist(rows), folder / "frames.parquet")


def copy_at_rate(source: Path, target: Path, fps: int) -> None:
    """Store a video's frames, bit for bit, at the rate of RoboMME: the file has another one."""
    with av.open(str(target), "w") as new:
        stream = new.add_stream("ffv1", rate=fps)
        stream.pix_fmt = "bgr0"
        frames = video_frames(source)
        stream.height, stream.width = frames.shape[1:3]
        for frame in frames:
            new.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "rgb24")))
        new.mux(stream.encode())


def video_frames(path: Path) -> NDArray[np.uint8]:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


def test_a_buffer_set_of_real_frames(shared_data: Path, recordings: Path, tmp_path: Path) -> None:
    """Test lessons of two families, and one unit of a third."""
    buffer_set, starts = tmp_path / "buffer_set", {"PatternLock": 86, "VideoUnmask": 66}
    lessons = shared_data / "lessons"
    write_lessons(lessons, tmp_path / "lessons", starts)
    sources = {"demonstrations": f"frames:{tmp_path / 'lessons'}"}
    for kind, name in (sources | {"distractors": f"robomme-h5:{recordings}"}).items():
        source = open_source(name)
        plan = DatasetPlan(kind, (source,), choose_episodes([source]), ("front",))
        result = build_dataset(plan, buffer_set / kind, Serial(), WorkProgress(unit="episodes"))
    assert result.skipped == {"PatternLock/train/0": "96 raw frames; a unit needs 249"}
    for _ in write_manifests(
        plan_manifests(datasets_in(buffer_set), ("k0", "k1"), 0, None), buffer_set
    ):
        pass
    assert list(verify_buffer_set(load_buffer_set(buffer_set))) == []
    with h5py.File(recordings / "record_dataset_VideoUnmaskSwap.h5", "r") as file:
        groups = [file[f"episode_0/timestep_{step}"] for step in range(0, 256, 8)]
        unit = np.stack([group["obs/front_rgb"][()] for group in groups])
    for family, start in starts.items():
        lesson = video_frames(lessons / f"{family}_test_0_front.mkv")
        states = np.load(lessons / f"{family}_test_0.npz")["state"]
        buffer = load_buffer(f"{family}/test/0", k=1, buffer_set=buffer_set, verify=True)
        assert (len(lesson), len(buffer)) == (start + 1, start + 32)
        assert np.array_equal(buffer.frames("front"), [*lesson[:start], *unit])
        assert np.array_equal(buffer.states[:start], states[:start])
        assert np.array_equal(buffer.query.frame("front"), lesson[start])
