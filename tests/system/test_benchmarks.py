"""The benchmarks run, at their smallest size, and print the tables that they promise."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.tabletop import TABLETOP

FOLDER = Path(__file__).parents[2] / "benchmarks"


def run(name: str, *options: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(FOLDER / f"{name}.py"), *map(str, options)]
    return subprocess.run(command, capture_output=True, text=True, timeout=560, check=False)


def printed(name: str, *options: str | Path) -> list[list[dict[str, str]]]:
    """Run a benchmark once; return the rows of its tables, cells by header."""
    done = run(name, *options, "--rounds", "1")
    assert done.returncode == 0, done.stderr
    machine, *blocks = done.stdout.strip().split("\n\n")
    assert re.match(r"\d+ cores \(.+\), Python 3\.\d+\.\d+", machine)
    tables = []
    for lines in (block.splitlines() for block in blocks if block.startswith("|")):
        cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
        assert re.fullmatch(r"\|( -+:? \|)+", lines[1])
        tables.append([dict(zip(cells[0], row, strict=True)) for row in cells[2:]])
    assert tables and all(tables)
    return tables


@pytest.mark.slow
def test_load(tiny_split: Path) -> None:
    options = ("--lerobot-frames", "3", "--chunk", "8")
    loading, streaming = printed("load", "--split", tiny_split, *options)
    assert [row["aim"] for row in loading] == ["≤ 1.1", "≤ 0.7", "", "≥ 15", "≥ 15", "≤ 3"]
    # A lesson of 48 frames, 32 a unit; 32 × 32 × 3 bytes a frame.
    frames = {"k0": 48, "k1": 80, "k3": 144, "k7": 272, "k7, 4 times as long": 1088}
    assert [(row["buffer"], row["frames"], row["decoded MB"]) for row in streaming] == [
        (name, f"{count:,}", f"{count * 32 * 32 * 3 / 1e6:.1f}") for name, count in frames.items()
    ]


@pytest.mark.slow
def test_files(tiny_split: Path) -> None:
    ((cost,), reading) = printed("files", "--split", tiny_split, "--items", "3")
    assert float(cost["ratio"]) > 1  # a file is more than the packets in it
    # Two cameras of three lessons and of seventeen units; one file a camera when concatenated.
    assert [row["a file an episode"].split(",")[0] for row in reading] == ["6 files", "34 files"]
    assert [row["concatenated"].split(",")[0] for row in reading] == ["2 files", "2 files"]


@pytest.mark.slow
def test_build() -> None:
    (rows,) = printed("build", "--source", "sample:MoveCube", "--workers", "1")
    assert (rows[0]["step"], rows[0]["of bare"]) == ("bare encoder (PyAV)", "1.00")


@pytest.mark.slow
def test_manifests() -> None:
    (rows,) = printed("manifests", "--units", "90", "--queries", "9", "18")
    assert [(row["queries"], row["buffers"]) for row in rows] == [("9", "90"), ("18", "180")]


@pytest.mark.slow
def test_hub(tiny_split: Path) -> None:
    options = ("--queries", "9", "--units", "9", "--latency", "1")
    loading, metadata, fetching, publishing = printed("hub", "--split", tiny_split, *options)
    # Numbers and a video of eight sessions: the Hub tells where a file is, then sends it.
    assert [row["requests for files"] for row in loading] == ["32", "32"]
    assert [row["requests again"] for row in loading] == ["0", "0"]
    (ratio,) = [row["× spans"] for row in loading if row["× spans"]]
    assert float(ratio) > 1  # a file is more than the packets in it
    tables = [row for row in metadata if "/episodes/" in row["file"]]
    assert all(0 < float(row["statistics"]) < float(row["kB"]) for row in tables)
    # Numbers and two videos of each of 18 episodes.
    assert {row["files of episodes"] for row in fetching} == {"54"}
    # A commit a repository; nothing is sent the second time.
    assert [row["commits"] for row in publishing] == ["2", "0", "3"]
    assert publishing[1]["bytes sent"] == "0"


@pytest.mark.slow
def test_policies(tiny_split: Path) -> None:
    split = ("--split", tiny_split, "--episode", "MoveCube/test/0")
    feeding, decoding = printed("policies", "--lesson", "10", *split)
    assert feeding[0]["ratio"] == decoding[0]["ratio"] == "1.00"


@pytest.mark.slow
def test_score() -> None:
    pytest.importorskip("pandas")
    grid, repeats = printed("score", "--repeats", "2", "--draws", "50")
    # 11 systems × 5 conditions and one under one condition, × 9 families × 50 episodes
    assert {row["rows"] for row in grid} == {"25,200"}
    assert {row["rows"] for row in repeats} == {"50,400"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["evaluate", "retrieval", "simulators"])
def test_those_that_need_more_show_their_help(name: str) -> None:
    shown = run(name, "--help")
    assert shown.returncode == 0 and "usage: " in shown.stdout


def test_bad_options_are_refused_without_traceback(tmp_path: Path) -> None:
    for options, code, told in (
        (("--rounds", "0"), 2, "'0' is not a positive number"),
        (("--split", tmp_path), 1, "is not a split"),
    ):
        refused = run("load", *options)
        assert refused.returncode == code
        assert told in refused.stderr and "Traceback" not in refused.stderr


def test_ways_are_timed_in_turns_and_compared_round_by_round() -> None:
    spec = importlib.util.spec_from_file_location("timing", FOLDER / "timing.py")
    assert spec is not None and spec.loader is not None
    timing = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(timing)
    calls: list[str] = []
    timing.interleave({name: lambda name=name: calls.append(name) for name in "abc"}, 2)
    assert "".join(calls) == "abc" + "cba" + "abc"  # the first to warm up
    times = timing.Times({"a": [2.0, 30.0, 6.0], "b": [1.0, 10.0, 4.0]})
    assert (times.median("a"), times.ratio("a", "b")) == (6.0, 2.0)  # of 2, 3 and 1.5


@pytest.mark.slow
def test_robomme(robomme_python: Path) -> None:
    options = ("--python", robomme_python, "--families", "MoveCube", "--steps", "20")
    (rows,) = printed("robomme", *options)
    assert [row["family"] for row in rows] == ["MoveCube"] * 4
    assert rows[0]["times as fast"] == "1.0"


@pytest.mark.slow
def test_cluster() -> None:
    options = ("--rollouts", "30", "--workers", "1", "--split", TABLETOP)
    ((cost,), overhead, grid) = printed("cluster", *options, "--replayed", "2")
    assert cost["rollouts"] == "30"
    assert [row["executor"] for row in overhead] == ["processes", "ray"]
    assert overhead[0]["ratio"] == "1.00"
    assert [row["workers"] for row in grid] == ["8", "64", "512"]
    # What is simulated is the same everywhere, and no order beats the ideal.
    assert all(1 <= float(row["longest first / ideal"]) < 1.1 for row in grid)
