"""The process of the official simulator: its failures and interpreters."""

import json
import os
import platform
import signal
import subprocess
import sys
import textwrap
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from support.messages import raises
from support.worker_calls import wait_until_gone

from robomme_interference_data.build_dataset.sources import open_source
from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    SimulatorCrashError,
)
from robomme_interference_data.simulators import make_simulator
from robomme_interference_data.simulators.registry import simulator_versions
from robomme_interference_data.simulators.remote.interpreter import _versions
from robomme_interference_data.simulators.robomme.simulator import RoboMMESimulator
from robomme_interference_data.simulators.tabletop import SUITE_VERSION

HOLD = np.array([0, 0, 0, -1.5, 0, 1.5, 0.75, 1], np.float32)

DIES, HANGS, RAISES, BREAKS = 40, 41, 42, 43
"""Indices of the stand-in's episodes."""


# --- failures ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_death_shows_the_end_of_its_log_without_escapes(simulator: RoboMMESimulator) -> None:
    with raises(SimulatorCrashError) as caught:
        simulator.reset(f"MoveCube/test/{DIES}")
    lines = (caught.value.hint or "").splitlines()
    # 20 lines at most, the last ones; the stand-in prints them in color.
    assert (len(lines), lines[-1]) == (21, "WARN: planner failure 99")
    assert simulator.pid is None
    assert len(simulator.reset("MoveCube/test/0")[0]) == 2


@pytest.mark.slow
def test_a_process_that_was_killed(simulator: RoboMMESimulator) -> None:
    simulator.reset("MoveCube/test/3")
    for call in (lambda: simulator.step(HOLD), lambda: simulator.reset("MoveCube/test/3")):
        assert simulator.pid is not None
        os.kill(simulator.pid, signal.SIGKILL)
        with raises(SimulatorCrashError):
            call()
        with raises(SimulatorCrashError):
            simulator.step(HOLD)
        assert len(simulator.reset("MoveCube/test/0")[0]) == 2


@pytest.mark.slow
def test_a_hang_is_ended(robomme_python: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with RoboMMESimulator(robomme_python, answer_s=8) as simulator:
        simulator.reset(f"MoveCube/test/{HANGS}")
        assert simulator.pid is not None
        pid = simulator.pid
        with raises(SimulatorCrashError):
            simulator.step(HOLD)
        wait_until_gone([pid], seconds=20)
        assert simulator.pid is None
    monkeypatch.setenv("STAND_IN_IMPORT_SECONDS", "60")
    with raises(SimulatorCrashError):
        RoboMMESimulator(robomme_python, answer_s=1)


def test_an_exception_leaves_the_process_running(simulator: RoboMMESimulator) -> None:
    pid = simulator.pid
    with raises(SimulatorCrashError):
        simulator.reset(f"MoveCube/test/{RAISES}")
    simulator.reset(f"MoveCube/test/{BREAKS}")
    simulator.step(HOLD)
    with raises(SimulatorCrashError):
        simulator.step(HOLD)
    with raises(SimulatorCrashError):
        simulator.step(HOLD)
    assert len(simulator.reset("MoveCube/test/0")[0]) == 2
    assert simulator.pid == pid


def test_process_ends_with_its_parent_during_a_call(robomme_python: Path) -> None:
    code = f"""
        import numpy as np
        from robomme_interference_data.simulators.robomme.simulator import RoboMMESimulator
        simulator = RoboMMESimulator({str(robomme_python)!r})
        simulator.reset("MoveCube/test/{HANGS}")
        print(simulator.pid, flush=True)
        simulator.step(np.zeros(8, np.float32))
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        time.sleep(0.5)
        parent.kill()
    wait_until_gone([pid], seconds=20)


# --- its interpreter ---------------------------------------------------------------------------


def test_an_interpreter_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    local = tmp_path / "python"  # there is another one on the path
    local.symlink_to(sys.executable)
    for given_path in ("./python", local, "~/python"):
        assert RoboMMESimulator.interpreter(given_path).path == str(local)
    assert RoboMMESimulator.interpreter("python3").path != str(local)
    monkeypatch.setenv("ROBOMME_PYTHON", "./python")
    assert RoboMMESimulator.interpreter().path == str(local)


def test_missing_interpreter(tmp_path: Path) -> None:
    with raises(InvalidOptionError) as caught:
        make_simulator("robomme")
    assert "ROBOMME_PYTHON" in str(caught.value)
    (tmp_path / "notes.txt").write_text("not a program")
    for path in (tmp_path / "nowhere" / "python", tmp_path, tmp_path / "notes.txt"):
        with raises(InvalidOptionError):
            RoboMMESimulator.interpreter(path)


def test_unusable_interpreter(
    bare_python: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(python: Path | str, error: type[Exception]) -> str | None:
        with raises(error) as caught:
            RoboMMESimulator(python)
        return caught.value.hint

    program = tmp_path / "program"
    program.write_text("#!/bin/sh\necho I am a shell\nexit 3\n")
    program.chmod(0o755)
    assert "I am a shell" in str(refused(program, SimulatorCrashError))
    program.write_bytes(b"\x7fELF of another machine")
    refused(program, InvalidOptionError)
    refused(bare_python, MissingExtraError)
    (tmp_path / "robomme").mkdir()
    (tmp_path / "robomme" / "env_record_wrapper.py").write_text("import mplib_is_missing\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    command = f"Install what is missing: uv pip install --python {bare_python} "
    assert str(refused(bare_python, MissingExtraError)).startswith(f"{command}mplib_is_missing ")
    gymnasium = tmp_path / "gymnasium-1.0.0.dist-info"
    gymnasium.mkdir()
    (gymnasium / "METADATA").write_text("Metadata-Version: 2.1\nName: gymnasium\nVersion: 1.0.0\n")
    assert refused(bare_python, MissingExtraError) == f"{command}gymnasium==0.29.1"
    refused(sys.executable, MissingExtraError)


@pytest.mark.slow
def test_unsupported_maniskill_is_an_error(
    robomme_python: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STAND_IN_MANI_SKILL", "strange")
    with raises(MissingExtraError):
        RoboMMESimulator(robomme_python)
    monkeypatch.setenv("STAND_IN_MANI_SKILL", "index")
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc")
    with raises(MissingExtraError) as caught:
        RoboMMESimulator(robomme_python)
    assert "XDG_CACHE_HOME" in str(caught.value.hint)


def test_versions(robomme_python: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # The metadata of a package that was installed from git.
    installed = tmp_path / "robomme-0.2.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: robomme\nVersion: 0.2\n")
    origin = {"url": "https://example.org/robomme", "vcs_info": {"vcs": "git", "commit_id": "ab12"}}
    (installed / "direct_url.json").write_text(json.dumps(origin))
    found = simulator_versions("robomme")
    # A package that is only on the path has no version.
    assert found.keys() == {"robomme_python", "robomme_numpy", "robomme_patches"}
    assert found["robomme_patches"] == "none"  # the stand-in is RoboMME's fork
    assert found["robomme_python"] == platform.python_version()
    assert found["robomme_numpy"].startswith("1.")
    monkeypatch.setenv("PYTHONPATH", f"{os.environ['PYTHONPATH']}:{tmp_path}")
    _versions.cache_clear()
    installed_too = simulator_versions("robomme")
    assert installed_too == {**found, "robomme": "0.2+ab12"}
    monkeypatch.setenv("STAND_IN_MANI_SKILL", "index")
    _versions.cache_clear()
    patched = simulator_versions("robomme")["robomme_patches"]
    with RoboMMESimulator(robomme_python) as simulator:
        assert patched == ", ".join(simulator.patches) != ""
    monkeypatch.setenv("STAND_IN_MANI_SKILL", "strange")
    _versions.cache_clear()
    assert "robomme_patches" not in simulator_versions("robomme")  # it does not start either
    _versions.cache_clear()
    libraries = {name: version(name) for name in ("mani-skill", "sapien")}
    assert simulator_versions("tabletop") == {"tabletop": str(SUITE_VERSION), **libraries}
    assert simulator_versions("support.worlds:World") == {}


def test_demonstrations_record_the_versions_and_the_renderer(
    robomme_python: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert open_source("robomme").provenance == {
        "kind": "robomme",
        "versions": simulator_versions("robomme"),
        "renderer": "GPU of the stand-in",  # the second one draws, in its interpreter
    }
    monkeypatch.delenv("ROBOMME_PYTHON")
    with raises(InvalidOptionError):
        open_source("robomme")
