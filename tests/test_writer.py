"""LeRobot opens what was written, and yields the very frames of the source."""

import json
import logging
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from recordings import MemorySource, build, images_of, listed, run_here, vectors_of

from robomme_interference_data.build_dataset import build as build_module
from robomme_interference_data.build_dataset import writer
from robomme_interference_data.build_dataset.encode import CODECS, VideoEncoder
from robomme_interference_data.build_dataset.sources.base import SourceEpisode
from robomme_interference_data.errors import MissingExtraError

pytestmark = pytest.mark.filterwarnings("ignore:Cannot enable progress bars")

# The lessons end before, at and after a key frame of their video.
EPISODES = [
    listed("MoveCube/test/0", lesson=1),
    listed("MoveCube/test/1", lesson=15),
    listed("MoveCube/test/2", lesson=16),
    listed("InsertPeg/test/4", lesson=20),
    listed("Drawer/test/0", lesson=3, goals=("do MoveCube",)),
]
UNITS = [listed(f"{family}/train/{i}") for family in ("MoveCube", "Drawer") for i in range(2)]


@pytest.fixture(scope="module", autouse=True)
def _here():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_module, "run_tasks", run_here)
        yield


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("writer") / "demonstrations"
    build("demonstrations", MemorySource(EPISODES), out)
    return out


@pytest.fixture(scope="module")
def units(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("writer") / "units"
    build("distractors", MemorySource(UNITS), out)
    return out


def lerobot(root: Path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("local/test", root=root, video_backend="pyav")


def check_frames(root: Path, episodes: list[SourceEpisode], spans: list[range]) -> None:
    """Hold every frame of a dataset against the source, through lerobot's own reader."""
    dataset = lerobot(root)
    cameras = [key.rpartition(".")[2] for key in dataset.meta.video_keys]
    assert cameras
    assert len(dataset) == sum(map(len, spans))
    index = 0
    for number, (episode, span) in enumerate(zip(episodes, spans, strict=True)):
        images = {camera: images_of(episode, camera)[list(span)] for camera in cameras}
        states = vectors_of(episode, "state", episode.state_size)[list(span)]
        actions = (
            None
            if episode.action_size is None
            else vectors_of(episode, "action", episode.action_size)[list(span)]
        )
        for position in range(len(span)):
            item = dataset[index]
            for camera in cameras:
                given = item[f"observation.images.{camera}"].numpy()
                pixels = np.round(given * 255).astype(np.uint8).transpose(1, 2, 0)
                assert np.array_equal(pixels, images[camera][position]), (episode.id, position)
            assert item["observation.state"].numpy().tobytes() == states[position].tobytes()
            if actions is None:
                assert "action" not in item
            else:
                assert item["action"].numpy().tobytes() == actions[position].tobytes()
            assert item["task"] == episode.goals[0]
            assert item["index"] == index
            assert (item["episode_index"], item["frame_index"]) == (number, position)
            assert item["timestamp"].item() == pytest.approx(position / 10)
            index += 1


# --- reading back --------------------------------------------------------------------------------


def test_every_frame_of_demonstrations(demonstrations: Path) -> None:
    ordered = [EPISODES[i] for i in (0, 1, 2, 3, 4)]
    spans = [range(lesson + 1) for lesson in (1, 15, 16, 20, 3)]
    check_frames(demonstrations, ordered, spans)


def test_every_frame_of_units(units: Path) -> None:
    check_frames(units, UNITS, [range(0, 256, 8)] * 4)


def test_metadata(demonstrations: Path) -> None:
    dataset = lerobot(demonstrations)
    assert (len(dataset), dataset.num_episodes, dataset.fps) == (2 + 16 + 17 + 21 + 4, 5, 10)
    assert list(dataset.meta.tasks.index) == ["do MoveCube", "do InsertPeg"]
    names = [f"joint_{i}" for i in range(1, 8)] + ["gripper"]
    for feature in ("observation.state", "action"):
        given = dataset.features[feature]
        assert (given["dtype"], given["shape"], given["names"]) == ("float32", (8,), names)
    for camera in ("front", "wrist"):
        given = dataset.features[f"observation.images.{camera}"]
        assert (given["dtype"], given["shape"]) == ("video", (16, 24, 3))
        assert given["names"] == ["height", "width", "channels"]
    assert dataset.meta.episodes["length"] == [2, 16, 17, 21, 4]


def test_info_says_how_the_videos_were_encoded(demonstrations: Path) -> None:
    info = json.loads((demonstrations / "meta/info.json").read_text())
    video = info["features"]["observation.images.wrist"]["info"]
    assert (video["video.codec"], video["video.pix_fmt"]) == ("av1", "gbrp")
    assert (video["video.height"], video["video.width"], video["video.fps"]) == (16, 24, 10)
    assert video["video.g"] == 16
    assert video["video.extra_options"] == CODECS["av1-lossless"].settings["extra_options"]
    assert (info["codebase_version"], info["fps"]) == ("v3.0", 10)
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (5, 60, 2)
    assert (info["video_files_size_in_mb"], info["data_files_size_in_mb"]) == (64, 64)


def test_statistics(demonstrations: Path) -> None:
    spans = zip(EPISODES, (2, 16, 17, 21, 4), strict=True)
    frames = np.concatenate([images_of(e, "wrist")[:n] for e, n in spans])[:, ::4, ::4] / 255
    stats = lerobot(demonstrations).meta.stats["observation.images.wrist"]
    for name, expected in (
        ("min", frames.min((0, 1, 2))),
        ("max", frames.max((0, 1, 2))),
        ("mean", frames.mean((0, 1, 2))),
        ("std", frames.std((0, 1, 2))),
    ):
        assert stats[name].shape == (3, 1, 1)
        np.testing.assert_allclose(stats[name].ravel(), expected, rtol=1e-6, err_msg=name)
    assert stats["q50"].shape == (3, 1, 1)


def test_statistics_of_vectors(units: Path) -> None:
    states = np.concatenate([vectors_of(episode, "state", 8)[:256:8] for episode in UNITS])
    stats = lerobot(units).meta.stats["observation.state"]
    for name in ("min", "max", "mean", "std"):
        expected = getattr(states.astype(np.float64), name)(0)
        np.testing.assert_allclose(stats[name], expected, rtol=1e-5, atol=1e-6, err_msg=name)


# --- files --------------------------------------------------------------------------------------


def test_every_family_has_files_of_its_own(demonstrations: Path) -> None:
    def numbers(pattern: str) -> list[str]:
        return sorted(path.name for path in demonstrations.glob(pattern))

    assert numbers("data/chunk-000/*") == [f"file-00{i}.parquet" for i in range(3)]
    for camera in ("front", "wrist"):
        folder = f"videos/observation.images.{camera}/chunk-000/*"
        assert numbers(folder) == [f"file-00{i}.mp4" for i in range(3)]
    episodes = lerobot(demonstrations).meta.episodes
    assert episodes["data/file_index"] == [0, 0, 0, 1, 2]
    assert episodes["videos/observation.images.wrist/file_index"] == [0, 0, 0, 1, 2]
    for number, indices in enumerate(([0, 1, 2], [3], [4])):
        data = pq.read_table(demonstrations / f"data/chunk-000/file-00{number}.parquet")
        assert sorted(set(data["episode_index"].to_pylist())) == indices


def test_an_episode_is_a_row_group(demonstrations: Path) -> None:
    file = pq.ParquetFile(demonstrations / "data/chunk-000/file-000.parquet")
    assert [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)] == [2, 16, 17]


def test_large_families_are_cut_into_several_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "_VIDEO_FILE_MB", 1e-9)
    build("distractors", MemorySource(UNITS), tmp_path / "out", cameras=("front",))
    dataset = lerobot(tmp_path / "out")
    assert dataset.meta.episodes["videos/observation.images.front/file_index"] == [0, 1, 2, 3]
    assert dataset.meta.episodes["data/file_index"] == [0, 0, 1, 1]
    check_frames(tmp_path / "out", UNITS, [range(0, 256, 8)] * 4)


def test_no_leftovers_inside(demonstrations: Path) -> None:
    names = {path.relative_to(demonstrations).as_posix() for path in demonstrations.rglob("*")}
    assert {name.partition("/")[0] for name in names} == {"data", "meta", "videos"}
    assert {name for name in names if name.startswith("meta/")} == {
        "meta/build_report.json",
        "meta/episodes",
        "meta/episodes/chunk-000",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/interference.json",
        "meta/stats.json",
        "meta/tasks.parquet",
    }


# --- other features ------------------------------------------------------------------------------


def test_without_actions_and_with_another_state(tmp_path: Path) -> None:
    episodes = [listed("Drawer/train/0", action_size=None, state_size=3)]
    build("distractors", MemorySource(episodes), tmp_path / "out")
    dataset = lerobot(tmp_path / "out")
    assert "action" not in dataset.features
    assert dataset.features["observation.state"]["names"] == ["value_0", "value_1", "value_2"]
    check_frames(tmp_path / "out", episodes, [range(0, 256, 8)])


def test_one_camera_of_two(tmp_path: Path) -> None:
    build("distractors", MemorySource(UNITS[:1]), tmp_path / "out", cameras=("wrist",))
    assert lerobot(tmp_path / "out").meta.video_keys == ["observation.images.wrist"]
    check_frames(tmp_path / "out", UNITS[:1], [range(0, 256, 8)])


def test_cameras_of_another_name_and_one_pixel(tmp_path: Path) -> None:
    episodes = [listed("Drawer/train/0", cameras=("front", "top-left"), size=(1, 1))]
    build("distractors", MemorySource(episodes), tmp_path / "out")
    assert "observation.images.top-left" in lerobot(tmp_path / "out").features
    check_frames(tmp_path / "out", episodes, [range(0, 256, 8)])


def test_a_single_episode_of_two_frames(tmp_path: Path) -> None:
    episodes = [listed("Drawer/test/0", length=2, lesson=1)]
    build("demonstrations", MemorySource(episodes), tmp_path / "out")
    check_frames(tmp_path / "out", episodes, [range(2)])


def test_goals_with_any_letters(tmp_path: Path) -> None:
    goal = 'nimm den „Würfel“\n"two" lines, 立方体'
    episodes = [listed("Drawer/train/0", goals=(goal,))]
    build("distractors", MemorySource(episodes), tmp_path / "out", cameras=("front",))
    check_frames(tmp_path / "out", episodes, [range(0, 256, 8)])


# --- around lerobot ------------------------------------------------------------------------------


def test_nothing_is_printed_and_logging_is_left_as_it_was(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    loggers = [logging.getLogger(name) for name in ("lerobot", "datasets", "libav")]
    levels = [logger.level for logger in loggers]
    for number in range(2):  # what the first build leaves behind must not make the second print
        build("distractors", MemorySource(UNITS[:2]), tmp_path / f"{number}")
    encoder = VideoEncoder(tmp_path / "video.mp4", CODECS["av1-lossless"], 10, 16, 16)
    encoder.add(np.zeros((16, 16, 3), np.uint8))
    encoder.close()
    assert capfd.readouterr() == ("", "")
    assert [logger.level for logger in loggers] == levels


def test_without_lerobot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    source = MemorySource(UNITS[:1])
    with pytest.raises(MissingExtraError, match="needs lerobot") as raised:
        build("distractors", source, tmp_path / "out")
    assert 'pip install "robomme-interference-data[build]"' in str(raised.value)
    assert source.reads == []
    assert list(tmp_path.iterdir()) == []
