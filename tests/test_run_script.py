"""Runs that a script starts: `run_evaluation` under the guard, and without it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import factories
import pytest
from run_calls import CHEAT, WORLD

from robomme_interference_data import evaluate
from robomme_interference_data.evaluate.log import read_log

pytestmark = pytest.mark.usefixtures("world")


def script(tmp_path: Path, call: str) -> subprocess.CompletedProcess[str]:
    """Run a script that ends with a call of `run_evaluation`."""
    options = f"{str(factories.split())!r}, 'run', simulator={WORLD!r}, system='mine', "
    options += "conditions=['k0'], families=['MoveCube'], episodes='0'"
    path = tmp_path / "script.py"
    path.write_text(
        "from rollout_doubles import make_cheat\n"
        "from robomme_interference_data.evaluate import run_evaluation\n"
        + call.format(options=options)
    )
    return subprocess.run(
        [sys.executable, str(path)],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


GUARD = 'if __name__ == "__main__":'


def test_a_script_with_the_guard_runs(tmp_path: Path) -> None:
    call = f"{GUARD}\n    print(run_evaluation({CHEAT!r}, {{options}}).counts)\n"
    done = script(tmp_path, call)
    assert done.stderr == ""
    assert done.stdout == "{'success': 1, 'fail': 0, 'timeout': 0, 'error': 0}\n"


def test_a_script_without_the_guard_gets_one_error_and_no_rows(tmp_path: Path) -> None:
    done = script(tmp_path, f"run_evaluation({CHEAT!r}, {{options}}, workers=2)\n")
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1
    assert done.stderr.splitlines()[-1] == f"Put the call into the script under  {GUARD}"
    assert read_log(tmp_path / "run") == {}
    header = json.loads((tmp_path / "run" / "run.json").read_text())
    assert header["status"] == "incomplete"
    assert header["stopped"].startswith("the worker processes came upon the call that starts them")


def test_a_factory_in_the_script_itself_is_refused(tmp_path: Path) -> None:
    done = script(
        tmp_path, f"{GUARD}\n    run_evaluation('python:__main__:make_cheat', {{options}})\n"
    )
    assert done.stderr.splitlines()[-1].endswith("and write python:MODULE:FUNCTION.")
    assert not (tmp_path / "run").exists()


def test_the_example_has_the_guard() -> None:
    page = (Path(__file__).parent.parent / "docs" / "evaluate.md").read_text(encoding="utf-8")
    for text in (page, evaluate.__doc__ or ""):
        snippet = text.split("```python\n")[1].split("```")[0]
        assert snippet.index(GUARD) < snippet.index("run_evaluation(")
