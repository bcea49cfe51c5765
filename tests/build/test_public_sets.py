"""Real robots' recordings in the layouts of public sets, all the way to a policy."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.hub_server import HubServer
from support.public_sets import SETS, STATELESS, PublicSet, write_public_set

from robomme_interference_data import load_buffer, load_buffer_set
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.training import HistoryDataset

LENGTHS = (9, 8, 7)
TASKS = ("Open the drawer.", "Open the drawer.", "stack the cups")
NAMES = """episode_index,family,split,exec_start_idx
0,OpenDrawer,test,6
1,OpenDrawer,test,5
2,StackCups,train,0
"""
SMALL = ("--unit", "4x2", "--workers", "1")


@pytest.mark.slow
@pytest.mark.parametrize("name", SETS)
def test_from_recordings_to_a_policy(name: str, tmp_path: Path, run: Any) -> None:
    layout = SETS[name]
    source = write_public_set(tmp_path / name, layout, LENGTHS, TASKS)
    names, root = tmp_path / "names.csv", tmp_path / "buffers"
    names.write_text(NAMES)
    given = [f"{logical}={column}" for logical, column in layout.columns.items()]
    options = ["--columns", ",".join(given)] if given else []
    code, _, err = run(
        *("build", root, "--source", f"lerobot:{source}", "--families-from", names),
        *("--split", "test", "--conditions", "no-history,k0,k1", "--with", "executions"),
        *("--set", "codec=lerobot-default", *SMALL, *options),
    )
    assert code == 0, err
    code, out, err = run("verify", root)
    assert code == 0, out + err
    buffer = load_buffer("OpenDrawer/test/0", "k1", buffer_set=root)
    assert buffer.states.shape == (6 + 4, layout.state)
    assert tuple(buffer.cameras) == layout.cameras
    opened = load_buffer_set(root)
    assert opened.datasets["demonstrations"].fps == layout.fps
    assert not buffer.manifest.exact
    code, _, err = run(
        *("evaluate", root, "--offline", "--policy", "hold", "--conditions", "no-history"),
        *("--out", tmp_path / "run", "--workers", "1"),
    )
    assert code == 0, err


def test_recordings_without_states(tmp_path: Path, run: Any) -> None:
    source = write_public_set(tmp_path / "top", STATELESS, LENGTHS, TASKS)
    names, root = tmp_path / "names.csv", tmp_path / "buffers"
    names.write_text(NAMES)
    options = ("--source", f"lerobot:{source}", "--families-from", names, "--split", "test")
    options += ("--conditions", "no-history,k0,k1", "--with", "executions", *SMALL)
    code, _, err = run("build", root, *options)
    assert code == 0 and err.count("without robot states") == 3, err
    for check in ((), ("--audit",)):
        code, out, err = run("verify", root, *check)
        assert code == 0, out + err
    buffer = load_buffer("OpenDrawer/test/0", "k1", buffer_set=root, verify=True)
    assert buffer.states.shape == (10, 0) and buffer.states.dtype == np.float32
    assert buffer.query.state().shape == (0,)
    assert buffer.frames("top").shape == (10, 64, 96, 3)
    units = load_buffer_set(root).datasets["distractors"]
    assert "observation.state" not in units.lerobot.features
    code, _, err = run("build", root, *options)  # again: nothing to add
    assert code == 0, err
    offline = ("evaluate", root, "--offline", "--policy", "hold", "--workers", "1")
    code, _, err = run(*offline, "--out", tmp_path / "run")
    assert code == 0, err
    code, out, err = run("card", root)
    assert code == 0 and "no robot states" in out, err
    history = HistoryDataset(
        root, ["k1"], split="test", memory="framesamp:4", chunk=2, cache=tmp_path / "cache"
    )
    item = history[0]
    assert item["observation.state"].shape == (0,)
    assert item["memory.state"].shape == (3, 0)


@pytest.mark.slow
@pytest.mark.parametrize(("layout", "size"), [(STATELESS, 0), (SETS["hsr"], 8)])
def test_recordings_are_published(
    layout: PublicSet, size: int, tmp_path: Path, run: Any, hub: HubServer, login: Any
) -> None:
    login("someone")
    source = write_public_set(tmp_path / "top", layout, LENGTHS, TASKS)
    names, root = tmp_path / "names.csv", tmp_path / "buffers"
    names.write_text(NAMES)
    options = ("--source", f"lerobot:{source}", "--families-from", names, "--split", "test")
    given = [f"{logical}={column}" for logical, column in layout.columns.items()]
    options += ("--columns", ",".join(given)) if given else ()
    code, _, err = run("build", root, *options, "--conditions", "no-history,k0,k1", *SMALL)
    assert code == 0, err
    code, out, err = run("publish", root, "--repo-id", "someone/real", "--license", "mit", "--yes")
    assert code == 0, out + err
    mine = load_buffer("OpenDrawer/test/0", "k1", buffer_set=root)
    theirs = load_buffer("OpenDrawer/test/0", "k1", buffer_set="someone/real", verify=True)
    assert theirs.states.shape == (10, size)
    assert np.array_equal(theirs.states, mine.states)
    for camera in layout.cameras:
        assert np.array_equal(theirs.frames(camera), mine.frames(camera))


def test_units_by_task_for_other_demonstrations(tmp_path: Path, run: Any) -> None:
    source = write_public_set(tmp_path / "set", STATELESS, (9, 9, 9), ("a", "Stack cups.", "a"))
    root, options = tmp_path / "buffers", ("--source", f"lerobot:{source}", *SMALL)
    only = ("--only", "distractors")
    code, _, err = run("build", root, *only, *options, "--families-from", "task")
    assert code == 0, err
    units = load_dataset(root / "distractors")
    assert [source["families_from"] for source in units.identity.sources] == ["task"]
    ids = [str(one.episode_id) for one in units.records()]
    assert ids == ["A/train/0", "A/train/1", "StackCups/train/0"]


def test_one_family_for_a_dataset(tmp_path: Path, run: Any) -> None:
    source = write_public_set(tmp_path / "so100_pick", STATELESS, (9, 9), ("a", "b"))
    root, options = tmp_path / "buffers", ("--source", f"lerobot:{source}", *SMALL)
    code, _, err = run(
        "build", root, "--only", "distractors", *options, "--families-from", "dataset"
    )
    assert code == 0, err
    ids = [str(one.episode_id) for one in load_dataset(root / "distractors").records()]
    assert ids == ["So100Pick/train/0", "So100Pick/train/1"]


def load_dataset(folder: Path) -> Any:

    return Dataset(LocalFiles(folder))
