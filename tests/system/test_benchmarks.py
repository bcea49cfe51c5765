"""The benchmarks run, at their smallest size, and print tables."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.buffer_sets import GOLDEN
from support.tabletop import TABLETOP

FOLDER = Path(__file__).parents[2] / "benchmarks"
HELPERS = {"loopback_hub", "made_buffer_set", "nothing", "common"}
BUFFER_SET = ("--buffer-set", GOLDEN)
SMALLEST: dict[str, tuple[object, ...]] = {
    "build": ("--source", "sample:MoveCube", "--workers", 1),
    "cluster": ("--rollouts", 30, "--workers", 1, "--buffer-set", TABLETOP, "--replayed", 2),
    "evaluate": ("--help",),  # needs a renderer
    "files": (*BUFFER_SET, "--items", 3),
    "hub": (*BUFFER_SET, "--queries", 9, "--units", 9, "--latency", 1),
    "load": (*BUFFER_SET, "--lerobot-frames", 3, "--chunk", 8),
    "manifests": ("--units", 90, "--queries", 9),
    "policies": ("--lesson", 10, *BUFFER_SET, "--episode", "MoveCube/test/0"),
    "retrieval": ("--help",),  # needs weights
    "robomme": ("--families", "MoveCube", "--steps", 20),
    "score": ("--draws", 50),
    "simulators": ("--help",),  # needs a renderer
}


def run(name: str, *options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(FOLDER / f"{name}.py"), *map(str, options)]
    return subprocess.run(command, capture_output=True, text=True, timeout=560, check=False)


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALLEST)
def test_it_prints_tables(name: str, request: pytest.FixtureRequest) -> None:
    options = (*SMALLEST[name], "--rounds", 1)
    if name == "robomme":
        options += ("--python", request.getfixturevalue("robomme_python"))
    done = run(name, *options)
    assert done.returncode == 0, done.stderr
    if "--help" in options:
        assert "usage: " in done.stdout
    else:
        assert re.match(r"\d+ cores \(.+\), Python 3\.\d+\.\d+", done.stdout)
        assert re.search(r"^\|( -+:? \|)+$", done.stdout, flags=re.M)


def test_none_is_left_out() -> None:
    assert {path.stem for path in FOLDER.glob("*.py")} == {*SMALLEST} | HELPERS


def test_what_is_no_buffer_set_is_one_error(tmp_path: Path) -> None:
    refused = run("load", "--buffer-set", tmp_path)
    assert refused.returncode == 1
    assert "is not a buffer set" in refused.stderr and "Traceback" not in refused.stderr
