"""The workflows call what is here, need no secret, and publish only the version that is tagged."""

import os
import re
import subprocess
from collections.abc import Iterator
from typing import Any

import pytest
import yaml
from support.package import CONFIG, ROOT

FOLDER = ROOT / ".github"
VERSION = CONFIG["project"]["version"]
NAMES = ("ci", "docs", "publish")


def workflow(name: str) -> dict[Any, Any]:
    loaded: dict[Any, Any] = yaml.safe_load((FOLDER / "workflows" / f"{name}.yml").read_text())
    return loaded


def steps(name: str) -> Iterator[dict[str, Any]]:
    for job in workflow(name)["jobs"].values():
        yield from job["steps"]


def commands(name: str) -> list[str]:
    return [step["run"] for step in steps(name) if "run" in step]


@pytest.mark.parametrize("name", NAMES)
def test_actions_are_pinned_by_major_version(name: str) -> None:
    used = [step["uses"] for step in steps(name) if "uses" in step]
    assert used and all(re.fullmatch(r"[\w-]+/[\w-]+@(release/)?v\d+", one) for one in used)


@pytest.mark.parametrize("name", NAMES)
def test_no_secret_is_needed_and_no_more_may_be_done_than_has_to_be(name: str) -> None:
    text = (FOLDER / "workflows" / f"{name}.yml").read_text(encoding="utf-8")
    assert not re.search(r"secrets|password|token(?!: write)", text)
    assert workflow(name)["permissions"] == {"contents": "read"}
    [checkout] = [step for step in steps(name) if "actions/checkout" in step.get("uses", "")]
    assert checkout["with"] == {"persist-credentials": False}


def test_every_change_passes_what_passes_here() -> None:
    assert commands("ci") == [".ci/run"]
    assert os.access(ROOT / ".ci" / "run", os.X_OK)
    # YAML reads the key `on` as true.
    assert workflow("ci")[True] == {"push": {"branches": ["main"]}, "pull_request": None}
    limits = re.findall(r"timeout --kill-after=30 (\d+)", (ROOT / ".ci" / "run").read_text())
    assert workflow("ci")["jobs"]["checks"]["timeout-minutes"] * 60 > sum(map(int, limits))


@pytest.mark.parametrize(
    ("tag", "passes"),
    [(f"v{VERSION}", True), (f"v{VERSION}.1", False), (VERSION[1:], False), ("v", False)],
)
def test_the_tag_must_be_the_version(tag: str, passes: bool) -> None:
    there = os.environ | {"GITHUB_REF_NAME": tag}
    done = subprocess.run(["bash", "-ec", commands("publish")[0]], cwd=ROOT, env=there, check=False)
    assert (done.returncode == 0) is passes
