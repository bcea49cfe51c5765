"""Publish with all checks and real cards, after a kill; LeRobot opens what was published."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from support.hub_server import HubServer, User
from support.publishing import LESSONS, UNITS, files, tags
from support.splits import GOLDEN, contents, stored_frames

from robomme_interference_data import load_split
from robomme_interference_data.cards.checks import open_with_lerobot
from robomme_interference_data.errors import PublishError

COMMAND = Path(sys.executable).parent / "robomme-interference"
ASKED = (COMMAND, "publish", GOLDEN, "--repo-id", UNITS, "--yes", "--json")


@pytest.fixture
def publishing(hub: HubServer, tmp_path: Path) -> Callable[[], subprocess.Popen[str]]:
    """Start the command in a process of its own."""
    hub.tokens["hf_someone"] = User("someone")
    own = {"HF_ENDPOINT": hub.endpoint, "HF_TOKEN": "hf_someone", "HF_HUB_OFFLINE": "0"}
    own |= {"HF_HUB_DISABLE_IMPLICIT_TOKEN": "0", "HF_HOME": str(tmp_path / "home")}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return lambda: subprocess.Popen(ASKED, env=os.environ | own, **pipes)  # type: ignore[call-overload]


def test_publish_after_a_kill(
    hub: HubServer, publishing: Callable[[], subprocess.Popen[str]], tmp_path: Path
) -> None:
    reached, killed = threading.Event(), threading.Event()

    def hold() -> None:
        reached.set()
        killed.wait(60)

    hub.fault("PUT", "/store/datasets/someone/tiny/", after=20, call=hold)
    first = publishing()
    assert reached.wait(240)
    first.kill()
    first.communicate(timeout=60)
    killed.set()
    assert tags(hub, UNITS) == {}
    sent = hub.uploads()
    second = publishing()
    out, err = second.communicate(timeout=240)
    assert second.returncode == 0, err
    lessons = json.loads(out)[0]
    assert (lessons["sent_files"], lessons["commit"]) == (0, tags(hub, LESSONS)["data-1.0.0"])
    again = hub.uploads()[len(sent) :]
    assert len(sent) > 20 and again and not {*again} & {*sent}
    for name, repo_id in (("demonstrations", LESSONS), ("distractors", UNITS)):
        held = contents(GOLDEN / name)
        found = files(hub, repo_id, "data-1.0.0")
        assert {path: found[path] for path in held} == held
    assert load_split(UNITS, revision="data-1.0.0").revision == load_split(GOLDEN).revision
    opened_by_lerobot(tmp_path)


def opened_by_lerobot(home: Path) -> None:
    """LeRobot finds both repositories by name and tag, and its frames are the recorded ones."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    for repo_id, name in ((LESSONS, "demonstrations"), (UNITS, "distractors")):
        opened = LeRobotDataset(repo_id, root=home / name, video_backend="pyav", return_uint8=True)
        record = next(iter(load_split(GOLDEN).datasets[name].records()))
        frame = opened[3]["observation.images.front"].numpy().transpose(1, 2, 0)
        assert np.array_equal(frame, stored_frames(name, record.episode_id, "front")[3])


def test_lerobot_cannot_open_anything(tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text("{}")
    with pytest.raises(PublishError, match="LeRobot cannot open"):
        open_with_lerobot("distractors", tmp_path)
