"""LeRobot's own reader over our datasets: the same frames, vectors and tasks; and its metadata."""

import numpy as np
import pytest
from support.splits import GOLDEN, dataset, stored_frames, stored_states


@pytest.mark.parametrize("name", ["demonstrations", "distractors"])
def test_lerobot_reads_what_we_do(name: str) -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    theirs = LeRobotDataset(f"tests/{name}", root=GOLDEN / name, video_backend="pyav")
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


def test_episodes_can_be_selected_by_our_columns() -> None:
    from lerobot.datasets.lerobot_dataset import LeRobotDatasetMetadata

    meta = LeRobotDatasetMetadata("tests/distractors", root=GOLDEN / "distractors")
    chosen = meta.filter_episodes(lambda episode: episode["family"] == "PatternLock")
    assert [meta.episodes[index]["episode_id"] for index in chosen] == [
        "PatternLock/train/0",
        "PatternLock/train/1",
    ]
