"""A split of one's own for demonstrations on a Hub: built, published layout aside, and loaded."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.hub import BASE, push_split, running_hub
from support.hub_server import HubServer
from support.recordings import make_episode, rows_of, write_images, write_table
from support.splits import GOLDEN

from robomme_interference_data import load_split
from robomme_interference_data.build_dataset.verify import verify_split

FAMILIES = ("MyDrawer", "MyCup")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    with running_hub(tmp_path / "cache", monkeypatch) as server:
        push_split(server, GOLDEN, tmp_path / "work")
        yield server


@pytest.fixture
def mine(tmp_path: Path) -> str:
    """Recordings of another robot, as a frames folder."""
    rows = []
    for number, family in enumerate(FAMILIES):
        name, episode = f"{family}/train/0", make_episode(number, 249, size=(32, 32), actions=False)
        for camera, images in episode.images.items():
            write_images(tmp_path / f"mine/images/{camera}/{name}", images)
        rows += rows_of(name, episode, is_demo=[False] * 249)
    write_table(tmp_path / "mine", rows)
    return f"frames:{tmp_path / 'mine'}"


def test_a_split_for_published_demonstrations(
    hub: HubServer, mine: str, tmp_path: Path, run: Any
) -> None:
    out = tmp_path / "own"
    given = ("--demonstrations", BASE, "--source", mine, "--out", out, "--workers", 1)
    code, _, err = run("new-split", *given, "--conditions", "k0,k1,k2")
    assert code == 0, err
    assert "publish" in err
    split = load_split(out)
    assert split.header.datasets["demonstrations"].place == split.place("demonstrations").location
    buffer = split.load("MoveCube/test/0", "k2", verify=True)
    assert {one.family for one in buffer.sessions[1:]} == {*FAMILIES}
    lesson = load_split(GOLDEN).load("MoveCube/test/0", "k0")
    assert np.array_equal(buffer.frames()[: len(lesson)], lesson.frames())
    assert [*verify_split(split)] == []


def test_retrieval_on_published_demonstrations(
    hub: HubServer, mine: str, tmp_path: Path, run: Any
) -> None:
    """Their index is their own: units that somebody else adds are all that has to be embedded."""
    indexed = shutil.copytree(GOLDEN / "demonstrations", tmp_path / "base/demonstrations")
    assert run("index", indexed)[0] == 0
    commit, out = hub.push(f"datasets/{BASE}", indexed), tmp_path / "own"
    given = ("--demonstrations", BASE, "--source", mine, "--out", out, "--workers", 1)
    assert run("new-split", *given, "--conditions", "k0,k2")[0] == 0
    code, told, err = run("index", out)
    assert (code, told) == (0, f"{out}/distractors/index/thumbnail: 64 frames, 64 embedded now\n")
    assert f"{BASE}@{commit} has embeddings by the same encoder" in err
    assert [*verify_split(load_split(out))] == []

    local = shutil.copytree(out, tmp_path / "local", ignore=shutil.ignore_patterns("index"))
    shutil.copytree(GOLDEN / "demonstrations", local / "demonstrations")
    assert run("index", local)[0] == 0
    for condition in ("k0", "k2"):
        far, near = (load_split(one).load("MoveCube/test/0", condition) for one in (out, local))
        assert np.array_equal(far.embeddings("thumbnail"), near.embeddings("thumbnail"))
    said = [
        run("retrieve", "MoveCube/test/0", "k2", "--split", split, "--json")
        for split in (out, local)
    ]
    assert said[0][:2] == said[1][:2] and said[0][0] == 0


def test_published_demonstrations_without_an_index(
    hub: HubServer, mine: str, tmp_path: Path, run: Any, offline: Any
) -> None:
    out = tmp_path / "own"
    given = ("--demonstrations", BASE, "--source", mine, "--out", out, "--workers", 1)
    assert run("new-split", *given, "--conditions", "k1")[0] == 0
    code, _, err = run("index", out)
    assert code == 0 and "retrieval will not find the demonstrations" in err
    assert run("retrieve", "MoveCube/test/0", "k1", "--split", out)[0] == 1
    (download,) = (line.split() for line in err.splitlines() if line.startswith("  "))
    subprocess.run(
        [Path(sys.executable).parent / download[0], *download[1:]],
        env={**os.environ, "HF_ENDPOINT": hub.endpoint, "HF_HUB_OFFLINE": "0"},
        check=True,
        capture_output=True,
    )
    assert run("index", out)[0] == 0
    assert run("retrieve", "MoveCube/test/0", "k1", "--split", out)[0] == 0
    assert [*verify_split(load_split(out))] == []
    shutil.rmtree(out / "demonstrations")
    offline()
    code, _, err = run("index", out)
    assert code == 0 and "cannot be told" in err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--demonstrations", str(GOLDEN / "demonstrations")], "published"),
        (["--demonstrations", "someone/units"], "published"),
        (["--demonstrations", "nobody/nothing"], "there is no dataset repository"),
        (["--demonstrations", BASE, "--conditions", "k3"], "needs 3 distractor units"),
        (["--demonstrations", BASE, "--conditions", "raw-k1"], "needs the dataset distractors-raw"),
        (["--demonstrations", BASE, "--cameras", "side"], "side"),
    ],
)
def test_what_makes_no_split(
    options: list[str], words: str, hub: HubServer, mine: str, tmp_path: Path, run: Any
) -> None:
    out = tmp_path / "own"
    given = ("--source", mine, "--out", out, "--workers", 1)
    code, _, err = run("new-split", *given, "--conditions", "k1", *options)
    assert code == 1 and words in err
    assert not (out / "distractors").exists()
