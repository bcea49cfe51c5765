"""The sdist and the wheel, and the package indexes: the configured one, and one on loopback."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from support.package import committable
from support.package_index import PackageIndex

ROOT = Path(__file__).resolve().parents[1]

_RELATIVE_LINK = re.compile(r"(?<=]\()(?!https?:|#)[^)]+(?=\))")
_PICTURES = (".png", ".jpg", ".svg")


def configured_index() -> str:
    """Return the address of the package index that uv or pip is configured to use."""
    query = [sys.executable, "-m", "pip", "config", "get", "global.index-url"]
    configured = subprocess.run(query, capture_output=True, text=True, check=False).stdout.strip()
    found = os.environ.get("UV_DEFAULT_INDEX") or os.environ.get("PIP_INDEX_URL") or configured
    if not found:
        # No file of this repository names a registry: pip knows the one that it uses by default.
        from pip._internal.models.index import PyPI

        found = PyPI.simple_url
    return found.rstrip("/")


def build(folder: Path) -> None:
    """Build the sdist and, from it, the wheel, with the setuptools of `.venv`."""
    with tempfile.TemporaryDirectory(prefix="source-") as source:
        copy_source(Path(source))
        quietly("build", "--no-isolation", "--outdir", str(folder), source)


def copy_source(folder: Path) -> None:
    """Copy what distributions are built from: all that can be committed, with another README.

    An index shows the README without the files beside it: its links lead to the repository.
    """
    for name in committable():
        copy = folder / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, copy)
    readme = folder / "README.md"
    readme.write_text(absolute_links(readme.read_text(encoding="utf-8")), encoding="utf-8")


def absolute_links(text: str) -> str:
    """Let the relative links of a page lead to the repository at the tag of the version."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

    def absolute(link: re.Match[str]) -> str:
        kind = "raw" if link[0].endswith(_PICTURES) else "blob"
        return f"{project['urls']['Repository']}/{kind}/v{project['version']}/{link[0]}"

    return _RELATIVE_LINK.sub(absolute, text)


@contextmanager
def uploaded(folder: Path) -> Iterator[PackageIndex]:
    """Run a package index on loopback to which twine has uploaded the distributions of a folder."""
    files = [str(path) for path in sorted(folder.iterdir())]
    quietly("twine", "check", "--strict", *files)
    with PackageIndex().running() as index:
        index.passwords["rehearsal"] = "rehearsal"
        login = ("--username", "rehearsal", "--password", "rehearsal", "--non-interactive")
        quietly("twine", "upload", "--repository-url", index.legacy, *login, *files)
        yield index


def quietly(module: str, *arguments: str) -> None:
    """Run a module as a program, which prints only what goes wrong."""
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{module} {arguments[0]}: {done.stdout}{done.stderr}")
