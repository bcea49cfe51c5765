"""LeRobot's own writer and reader: what it writes as a source, and what it reads of ours."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import GOLDEN, dataset, stored_frames, stored_states
from support.recordings import check_recording, make_episode

from robomme_interference_data.build_dataset.sources.lerobot.source import LeRobotSource
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.storage.lerobot.dataset import LeRobotFiles
from robomme_interference_data.storage.video.encode import CODECS, Codec


@pytest.fixture(scope="module")
def lerobot() -> Any:
    return pytest.importorskip("lerobot.datasets")


@pytest.mark.slow
@pytest.mark.parametrize("codec", CODECS.values(), ids=list(CODECS))
def test_codecs_are_those_that_lerobot_would_use(lerobot: Any, codec: Codec) -> None:
    from lerobot.configs.video import RGBEncoderConfig

    config = RGBEncoderConfig(vcodec=codec.vcodec, pix_fmt=codec.pix_fmt, **codec.settings)
    assert dict(codec.options) == config.get_codec_options(as_strings=True)
    assert (codec.vcodec, codec.pix_fmt) == (config.vcodec, config.pix_fmt)
    if codec.name == "lerobot-default":
        default = RGBEncoderConfig()
        assert (codec.vcodec, codec.pix_fmt) == (default.vcodec, default.pix_fmt)
        assert dict(codec.options) == default.get_codec_options(as_strings=True)


SIZE = (64, 64)  # the least that lerobot's default encoder takes
EPISODES = {
    "MoveCube/train/0": make_episode(1, 12, lesson=5, size=SIZE),
    "MoveCube/train/1": make_episode(2, 7, lesson=7, size=SIZE),
}


def write(root: Path, stored: str) -> None:
    """Write the episodes with lerobot: images in parquet, or video of a codec of ours."""
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets import LeRobotDataset

    kind = "image" if stored == "image" else "video"
    features: dict[str, Any] = {
        f"observation.images.{camera}": {
            "dtype": kind,
            "shape": (*SIZE, 3),
            "names": ["height", "width", "channels"],
        }
        for camera in ("front", "wrist")
    }
    for name in ("observation.state", "action"):
        features[name] = {"dtype": "float32", "shape": (8,), "names": None}
    features["is_demo"] = {"dtype": "bool", "shape": (1,), "names": None}
    encoder = {}
    if kind == "video":
        codec = CODECS[stored]
        settings = {"vcodec": codec.vcodec, "pix_fmt": codec.pix_fmt, **codec.settings}
        encoder = {"rgb_encoder": RGBEncoderConfig(**settings)}
    made = LeRobotDataset.create(
        "test/small", 10, features, root=root, use_videos=kind == "video", **encoder
    )
    for episode in EPISODES.values():
        for step in range(len(episode)):
            images = {f"observation.images.{n}": i[step] for n, i in episode.images.items()}
            assert episode.action is not None
            vectors = {"observation.state": episode.state[step], "action": episode.action[step]}
            shown = {"is_demo": np.array([step < episode.lesson])}
            made.add_frame({**images, **vectors, **shown, "task": episode.goal})
        made.save_episode()
    made.finalize()


@pytest.mark.slow
@pytest.mark.parametrize("stored", ["image", "av1-lossless", "lerobot-default"])
def test_a_dataset_of_lerobots_is_read_as_lerobot_does(
    lerobot: Any, tmp_path: Path, stored: str
) -> None:
    root, names = tmp_path / "dataset", tmp_path / "families.csv"
    write(root, stored)
    names.write_text("episode_index,family\n0,MoveCube\n1,MoveCube\n")
    source = LeRobotSource(str(root), families_from=str(names))
    theirs = lerobot.LeRobotDataset("test/small", root=root, video_backend="pyav")
    row = 0
    for episode in source.episodes():
        recording = source.read(episode, None)
        assert recording.exact == (stored != "lerobot-default")
        if recording.exact:
            check_recording(source.read(episode, None), EPISODES[str(episode.id)])
        for frame in recording.frames:
            item = theirs[row]
            row += 1
            np.testing.assert_array_equal(frame.state, item["observation.state"].numpy())
            for camera, image in frame.images.items():
                pixels = (item[f"observation.images.{camera}"] * 255).round().byte()
                np.testing.assert_array_equal(image, pixels.permute(1, 2, 0).numpy())
    assert row == len(theirs)


@pytest.mark.slow
def test_what_lerobots_tools_delete_and_merge_is_read(lerobot: Any, tmp_path: Path) -> None:
    """They cut videos and put them together, and count the times in the files anew."""
    from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets

    write(tmp_path / "whole", "lerobot-default")
    whole = lerobot.LeRobotDataset("test/whole", root=tmp_path / "whole", video_backend="pyav")
    rest = delete_episodes(whole, [0], output_dir=tmp_path / "rest", repo_id="test/rest")
    merge_datasets([rest, whole], output_repo_id="test/merged", output_dir=tmp_path / "merged")
    theirs = lerobot.LeRobotDataset("test/merged", root=tmp_path / "merged", video_backend="pyav")
    ours = LeRobotFiles(LocalFiles(tmp_path / "merged"))
    assert [ours.locate(index).length for index in range(len(ours))] == [7, 12, 7]
    for camera in ours.video_features:
        assert [ours.locate_video(index, camera).first for index in range(3)] == [0, 7, 19]
        row = 0
        for index, length in enumerate((7, 12, 7)):
            ours.check_video(index, camera)
            for frame in ours.iter_frames(index, camera, 0, length):
                pixels = (theirs[row][camera] * 255).round().byte().permute(1, 2, 0)
                np.testing.assert_array_equal(frame, pixels.numpy())
                row += 1


@pytest.mark.parametrize("name", ["demonstrations", "distractors"])
def test_lerobot_reads_what_we_do(lerobot: Any, name: str) -> None:
    theirs = lerobot.LeRobotDataset(f"tests/{name}", root=GOLDEN / name, video_backend="pyav")
    ours = dataset(GOLDEN, name)
    records = list(ours.records())
    assert theirs.num_episodes == len(records)
    assert len(theirs) == sum(record.length for record in records)
    for record in records[:: max(1, len(records) // 4)]:
        row = theirs.meta.episodes[record.episode_index]
        assert row["episode_id"] == str(record.episode_id)
        assert row["feature_sha256"] == record.feature_sha256
        first = row["dataset_from_index"]
        states = stored_states(name, record.episode_id)
        for number in (0, 1, 15, 16, record.length - 1):
            item = theirs[first + number]
            for camera in ours.cameras:
                image = item[f"observation.images.{camera}"].numpy().transpose(1, 2, 0)
                expected = stored_frames(name, record.episode_id, camera)[number]
                np.testing.assert_array_equal((image * 255).round().astype(np.uint8), expected)
            np.testing.assert_array_equal(item["observation.state"].numpy(), states[number])
            assert item["task"] == record.goal
            assert item["frame_index"] == number
