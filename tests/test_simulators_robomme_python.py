"""RoboMME's interpreter: those that will not do, and the commands that use one."""

import json
import platform
import sys
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from robomme_interference_data import doctor
from robomme_interference_data.cli import app
from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.simulators import make_simulator
from robomme_interference_data.simulators.registry import simulator_versions
from robomme_interference_data.simulators.robomme_client import RoboMMESimulator
from robomme_interference_data.simulators.tabletop import SUITE_VERSION

STAND_IN = Path(__file__).parent / "robomme_stand_in"
"""A package `robomme` with RoboMME's interface, which behaves badly where an index asks for it."""


@pytest.fixture
def bare(bare_python: Path) -> Path:
    return bare_python


@pytest.fixture
def python(robomme_python: Path) -> Path:
    return robomme_python


def test_no_interpreter_is_given() -> None:
    with pytest.raises(InvalidOptionError, match="none is given") as caught:
        make_simulator("robomme")
    assert "--robomme-python PATH" in str(caught.value)


def test_the_environment_variable_names_it(python: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROBOMME_PYTHON", str(python))
    simulator = make_simulator("robomme")
    assert len(simulator.reset("MoveCube/test/0")[0]) == 2
    simulator.close()


def test_versions_are_told(python: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = simulator_versions("robomme", str(python))
    assert told.keys() == {"robomme_python", "robomme_numpy"}  # it is on the path, not installed
    assert told["robomme_python"] == platform.python_version()
    assert told["robomme_numpy"].startswith("1.")
    # What an installer leaves of a package, and of one that came from git.
    installed = tmp_path / "robomme-0.2.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: robomme\nVersion: 0.2\n")
    monkeypatch.setenv("PYTHONPATH", f"{STAND_IN}:{tmp_path}")
    assert simulator_versions("robomme", str(python))["robomme"] == "0.2"
    origin = {"url": "https://example.org/robomme", "vcs_info": {"vcs": "git", "commit_id": "ab12"}}
    (installed / "direct_url.json").write_text(json.dumps(origin))
    assert simulator_versions("robomme", str(python))["robomme"] == "0.2+ab12"


def test_versions_of_other_simulators() -> None:
    assert simulator_versions("tabletop") == {"tabletop": str(SUITE_VERSION)}
    assert simulator_versions("rollout_doubles:World") == {}


@pytest.mark.parametrize("name", ["nowhere/python", "folder", "notes.txt"])
def test_no_interpreter_is_there(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "notes.txt").write_text("not a program")
    with pytest.raises(InvalidOptionError, match=f"{name} is not an executable file"):
        RoboMMESimulator(tmp_path / name)


def test_a_program_that_is_no_python(tmp_path: Path) -> None:
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho I am a shell\nexit 3\n")
    program.chmod(0o755)
    with pytest.raises(SimulatorCrashError, match=r"(?s)died during start, exit code 3.*a shell"):
        RoboMMESimulator(program)
    program.write_bytes(b"\x7fELF of another machine")
    with pytest.raises(InvalidOptionError, match="cannot be run as RoboMME's Python"):
        RoboMMESimulator(program)


def test_an_interpreter_without_robomme(bare: Path) -> None:
    with pytest.raises(MissingExtraError, match="robomme is not installed there") as caught:
        RoboMMESimulator(bare)
    assert str(bare) in caught.value.message


def test_numpy_2_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(STAND_IN))
    with pytest.raises(MissingExtraError, match=rf"numpy is {np.__version__}; RoboMME needs numpy"):
        RoboMMESimulator(sys.executable)


def test_robomme_that_cannot_be_imported(
    bare: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "robomme").mkdir()
    (tmp_path / "robomme" / "env_record_wrapper.py").write_text("import mplib_is_missing\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(MissingExtraError, match=r"imported: ModuleNotFoundError: .*mplib_is_miss"):
        RoboMMESimulator(bare)


def test_one_that_does_not_start_in_time(python: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STAND_IN_IMPORT_SECONDS", "60")
    with pytest.raises(SimulatorCrashError, match="took more than 1 s to start"):
        RoboMMESimulator(python, start_s=1)


# --- commands ----------------------------------------------------------------------------------


def test_simulate_plays_the_demonstration(python: Path) -> None:
    given_words = ["simulate", "--family", "MoveCube", "--episode", "3", "--json"]
    given_words += ["--simulator", "robomme", "--robomme-python", str(python)]
    done = CliRunner().invoke(app, given_words)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout) == {
        "episode": "MoveCube/test/3",
        "simulator": "robomme",
        "goal": "move the cube as before",
        "difficulty": "easy",
        "seed": 640_003,
        "policy": "none",
        "status": "ongoing",
        "lesson_frames": 5,
        "steps": 0,
    }


def test_simulate_has_no_oracle_there() -> None:
    given_words = ["simulate", "--family", "MoveCube", "--policy", "oracle"]
    done = CliRunner().invoke(app, [*given_words, "--simulator", "robomme"])
    assert isinstance(done.exception, UnknownNameError)
    assert "expected none" in str(done.exception)


def test_the_doctor_asks_the_interpreter(python: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = doctor._robomme()
    assert (row.ok, row.detail) == (
        None,
        "ROBOMME_PYTHON is not set; only --simulator robomme needs it",
    )
    monkeypatch.setenv("ROBOMME_PYTHON", str(python))
    row = doctor._robomme()
    assert (row.ok, row.fix) == (True, None)
    assert "numpy 1." in row.detail and row.detail.endswith("4 families")
    monkeypatch.setenv("ROBOMME_PYTHON", sys.executable)
    assert "RoboMME needs numpy < 2" in doctor._robomme().detail
    monkeypatch.setenv("ROBOMME_PYTHON", "/nowhere/python")
    row = doctor._robomme()
    assert row.ok is False
    assert "cannot be asked" in row.detail
