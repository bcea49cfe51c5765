"""Set-up installs what is missing, once; a set-up that failed is repeated."""

import shutil
import stat
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# Stands in for Python, for its pip, and for the uv that it installs; notes how it is called.
FAKE_PYTHON = """#!/usr/bin/env bash
make_venv() { mkdir -p "$1/bin" && cp "$0" "$1/bin/python" && cp "$0" "$1/bin/uv"; }
case "$*" in
  "-m pip config"*) exit 1 ;;
  "-c "*|"-m pip --version") exit ;;
  "-m venv "*) make_venv "$3" ;;
  "pip sync"*) [[ -z ${UV_FAILS:-} ]] ;;
esac
status=$?
echo "$(basename "$0") $1 $2" >> "$LOG"
exit $status
"""
TOOLS = ("bash", "basename", "cat", "cmp", "cp", "dirname", "env", "grep", "head", "mkdir", "rm")
VENV, INSTALL = ["python3.12 -m venv"], ["python -m pip", "uv pip sync", "uv pip install"]


class Checkout:
    """A folder with the set-up script, in which only what it is given can be run."""

    def __init__(self, folder: Path):
        self.folder, self.log, self.bin = folder / "checkout", folder / "calls", folder / "bin"
        self.bin.mkdir()
        for name in TOOLS:
            (self.bin / name).symlink_to(shutil.which(name) or name)
        (self.bin / "python3.12").write_text(FAKE_PYTHON, encoding="utf-8")
        (self.bin / "python3.12").chmod(0o755)
        (self.folder / "scripts").mkdir(parents=True)
        shutil.copy(ROOT / "scripts" / "setup.sh", self.folder / "scripts")
        (self.folder / "requirements.txt").write_text("a==1\nuv==1.2\n", encoding="utf-8")
        (self.folder / "pyproject.toml").write_text("[project]\n", encoding="utf-8")

    def set_up(self, **environment: str) -> tuple[int, list[str]]:
        """Run the script; return its status and what it called."""
        self.log.write_text("", encoding="utf-8")
        done = subprocess.run(
            [str(self.folder / "scripts" / "setup.sh")],
            env={"PATH": str(self.bin), "LOG": str(self.log), **environment},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.stdout == ""
        return done.returncode, self.log.read_text(encoding="utf-8").splitlines()


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path)


def test_it_installs_once_and_again_when_its_inputs_change(checkout: Checkout) -> None:
    assert checkout.set_up() == (0, VENV + INSTALL)
    assert checkout.set_up() == (0, [])
    for name in ("requirements.txt", "pyproject.toml"):
        with (checkout.folder / name).open("a", encoding="utf-8") as file:
            file.write("# changed\n")
        assert checkout.set_up() == (0, INSTALL)  # into the same environment


def test_a_failed_set_up_is_repeated(checkout: Checkout) -> None:
    status, called = checkout.set_up(UV_FAILS="1")
    assert status != 0 and called[-1] == "uv pip sync"
    assert checkout.set_up() == (0, INSTALL)


def test_an_environment_that_cannot_be_used_is_made_anew(checkout: Checkout) -> None:
    checkout.set_up()
    checkout.folder = checkout.folder.rename(checkout.folder.with_name("moved"))
    assert checkout.set_up() == (0, VENV + INSTALL)


@pytest.mark.parametrize("name", [".ci/run", "scripts/setup.sh", "scripts/system_packages.sh"])
def test_shell_scripts_are_executable_and_parse(name: str) -> None:
    assert (ROOT / name).stat().st_mode & stat.S_IXUSR
    subprocess.run(["bash", "-n", str(ROOT / name)], check=True)
