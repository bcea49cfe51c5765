"""The benchmarks start, and report a wrong folder in one error."""

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
HELPERS = {"loopback_hub", "made_buffer_set", "nothing", "common", "robomme_loop"}
NAMES = sorted({path.stem for path in FOLDER.glob("*.py")} - HELPERS)


def run(name: str, *options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(FOLDER / f"{name}.py"), *map(str, options)]
    return subprocess.run(command, capture_output=True, text=True, timeout=560, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_benchmark_prints_help(name: str) -> None:
    done = run(name, "--help")
    assert done.returncode == 0 and "usage: " in done.stdout, done.stderr


def test_folder_without_buffer_set_is_one_error(tmp_path: Path) -> None:
    done = run("load", "--buffer-set", tmp_path)
    assert done.returncode == 1
    assert "is not a buffer set" in done.stderr and "Traceback" not in done.stderr
