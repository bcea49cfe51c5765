"""`scripts/official_set.sh`, whole: shards, a kill, the merge, all checks and a publication."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from huggingface_hub import constants
from support.make_plans import planned

from robomme_interference_data.build_dataset.verify.reference import read_plan, write_plan
from robomme_interference_data.simulators.registry import simulator_renderer
from robomme_interference_data.storage.files import all_files

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "scripts" / "official_set.sh"
QUERY = "PatternLock/test/0"
BUILD = (
    *("--source", "tabletop", "--split", "test", "--families", "PatternLock", "--episodes", "0"),
    *("--unit-episodes", "0", "--cameras", "front", "--conditions", "k0,k1", "--workers", "1"),
)


def official_set(*words: object, **environment: str) -> subprocess.Popen[str]:
    """Start the script, in a group of processes of its own."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.Popen(
        [str(SCRIPT), *map(str, words)],
        env=os.environ | {"PATH": path} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def finished(*words: object, **environment: str) -> str:
    """Run the script; return what it printed for people."""
    process = official_set(*words, **environment)
    _, err = process.communicate(timeout=900)
    assert process.returncode == 0, err
    return err


def test_wrong_words_are_one_error_each(tmp_path: Path) -> None:
    for words, message in (
        ((), "expected a plan and a folder"),
        (("offical", tmp_path / "out"), "there is no plan offical"),
        (("official", tmp_path / "out", "--shard"), "--shard has no value"),
        (("official", tmp_path / "out", "--workers", 2), "unknown option --workers"),
    ):
        process = official_set(*words)
        _, err = process.communicate(timeout=60)
        assert process.returncode == 1 and message in err.splitlines()[0]
        assert len(err.splitlines()) == 2 and not (tmp_path / "out").exists()


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_set_is_built_in_shards_checked_and_published(
    tmp_path: Path, hub: Any, login: Any
) -> None:
    """The smallest: a query of the tutorial and its units, whose frames its plan knows."""
    pytest.importorskip("mani_skill", reason="needs the extra sim")
    if simulator_renderer("tabletop") is None:
        pytest.skip("needs a Vulkan driver")
    plan, folder = tmp_path / "plan.json", tmp_path / "set"
    tutorial = read_plan("tutorial")
    used = [
        episode
        for episode in tutorial.episodes
        if episode.dataset == "distractors"
        or (episode.dataset == "demonstrations" and str(episode.episode) == QUERY)
    ]
    smaller = replace(tutorial, episodes=tuple(used), conditions=("k0", "k1"))
    write_plan(planned(smaller, tmp_path / "planned"), plan)

    killed = official_set(plan, folder, "--shard", "1/2", "--", *BUILD)
    shard = folder / "shards" / "1-of-2"
    deadline = time.monotonic() + 600
    while not (records := recorded(shard)) and time.monotonic() < deadline:
        assert killed.poll() is None
        time.sleep(0.2)
    os.killpg(killed.pid, signal.SIGKILL)
    killed.communicate()
    finished(plan, folder, "--shard", "1/2", "--", *BUILD)
    assert records.items() <= recorded(shard).items()  # not recorded again
    finished(plan, folder, "--shard", "2/2", "--", *BUILD)

    err = finished(plan, folder, "--", *BUILD)
    assert f"Equal to the plan {plan}" in err and "No leaks." in err
    assert "nothing is published" in err and not hub.repositories
    assert (folder / "card.md").read_text().startswith("---\n")

    login("my-name")
    environment = {
        "HF_ENDPOINT": hub.endpoint,
        "HF_HUB_OFFLINE": "0",
        "HF_HUB_DISABLE_IMPLICIT_TOKEN": "0",
        "HF_HUB_CACHE": constants.HF_HUB_CACHE,
    }
    before = all_files(folder / "buffers")
    finished(plan, folder, "--publish", "my-name/tiny", "--", *BUILD, **environment)
    names = sorted(hub.repositories)
    assert [name.rpartition("/")[2] for name in names] == ["tiny", "tiny-demonstrations"]
    assert all_files(folder / "buffers") == before


def recorded(shard: Path) -> dict[Path, int]:
    """Return the staged episodes of a shard, with the times of their records."""
    records = (shard / "staged").glob("*/*/record.json")
    return {path: path.stat().st_mtime_ns for path in records}
