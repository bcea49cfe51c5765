"""The sdist and the wheel, and the package indexes: the configured one, and one on loopback."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from support.package_index import PackageIndex

ROOT = Path(__file__).resolve().parents[1]


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
    quietly("build", "--no-isolation", "--outdir", str(folder), str(ROOT))


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
