"""The versions installed in RoboMME's interpreter, where this runs as a program of its own.

Its only argument is the folder for patched files, as that of `worker.py`.
"""

import importlib.metadata
import importlib.util
import json
import os
import platform
import subprocess
import sys
import urllib.parse
import urllib.request
from contextlib import suppress
from pathlib import Path
from typing import Any


def installed_versions(folder: Path) -> dict[str, str]:
    """Return the versions in this interpreter, with the commit where it is known, and the patches.

    `folder` is for patched files.
    """
    versions = {"robomme_python": platform.python_version()}
    for name in ("robomme", "mani_skill", "sapien", "torch", "numpy"):
        try:
            installed = importlib.metadata.distribution(name)
        except importlib.metadata.PackageNotFoundError:  # only on the path
            continue
        origin = json.loads(installed.read_text("direct_url.json") or "{}")
        commit = origin.get("vcs_info", {}).get("commit_id") or _commit(origin.get("url", ""))
        key = "robomme" if name == "robomme" else f"robomme_{name}"
        versions[key] = f"{installed.version}+{commit}" if commit else installed.version
    with suppress(Exception):  # the simulator's start reports why it cannot be patched
        versions["robomme_patches"] = ", ".join(_patches(folder)) or "none"
    return versions


def _patches(folder: Path) -> list[str]:
    """Return what is patched of the installed ManiSkill, which this imports."""
    place = Path(__file__).with_name("maniskill_patches.py")
    spec: Any = importlib.util.spec_from_file_location(place.stem, place)
    patches = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(patches)
    described: list[str] = patches.apply_patches(folder)
    return described


def _commit(url: str) -> str | None:
    """Return the commit of the checkout that a package was installed from, or None."""
    folder = urllib.request.url2pathname(urllib.parse.urlparse(url).path)
    if not url.startswith("file:") or not Path(folder, ".git").exists():
        return None
    describe = ["git", "describe", "--always", "--abbrev=40", "--dirty", "--exclude=*"]
    try:
        output = subprocess.check_output(describe, cwd=folder, stderr=subprocess.PIPE, timeout=20)
        return output.decode().strip()
    except (OSError, subprocess.SubprocessError):
        return None


def main() -> None:
    """Print the versions as JSON, and nothing else: ManiSkill prints to stdout."""
    answer = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    with answer:
        json.dump(installed_versions(Path(sys.argv[1])), answer)


if __name__ == "__main__":
    main()
