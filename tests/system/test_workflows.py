"""Workflows need no secret, and publish what `make release` made of a tag; scripts can be run."""

import re
import stat
import subprocess
from typing import Any

import pytest
import yaml
from support.package import ROOT

WORKFLOWS = ROOT / ".github" / "workflows"


def workflow(name: str) -> dict[Any, Any]:
    loaded: dict[Any, Any] = yaml.safe_load((WORKFLOWS / f"{name}.yml").read_text("utf-8"))
    return loaded


@pytest.mark.parametrize("path", sorted(WORKFLOWS.iterdir()), ids=lambda path: path.stem)
def test_workflow_needs_no_secret_and_only_read_access(path: Any) -> None:
    assert not re.search(r"secrets|password|token(?!: write)", path.read_text("utf-8"))
    assert workflow(path.stem)["permissions"] == {"contents": "read"}


def test_what_is_published_is_what_the_release_made_of_the_tag() -> None:
    jobs = workflow("publish")["jobs"]
    commands = [step["run"] for step in jobs["build"]["steps"] if "run" in step]
    assert commands == ['make release VERSION="${GITHUB_REF_NAME#v}"']
    assert jobs["publish"]["needs"] == "build"
    assert jobs["build"]["container"] == workflow("ci")["jobs"]["checks"]["container"]


SCRIPTS = [".ci/run", *(f"scripts/{path.name}" for path in (ROOT / "scripts").glob("*.sh"))]


@pytest.mark.parametrize("name", SCRIPTS)
def test_shell_script_is_executable_and_parses(name: str) -> None:
    assert (ROOT / name).stat().st_mode & stat.S_IXUSR
    subprocess.run(["bash", "-n", str(ROOT / name)], check=True)
