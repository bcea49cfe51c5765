"""A new buffer set for demonstrations on a Hub: built, loaded, indexed and verified."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import GOLDEN, contents
from support.hub import BASE, push_buffer_set, running_hub
from support.hub_server import HubServer
from support.recordings import make_episode, rows_of, write_images, write_table
from support.tabletop import copy_tabletop

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set

FAMILIES = ("MyDrawer", "MyCup")


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    with running_hub(tmp_path / "cache", monkeypatch) as server:
        push_buffer_set(server, GOLDEN, tmp_path / "work")
        yield server


@pytest.fixture
def mine(tmp_path: Path) -> str:
    """Recordings of another robot, as a frames folder."""
    rows = []
    for number, family in enumerate(FAMILIES):
        name, episode = f"{family}/train/0", make_episode(number, 249, size=(32, 32), actions=False)
        for camera, images in episode.images.items():
            write_images(tmp_path / f"mine/images/{camera}/{name}", images)
        rows += rows_of(name, episode, is_demo=[False] * 249, fps=10)
    write_table(tmp_path / "mine", rows)
    return f"frames:{tmp_path / 'mine'}"


@pytest.mark.slow
def test_a_buffer_set_for_published_demonstrations(
    hub: HubServer, mine: str, tmp_path: Path, run: Any
) -> None:
    out = tmp_path / "own"
    given = ("--demonstrations", BASE, "--source", mine, "--workers", 1)
    code, _, err = run("build", out, *given, "--conditions", "k0,k1,k2")
    assert code == 0, err
    assert "--audit" in err
    buffer_set = load_buffer_set(out)
    assert (
        buffer_set.header.datasets["demonstrations"].location
        == buffer_set.dataset_files("demonstrations").location
    )
    buffer = buffer_set.load("MoveCube/test/0", "k2", verify=True)
    assert {one.family for one in buffer.sessions[1:]} == {*FAMILIES}
    lesson = load_buffer_set(GOLDEN).load("MoveCube/test/0", "k0")
    assert np.array_equal(buffer.frames()[: len(lesson)], lesson.frames())
    assert [*verify_buffer_set(buffer_set)] == []
    # Again: nothing changes. With other units: a question, as planned buffers would get others.
    made = contents(out)
    assert run("build", out, *given)[0] == 0
    assert contents(out) == made
    assert run("build", out, *given[2:])[0] == 0  # its buffers name the demonstrations
    assert contents(out) == made
    code, _, err = run("build", out, *given[:2], "--source", "sample:Cup,Box")
    assert code == 1 and "k1, k2" in err and "--yes" in err
    assert contents(out) == made
    assert run("build", out, "--only", "manifests", "--drop", "k2", "--yes")[0] == 0
    assert load_buffer_set(out).conditions == ("k0", "k1")


@pytest.mark.slow
def test_a_buffer_set_for_demonstrations_in_a_folder(mine: str, tmp_path: Path, run: Any) -> None:
    """The demonstrations are copied, stay unchanged, and are exported with the buffer set."""
    base = shutil.copytree(GOLDEN / "demonstrations", tmp_path / "base/demonstrations")
    before = {path: path.read_bytes() for path in base.rglob("*") if path.is_file()}
    out, export = tmp_path / "own", tmp_path / "export"
    given = ("--demonstrations", base, "--source", mine, "--workers", 1, "--conditions", "k0,k2")
    assert run("build", out, *given)[0] == 0
    assert run("build", out, *given)[0] == 0  # again: nothing to add
    assert run("verify", out)[0] == 0
    publish = ("--repo-id", "me/own", "--to", export)
    assert run("publish", out, *publish)[0] == 0
    local = load_buffer_set(out).load("MoveCube/test/0", "k2", verify=True)
    exported = load_buffer_set(export).load("MoveCube/test/0", "k2", verify=True)
    assert np.array_equal(local.frames(), exported.frames())
    assert {path: path.read_bytes() for path in base.rglob("*") if path.is_file()} == before
    assert not (out / "demonstrations").is_symlink()  # it would lead out of the buffer set
    other = copy_tabletop(tmp_path / "other") / "demonstrations"
    code, _, err = run("build", out, *given, "--demonstrations", other)
    assert code == 1 and "exists, and is not a copy of" in err


@pytest.mark.slow
def test_retrieval_on_published_demonstrations(
    hub: HubServer, mine: str, tmp_path: Path, run: Any
) -> None:
    """The demonstrations have an index already, so only the added units are embedded."""
    indexed = shutil.copytree(GOLDEN / "demonstrations", tmp_path / "base/demonstrations")
    assert run("index", indexed)[0] == 0
    commit, out = hub.push(f"datasets/{BASE}", indexed), tmp_path / "own"
    given = ("--demonstrations", BASE, "--source", mine, "--workers", 1)
    assert run("build", out, *given, "--conditions", "k0,k2")[0] == 0
    code, printed, err = run("index", out)
    report = f"{out}/distractors/index/thumbnail: 64 frames, 64 embedded now\n"
    assert (code, printed) == (0, report)
    assert f"{BASE}@{commit} has embeddings by the same encoder" in err
    assert [*verify_buffer_set(load_buffer_set(out))] == []

    local = shutil.copytree(out, tmp_path / "local", ignore=shutil.ignore_patterns("index"))
    shutil.copytree(GOLDEN / "demonstrations", local / "demonstrations")
    assert run("index", local)[0] == 0
    for condition in ("k0", "k2"):
        far, near = (
            load_buffer_set(one).load("MoveCube/test/0", condition) for one in (out, local)
        )
        assert np.array_equal(far.embeddings("thumbnail"), near.embeddings("thumbnail"))
    results = [run("retrieve", one, "MoveCube/test/0", "k2", "--json") for one in (out, local)]
    assert results[0][:2] == results[1][:2] and results[0][0] == 0


@pytest.mark.slow
def test_published_demonstrations_without_an_index(
    hub: HubServer, mine: str, tmp_path: Path, run: Any, offline: Any
) -> None:
    out = tmp_path / "own"
    given = ("--demonstrations", BASE, "--source", mine, "--workers", 1)
    assert run("build", out, *given, "--conditions", "k1")[0] == 0
    code, _, err = run("index", out)
    assert code == 0 and "retrieval will not find the demonstrations" in err
    assert run("retrieve", out, "MoveCube/test/0", "k1")[0] == 1
    (download,) = (line.split() for line in err.splitlines() if line.startswith("  "))
    subprocess.run(
        [Path(sys.executable).parent / download[0], *download[1:]],
        env={**os.environ, "HF_ENDPOINT": hub.endpoint, "HF_HUB_OFFLINE": "0"},
        check=True,
        capture_output=True,
    )
    assert run("index", out)[0] == 0
    assert run("retrieve", out, "MoveCube/test/0", "k1")[0] == 0
    assert [*verify_buffer_set(load_buffer_set(out))] == []
    shutil.rmtree(out / "demonstrations")
    offline()
    code, _, err = run("index", out)
    assert code == 0 and "cannot check" in err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--demonstrations", str(GOLDEN / "distractors")], "not of distractors"),
        (["--demonstrations", "nobody/nothing"], "dataset repository 'nobody/nothing'"),
        (["--demonstrations", BASE, "--conditions", "k3"], "needs 3 distractor units"),
    ],
)
def test_invalid_new_buffer_sets(
    options: list[str], words: str, hub: HubServer, mine: str, tmp_path: Path, run: Any
) -> None:
    out = tmp_path / "own"
    given = ("--source", mine, "--workers", 1)
    code, _, err = run("build", out, *given, "--conditions", "k1", *options)
    assert code == 1 and words in err
    assert not (out / "distractors").exists()
