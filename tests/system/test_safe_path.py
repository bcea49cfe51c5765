"""No command imports a module that lies in the current folder, such as a downloaded buffer set."""

import os
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from support import runs, worlds
from support.buffer_sets import GOLDEN

from robomme_interference_data.runtime import safe_path

pytestmark = pytest.mark.slow

TESTS = Path(__file__).parent.parent
PROGRAM = Path(sys.executable).parent / "robomme-interference"
EVALUATE = (
    f"evaluate . --policy {runs.CHEAT} --simulator {runs.WORLD} --system mine --workers 2"
    " --families MoveCube --conditions no-history,k0 --out ../run"
)
SHARED = (
    EVALUATE.replace(runs.CHEAT, "python:support.shared_policies:Remembering") + " --policies 1"
)
PLANTED = """
with open({mark!r}, "a") as file:
    file.write(__name__ + "\\n")
raise ImportError("the current folder is on the import path")
"""


@pytest.fixture
def planted(tmp_path: Path) -> Path:
    """A buffer set with a module for every name that a program here can import."""
    folder = tmp_path / "planted"
    shutil.copytree(GOLDEN, folder)
    text = PLANTED.format(mark=str(tmp_path / "mark"))
    ours = {"robomme_interference_data"}
    for name in {*sys.stdlib_module_names, *metadata.packages_distributions()} | ours:
        if name.isidentifier():
            (folder / f"{name}.py").write_text(text)
    return folder


def environment() -> dict[str, str]:
    named = {"PYTHONPATH": str(TESTS), worlds.BUFFER_SET: str(GOLDEN)}
    return os.environ | named


def ran(folder: Path) -> list[str]:
    """The planted modules that were imported."""
    mark = folder.parent / "mark"
    return mark.read_text().split() if mark.exists() else []


@pytest.mark.timeout(200)
@pytest.mark.parametrize(
    "words",
    [
        EVALUATE,
        pytest.param(SHARED, marks=pytest.mark.slow),
        pytest.param(f"{EVALUATE} --executor ray:local", marks=pytest.mark.slow),
        pytest.param("doctor", marks=pytest.mark.slow),
        pytest.param("build ../new --source sample --workers 2", marks=pytest.mark.slow),
        pytest.param("verify .", marks=pytest.mark.slow),
        pytest.param("index . --encoder thumbnail", marks=pytest.mark.slow),
        pytest.param("list .", marks=pytest.mark.slow),
    ],
)
def test_no_module_of_the_current_folder_is_imported(planted: Path, words: str) -> None:
    done = subprocess.run(
        [str(PROGRAM), *words.split()],
        cwd=planted,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=180,
        check=False,
    )
    assert ran(planted) == []
    if words == "verify .":
        assert "multiprocessing.py: is not part of the buffer set" in done.stdout
    elif words != "doctor":  # fails where something is not installed
        assert done.returncode == 0, done.stderr


def test_nor_by_the_workers_of_a_script(planted: Path) -> None:
    script = planted.parent / "script.py"
    script.write_text(
        "from robomme_interference_data.runtime.process import Processes\n"
        "from support.worker_calls import behave\n"
        'if __name__ == "__main__":\n'
        '    [outcome] = Processes(1).run(behave, [("value", 7)])\n'
        "    print(outcome.value)\n"
    )
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=planted,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=180,
        check=True,
    )
    assert done.stdout == "7\n"
    assert ran(planted) == []


def test_a_program_of_the_user_has_the_environment_of_the_user(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv(safe_path.SAFE_PATH, raising=False)
    with safe_path.safe_path():
        assert os.environ[safe_path.SAFE_PATH]
        assert safe_path.SAFE_PATH not in safe_path.user_environment()
    assert safe_path.SAFE_PATH not in os.environ
    monkeypatch.setenv(safe_path.SAFE_PATH, "1")
    with safe_path.safe_path():
        assert safe_path.user_environment()[safe_path.SAFE_PATH] == "1"
    assert os.environ[safe_path.SAFE_PATH] == "1"
