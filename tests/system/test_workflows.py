"""Workflows need no secret, and publish only the version that is tagged; scripts can be run."""

import os
import re
import stat
import subprocess
from typing import Any

import pytest
import yaml
from support.package import CONFIG, ROOT

WORKFLOWS = ROOT / ".github" / "workflows"
VERSION = CONFIG["project"]["version"]


def workflow(name: str) -> dict[Any, Any]:
    loaded: dict[Any, Any] = yaml.safe_load((WORKFLOWS / f"{name}.yml").read_text("utf-8"))
    return loaded


@pytest.mark.parametrize("path", sorted(WORKFLOWS.iterdir()), ids=lambda path: path.stem)
def test_workflow_needs_no_secret_and_only_read_access(path: Any) -> None:
    assert not re.search(r"secrets|password|token(?!: write)", path.read_text("utf-8"))
    assert workflow(path.stem)["permissions"] == {"contents": "read"}


@pytest.mark.parametrize(("tag", "passes"), [(f"v{VERSION}", True), (f"v{VERSION}.1", False)])
def test_tag_must_be_the_version(tag: str, passes: bool) -> None:
    steps = workflow("publish")["jobs"]["build"]["steps"]
    command = next(step["run"] for step in steps if "run" in step)
    environment = os.environ | {"GITHUB_REF_NAME": tag}
    done = subprocess.run(["bash", "-ec", command], cwd=ROOT, env=environment, check=False)
    assert (done.returncode == 0) is passes


@pytest.mark.parametrize("name", [".ci/run", "scripts/setup.sh", "scripts/system_packages.sh"])
def test_shell_script_is_executable_and_parses(name: str) -> None:
    assert (ROOT / name).stat().st_mode & stat.S_IXUSR
    subprocess.run(["bash", "-n", str(ROOT / name)], check=True)
