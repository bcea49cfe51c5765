"""Episodes out of LeRobot datasets: v3.0 by lerobot's own writer, v2.1 made by hand."""

import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from lerobot_factory import (
    EXACT_VIDEO,
    MOVE,
    SMALL,
    SMALL_IDS,
    SMALL_ORDER,
    Recording,
    change_column,
    encode,
    recording,
    write_small_families,
    write_v3,
    write_v21,
)

from robomme_interference_data.build_dataset.sources import lerobot_read
from robomme_interference_data.build_dataset.sources.base import SourceEpisode
from robomme_interference_data.build_dataset.sources.lerobot import LeRobotSource
from robomme_interference_data.errors import SourceError

BOTH = ("front", "wrist")


@pytest.fixture
def families(tmp_path: Path) -> Path:
    return write_small_families(tmp_path)


@pytest.fixture(scope="module")
def v3(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("lerobot")
    root = tmp_path_factory.mktemp("v3") / "exact"
    write_v3(root, SMALL, video=EXACT_VIDEO)
    return root


@pytest.fixture(scope="module")
def v21(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("v21")
    write_v21(root / "png", SMALL)
    return root / "png"


def check_content(source: LeRobotSource, episode: SourceEpisode, expected: Recording) -> None:
    frames = list(source.read(episode))
    assert len(frames) == episode.raw_length == len(expected)
    for step, frame in enumerate(frames):
        assert sorted(frame.images) == sorted(expected.images)
        for camera, image in frame.images.items():
            assert image.dtype == np.uint8
            np.testing.assert_array_equal(image, expected.images[camera][step])
        np.testing.assert_array_equal(frame.state, expected.state[step])
        np.testing.assert_array_equal(frame.action, expected.action[step])
        assert frame.state.dtype == np.float32
        if episode.demonstration_length is None:
            assert frame.is_demonstration is None
        else:
            assert frame.is_demonstration is (step < expected.demonstration)


def check_small(source: LeRobotSource, marked: bool = True) -> list[SourceEpisode]:
    episodes = source.episodes()
    assert [str(episode.id) for episode in episodes] == SMALL_IDS
    for episode, place in zip(episodes, SMALL_ORDER, strict=True):
        expected = SMALL[place]
        assert episode.goals == (expected.goal,)
        assert episode.raw_length == len(expected)
        assert episode.demonstration_length == (expected.demonstration if marked else None)
        assert episode.cameras == {"front": (48, 64), "wrist": (48, 64)}
        assert (episode.state_size, episode.action_size) == (8, 8)
        assert (episode.seed, episode.difficulty, episode.simulator) == (None, None, None)
        assert episode.exact
        check_content(source, episode, expected)
    return episodes


def test_v3_video_without_loss(v3: Path, families: Path) -> None:
    source = LeRobotSource(str(v3), families_file=families)
    check_small(source)
    assert source.kind == "lerobot"
    assert source.provenance == {"kind": "lerobot"}


def test_v3_without_statistics(v3: Path, families: Path, tmp_path: Path) -> None:
    root = shutil.copytree(v3, tmp_path / "copy")
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    table = pq.read_table(path)
    kept = [name for name in table.column_names if not name.startswith("stats/")]
    assert "stats/exec_start_idx/min" in table.column_names
    pq.write_table(table.select(kept), path)
    check_small(LeRobotSource(str(root), families_file=families))


def test_v3_video_as_lerobot_reads_it(v3: Path, families: Path, tmp_path: Path) -> None:
    lossy = tmp_path / "lossy"
    write_v3(lossy, SMALL[:2], marked=False)
    two = tmp_path / "two.csv"
    two.write_text("episode_index,family\n0,MoveCube\n1,InsertPeg\n")
    for root, names, exact in ((v3, families, True), (lossy, two, False)):
        source = LeRobotSource(str(root), families_file=names)
        for episode in source.episodes():
            assert episode.exact is exact
            theirs = lerobot_frames(root, episode.key.place.index)
            ours = list(source.read(episode))
            assert len(theirs) == len(ours)
            for mine, other in zip(ours, theirs, strict=True):
                for camera in BOTH:
                    np.testing.assert_array_equal(mine.images[camera], other[camera])
    assert source.episodes()[0].demonstration_length is None
    original = SMALL[0].images["front"][0]
    assert not np.array_equal(next(source.read(source.episodes()[0])).images["front"], original)


def lerobot_frames(root: Path, index: int) -> list[dict[str, np.ndarray]]:
    from lerobot.datasets import LeRobotDataset

    dataset = LeRobotDataset("test/small", root=root, episodes=[index], video_backend="pyav")
    return [
        {
            camera: (item[f"observation.images.{camera}"] * 255)
            .round()
            .byte()
            .permute(1, 2, 0)
            .numpy()
            for camera in BOTH
        }
        for item in (dataset[step] for step in range(len(dataset)))
    ]


def test_v3_images_in_parquet(tmp_path: Path, families: Path) -> None:
    pytest.importorskip("lerobot")
    write_v3(tmp_path / "images", SMALL, images=True)
    check_small(LeRobotSource(str(tmp_path / "images"), families_file=families))


@pytest.mark.parametrize("stats", [True, False])
@pytest.mark.parametrize("rows_a_group", [1, 5, 100])
def test_v21_png(tmp_path: Path, families: Path, stats: bool, rows_a_group: int) -> None:
    write_v21(tmp_path / "png", SMALL, stats=stats, rows_a_group=rows_a_group)
    check_small(LeRobotSource(str(tmp_path / "png"), families_file=families))


def test_v21_video(tmp_path: Path, families: Path) -> None:
    write_v21(tmp_path / "video", SMALL, stored="video", marks=False)
    check_small(LeRobotSource(str(tmp_path / "video"), families_file=families), marked=False)


def test_v21_jpeg_is_not_exact(tmp_path: Path) -> None:
    write_v21(tmp_path / "jpg", [SMALL[0]], stored="jpg")
    (tmp_path / "f.csv").write_text("episode_index,family\n0,MoveCube\n")
    source = LeRobotSource(str(tmp_path / "jpg"), families_file=tmp_path / "f.csv")
    (episode,) = source.episodes()
    assert not episode.exact
    image = next(source.read(episode)).images["front"]
    assert image.shape == (48, 64, 3)
    assert np.abs(image.astype(int) - SMALL[0].images["front"][0]).mean() < 40


def test_jpeg_after_png_is_refused(tmp_path: Path, families: Path) -> None:
    write_v21(tmp_path / "mixed", SMALL)
    path = tmp_path / "mixed/data/chunk-000/episode_000002.parquet"
    cells = pq.read_table(path)["image"].to_pylist()
    cells[3]["bytes"] = encode(SMALL[2].images["front"][3], "jpg")
    change_column(path, "image", cells)
    source = LeRobotSource(str(tmp_path / "mixed"), families_file=families)
    frames = source.read(source.episodes()[1])
    with pytest.raises(SourceError, match="MoveCube/train/1: frame 3 of column 'image' is a JPEG"):
        list(frames)


def test_one_camera_is_enough(tmp_path: Path) -> None:
    write_v21(tmp_path / "one", [recording(1, 4, MOVE)])
    (tmp_path / "f.csv").write_text("episode_index,family\n0,MoveCube\n")
    source = LeRobotSource(str(tmp_path / "one"), families_file=tmp_path / "f.csv")
    assert source.episodes()[0].cameras == {"front": (48, 64)}


def test_only_the_cameras_asked_for_are_read(v21: Path, families: Path) -> None:
    source = LeRobotSource(str(v21), families_file=families)
    episode = source.episodes()[0]
    assert sorted(episode.cameras) == ["front", "wrist"]
    reduced = replace(episode, cameras={"front": episode.cameras["front"]})
    both, one = list(source.read(episode)), list(source.read(reduced))
    assert [list(frame.images) for frame in one] == [["front"]] * len(both)
    np.testing.assert_array_equal(one[-1].images["front"], both[-1].images["front"])


def test_copies_of_a_source_read_the_same(v21: Path, families: Path) -> None:
    source = LeRobotSource(str(v21), families_file=families)
    episodes = source.episodes()
    copy, again = pickle.loads(pickle.dumps((source, episodes)))
    assert again == episodes
    check_content(copy, again[2], SMALL[1])


def test_frames_are_decoded_one_by_one(
    v21: Path, families: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded = []
    decode = lerobot_read.decode_image
    monkeypatch.setattr(
        lerobot_read, "decode_image", lambda data: decoded.append(1) or decode(data)
    )
    source = LeRobotSource(str(v21), families_file=families)
    episodes = source.episodes()
    assert not decoded
    frames = source.read(episodes[0])
    for count in (1, 2, 3):
        next(frames)
        assert len(decoded) == 2 * count
    frames.close()


def test_neither_lerobot_nor_torch_is_imported(v21: Path, families: Path) -> None:
    code = (
        "import sys; from pathlib import Path\n"
        "from robomme_interference_data.build_dataset.sources.lerobot import LeRobotSource\n"
        f"source = LeRobotSource({str(v21)!r}, families_file=Path({str(families)!r}))\n"
        "list(source.read(source.episodes()[0]))\n"
        "print([name for name in ('lerobot', 'torch', 'datasets', 'PIL') if name in sys.modules])"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout == "[]\n"


def test_video_that_breaks_off(v3: Path, families: Path, tmp_path: Path) -> None:
    root = shutil.copytree(v3, tmp_path / "copy")
    path = root / "meta/episodes/chunk-000/file-000.parquet"
    # The second episode would now end after the file does.
    change_column(path, "videos/observation.images.wrist/from_timestamp", [0.0, 2.2, 2.1])
    source = LeRobotSource(str(root), families_file=families)
    with pytest.raises(SourceError, match=r"InsertPeg/train/0: .*the video ends before frame 28"):
        list(source.read(source.episodes()[2]))
