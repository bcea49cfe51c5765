"""The versions installed in RoboMME's interpreter, where this runs as a program of its own."""

import importlib.metadata
import json
import platform
import subprocess
import sys
import urllib.parse
import urllib.request
from pathlib import Path


def installed_versions() -> dict[str, str]:
    """Return the versions in this interpreter, with the commit where it is known."""
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
    return versions


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


if __name__ == "__main__":
    sys.stdout.write(json.dumps(installed_versions()))  # noqa: TID251 - a separate program
