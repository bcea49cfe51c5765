"""Publish with all checks and real cards, and after a kill; LeRobot opens what was published."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.buffer_sets import GOLDEN, contents, stored_frames
from support.hub import elsewhere, kill_at
from support.hub_server import HubServer
from support.publishing import LESSONS, UNITS, files, publish, tags

from robomme_interference_data import load_buffer_set

PUBLISH = """
from support.publishing import publish
from support.buffer_sets import GOLDEN

publish(GOLDEN)
"""


LOAD = """
import json, sys
from datasets import load_dataset

for name in ("buffers", "episodes"):
    [(split, rows)] = load_dataset(sys.argv[1], name).items()
    print(json.dumps([name, split, rows["episode_id"][:2], len(rows)]))
"""


@pytest.fixture(autouse=True)
def _somebody(login: Callable[..., None]) -> None:
    login("someone")


@pytest.mark.slow
def test_what_was_published_is_opened_by_lerobot(
    hub: HubServer, run: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    code, out, err = run("publish", GOLDEN, "--repo-id", UNITS, "--yes", "--json")
    assert code == 0, err
    assert [one["repo_id"] for one in json.loads(out)] == [LESSONS, UNITS]
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    for repo_id, name in ((LESSONS, "demonstrations"), (UNITS, "distractors")):
        opened = LeRobotDataset(repo_id, root=tmp_path / name, video_backend="pyav")
        record = next(iter(load_buffer_set(GOLDEN).datasets[name].records()))
        frame = opened[3]["observation.images.front"].numpy().transpose(1, 2, 0)
        stored = stored_frames(name, record.episode_id, "front")[3]
        assert np.array_equal(np.round(frame * 255).astype(np.uint8), stored)


@pytest.mark.slow
def test_publish_after_a_kill(hub: HubServer) -> None:
    kill_at(hub, "PUT", "/store/datasets/someone/tiny/", 20, PUBLISH)
    assert tags(hub, UNITS) == {}
    before = len(hub.uploads())
    lessons, _ = publish(GOLDEN)
    assert not lessons.difference
    sent = hub.uploads()
    assert 20 < before < len(sent) == len(set(sent))  # no large file twice
    for name, repo_id in (("demonstrations", LESSONS), ("distractors", UNITS)):
        held = contents(GOLDEN / name)
        found = files(hub, repo_id, "data-1.0.0")
        assert {path: found[path] for path in held} == held
    assert (
        load_buffer_set(UNITS, revision="data-1.0.0").revision == load_buffer_set(GOLDEN).revision
    )


@pytest.mark.slow
def test_its_tables_are_loaded_by_name(hub: HubServer) -> None:
    publish(GOLDEN)
    with elsewhere(hub, LOAD, UNITS) as process:
        out, _ = process.communicate(timeout=120)
    assert [json.loads(line) for line in out.splitlines()] == [
        ["buffers", "test", ["VideoRepick/test/0"] * 2, 15],
        ["episodes", "train", ["VideoRepick/train/0", "VideoPlaceOrder/train/0"], 17],
    ]
