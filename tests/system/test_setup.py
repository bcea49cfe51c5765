"""Set-up installs what is missing, once, and says what to do where it cannot."""

import re
import shutil
import stat
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

# Stands in for Python, for its pip, and for the uv that it installs; notes how it is called.
FAKE_PYTHON = """#!/usr/bin/env bash
echo "$(basename "$0") $*" >> "$LOG"
make_venv() { mkdir -p "$1/bin" && cp "$0" "$1/bin/python" && cp "$0" "$1/bin/uv"; }
case "$*" in
  "-c import sys; sys.exit(sys.version_info"*) [[ ${FAKE_VERSION:-3.12} == 3.12 ]] ;;
  "-m venv "*) make_venv "$3" ;;
  "-m pip config"*) exit 1 ;;
  "-m pip --version") [[ -z ${NO_PIP:-} ]] ;;
  "venv "*) [[ -z ${UV_FAILS:-} ]] && make_venv .venv ;;
  "pip sync"*) echo "index ${UV_DEFAULT_INDEX:-default}" >> "$LOG"; [[ -z ${UV_FAILS:-} ]] ;;
esac
"""
TOOLS = ("bash", "basename", "cat", "cmp", "cp", "dirname", "env", "grep", "head", "mkdir", "rm")

PIN_UV = "python -m pip install -qq --disable-pip-version-check --root-user-action ignore uv==1.2"
SYNC = "uv pip sync --quiet --python .venv/bin/python requirements.txt"
INSTALL = (
    "uv pip install --quiet --python .venv/bin/python --no-deps --no-build-isolation --editable ."
)


class Checkout:
    """A folder with the set-up script, in which only what it is given can be run."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.log = folder.parent / "calls"
        self.bin = folder.parent / "bin"
        self.bin.mkdir(exist_ok=True)
        for name in TOOLS:
            tool = shutil.which(name)
            assert tool is not None
            (self.bin / name).symlink_to(tool)
        (folder / "scripts").mkdir(parents=True)
        shutil.copy(ROOT / "scripts" / "setup.sh", folder / "scripts")
        (folder / "requirements.txt").write_text("a==1\nuv==1.2\n", encoding="utf-8")
        (folder / "pyproject.toml").write_text("[project]\n", encoding="utf-8")

    def add_python(self, name: str) -> None:
        path = self.bin / name
        path.write_text(FAKE_PYTHON, encoding="utf-8")
        path.chmod(0o755)

    def set_up(self, **environment: str) -> tuple[int, str, list[str]]:
        """Run the script; return its status, what it said, and what it had done."""
        self.log.write_text("", encoding="utf-8")
        done = subprocess.run(
            [str(self.folder / "scripts" / "setup.sh")],
            env={"PATH": str(self.bin), "LOG": str(self.log), **environment},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.stdout == ""
        calls = self.log.read_text(encoding="utf-8").splitlines()
        asked = re.compile(r"\S+ (-c|-m pip config|-m pip --version).*|index .*")
        called = [line for line in calls if not asked.fullmatch(line)]
        return done.returncode, done.stderr, called


@pytest.fixture
def checkout(tmp_path: Path) -> Checkout:
    return Checkout(tmp_path / "checkout")


@pytest.mark.parametrize("name", ["python3", "python3.12"])
def test_the_first_set_up_installs_and_the_second_does_nothing(
    checkout: Checkout, name: str
) -> None:
    checkout.add_python(name)
    status, said, called = checkout.set_up()
    assert (status, len(said.splitlines())) == (0, 1)
    assert called == [f"{name} -m venv .venv", PIN_UV, SYNC, INSTALL]

    assert checkout.set_up() == (0, "", [])
    assert checkout.log.read_text(encoding="utf-8") == ""


@pytest.mark.parametrize("name", ["requirements.txt", "pyproject.toml"])
def test_set_up_runs_again_when_its_inputs_change(checkout: Checkout, name: str) -> None:
    checkout.add_python("python3.12")
    checkout.set_up()
    with (checkout.folder / name).open("a", encoding="utf-8") as file:
        file.write("# changed\n")
    status, _, called = checkout.set_up()
    assert (status, called) == (0, [PIN_UV, SYNC, INSTALL])  # into the same environment
    assert checkout.set_up() == (0, "", [])


def test_a_failed_set_up_is_not_taken_for_a_finished_one(checkout: Checkout) -> None:
    checkout.add_python("python3.12")
    status, _, called = checkout.set_up(UV_FAILS="1")
    assert status != 0
    assert called[-1] == SYNC
    assert checkout.set_up()[2] == [PIN_UV, SYNC, INSTALL]


def test_an_environment_that_cannot_be_used_is_made_anew(checkout: Checkout) -> None:
    checkout.add_python("python3.12")
    checkout.set_up()
    moved = checkout.folder.rename(checkout.folder.with_name("moved"))
    checkout.folder = moved
    assert checkout.set_up()[2] == ["python3.12 -m venv .venv", PIN_UV, SYNC, INSTALL]

    (moved / ".venv" / "bin" / "python").unlink()
    (moved / "pyproject.toml").write_text("[other]\n", encoding="utf-8")
    assert checkout.set_up()[2] == ["python3.12 -m venv .venv", PIN_UV, SYNC, INSTALL]

    (moved / "pyproject.toml").write_text("[third]\n", encoding="utf-8")
    assert checkout.set_up(NO_PIP="1")[2] == ["python3.12 -m venv .venv", PIN_UV, SYNC, INSTALL]


def test_without_python_3_12_uv_brings_one(checkout: Checkout) -> None:
    checkout.add_python("python3")
    assert checkout.set_up(FAKE_VERSION="3.11")[2] == [
        "python3 -m venv build/uv",
        PIN_UV.replace("--root-user-action ignore ", ""),
        "uv venv --quiet --seed --python 3.12 .venv",
        PIN_UV,
        SYNC,
        INSTALL,
    ]


@pytest.mark.parametrize("python", ["python3", None])
def test_with_no_python_3_12_to_be_had_it_says_what_to_install(
    checkout: Checkout, python: str | None
) -> None:
    if python is not None:
        checkout.add_python(python)
    status, said, _ = checkout.set_up(FAKE_VERSION="3.11", UV_FAILS="1")
    assert status == 1
    assert said.splitlines()[-2].startswith("setup: Python 3.12 is needed. Install it with ")


@pytest.mark.parametrize(
    ("environment", "index"),
    [
        ({}, "default"),
        ({"PIP_INDEX_URL": "file:///pip"}, "file:///pip"),
        ({"PIP_INDEX_URL": "file:///pip", "UV_DEFAULT_INDEX": "file:///uv"}, "file:///uv"),
    ],
)
def test_uv_uses_the_index_of_pip(
    checkout: Checkout, environment: dict[str, str], index: str
) -> None:
    checkout.add_python("python3.12")
    checkout.set_up(**environment)
    assert f"index {index}" in checkout.log.read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize("name", [".ci/run", "scripts/setup.sh", "scripts/system_packages.sh"])
def test_shell_scripts_are_executable_and_parse(name: str) -> None:
    assert (ROOT / name).stat().st_mode & stat.S_IXUSR
    subprocess.run(["bash", "-n", str(ROOT / name)], check=True)
