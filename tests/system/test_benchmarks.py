"""The benchmarks run, at their smallest size, and print tables whose numbers fit each other."""

import argparse
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.py") if path.stem != "timing")


@pytest.fixture(scope="module")
def timing() -> ModuleType:
    spec = importlib.util.spec_from_file_location("timing", FOLDER / "timing.py")
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = loaded  # dataclasses look their module up
    spec.loader.exec_module(loaded)
    return loaded


def run(name: str, *options: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(FOLDER / f"{name}.py"), *map(str, options)]
    return subprocess.run(command, capture_output=True, text=True, timeout=560, check=False)


def printed(name: str, *options: str | Path) -> list[list[dict[str, str]]]:
    """Run a benchmark; return the rows of its tables, cells by header; a second one has a 2."""
    done = run(name, *options)
    assert done.returncode == 0, done.stderr
    machine, *blocks = done.stdout.strip().split("\n\n")
    assert re.match(r"\d+ cores \(.+\), Python 3\.\d+\.\d+", machine)
    tables = []
    for lines in (block.splitlines() for block in blocks if block.startswith("|")):
        cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
        heads = [head + "2" * cells[0][:at].count(head) for at, head in enumerate(cells[0])]
        assert re.fullmatch(r"\|( -+:? \|)+", lines[1])
        tables.append([dict(zip(heads, row, strict=True)) for row in cells[2:]])
    assert tables and all(tables)
    return tables


def bounds(cell: str) -> tuple[float, float]:
    """Return what a printed number may have been before it was rounded to its decimals."""
    number = float(cell.replace(",", ""))
    half = 0.5 * 10.0 ** -len(cell.partition(".")[2])
    return number - half, number + half


def is_quotient(cell: str, over: str, under: str) -> bool:
    """Whether a printed number can be the quotient of two others, all three rounded."""
    (low, high), (over_low, over_high) = bounds(cell), bounds(over)
    under_low, under_high = bounds(under)
    assert under_low > 0, f"{under}: too small a number to divide by with its decimals"
    slack = 1e-9  # of the floating point
    return over_low / under_high <= high + slack and low - slack <= over_high / under_low


def test_a_quotient_is_judged_within_the_rounding_of_its_parts() -> None:
    # (0.425 to 0.435) / (1.215 to 1.225) is 0.3469 to 0.3580: 0.4 is 0.35 and more, rounded.
    assert is_quotient("0.4", "0.43", "1.22")
    assert not is_quotient("0.5", "0.43", "1.22") and not is_quotient("0.2", "0.43", "1.22")
    assert is_quotient("5,000", "1000", "0.200") and not is_quotient("5,200", "1000", "0.200")


@pytest.mark.slow
def test_load(tiny_split: Path) -> None:
    options = ("--rounds", "1", "--lerobot-frames", "3", "--chunk", "8")
    loading, streaming = printed("load", "--split", tiny_split, *options)
    assert [row["aim"] for row in loading] == ["≤ 1.1", "≤ 0.7", "", "≥ 15", "≥ 15", "≤ 3"]
    # One round: the printed ratio is that of the printed times, but for the cells' rounding.
    for row in loading[:5]:
        assert is_quotient(row["ratio"], row["s"], row["s2"])
    # A lesson of 48 frames, 32 a unit; 32 × 32 × 3 bytes a frame.
    frames = {"k0": 48, "k1": 80, "k3": 144, "k7": 272, "k7, 4 times as long": 1088}
    assert [(row["buffer"], row["frames"], row["decoded MB"]) for row in streaming] == [
        (name, f"{count:,}", f"{count * 32 * 32 * 3 / 1e6:.1f}") for name, count in frames.items()
    ]


@pytest.mark.slow
def test_files(tiny_split: Path) -> None:
    ((cost,), reading) = printed("files", "--split", tiny_split, "--rounds", "1", "--items", "3")
    assert float(cost["ratio"]) > 1  # a file is more than the packets in it
    # Two cameras of three lessons and of seventeen units; one file a camera when concatenated.
    assert [row["a file an episode"].split(",")[0] for row in reading] == ["6 files", "34 files"]
    assert [row["concatenated"].split(",")[0] for row in reading] == ["2 files", "2 files"]


@pytest.mark.slow
def test_build() -> None:
    (rows,) = printed("build", "--source", "sample:MoveCube", "--rounds", "1", "--workers", "1")
    assert rows[0]["step"] == "bare encoder (PyAV)"
    assert rows[0]["of bare"] == "1.00"
    for row in rows:
        assert is_quotient(row["frames/s"], "1000.000", row["ms a frame"])


def test_manifests() -> None:
    (rows,) = printed("manifests", "--units", "90", "--queries", "9", "18", "--rounds", "1")
    assert [(row["queries"], row["buffers"]) for row in rows] == [("9", "90"), ("18", "180")]


def test_policies(tiny_split: Path) -> None:
    split = ("--split", tiny_split, "--episode", "MoveCube/test/0")
    feeding, decoding = printed("policies", "--lesson", "10", "--rounds", "1", *split)
    assert feeding[0]["ratio"] == decoding[0]["ratio"] == "1.00"
    # 10 + 7 × 32 + 1 frames of 256 × 256 × 3 bytes, and a little around them.
    size = 235 * 256 * 256 * 3 / 1e6
    assert all(is_quotient(row["MB/s"], f"{size * 1e3:.0f}", row["ms"]) for row in feeding)
    assert is_quotient(decoding[1]["ratio"], decoding[1]["ms"], decoding[0]["ms"])


@pytest.mark.slow
def test_score() -> None:
    pytest.importorskip("pandas")
    grid, repeats = printed("score", "--rounds", "1", "--repeats", "2", "--draws", "50")
    # 11 systems × 5 conditions and one under one condition, × 9 families × 50 episodes
    assert {row["rows"] for row in grid} == {"25,200"}
    assert {row["rows"] for row in repeats} == {"50,400"}
    for row in grid:
        assert is_quotient(row["× score"], row["s"], grid[0]["s"])


@pytest.mark.parametrize("name", NAMES)
def test_help_and_refusals(name: str) -> None:
    shown = run(name, "--help")
    assert shown.returncode == 0 and "--rounds" in shown.stdout
    refused = run(name, "--rounds", "0")
    assert refused.returncode == 2
    assert "'0' is not a positive number" in refused.stderr


def test_a_folder_that_is_no_split_is_refused_without_traceback(tmp_path: Path) -> None:
    refused = run("load", "--split", tmp_path)
    assert refused.returncode == 1
    assert "is not a split" in refused.stderr and "Traceback" not in refused.stderr


def test_ratio_is_the_median_of_the_rounds_own_ratios(timing: ModuleType) -> None:
    times = timing.Times({"a": [2.0, 30.0, 6.0], "b": [1.0, 10.0, 4.0]})
    assert times.median("a") == 6.0
    assert times.ratio("a", "b") == 2.0  # of 2, 3 and 1.5


def test_ways_are_timed_in_turns_after_a_warm_up(timing: ModuleType) -> None:
    calls: list[str] = []
    ways = {name: lambda name=name: calls.append(name) for name in "abc"}
    times = timing.interleave(ways, 2)
    assert "".join(calls) == "abc" + "cba" + "abc"
    assert {name: len(seconds) for name, seconds in times.seconds.items()} == dict.fromkeys(
        "abc", 2
    )


def test_peak_memory_is_this_process_own() -> None:
    held = np.ones(200 * 2**20, np.uint8)  # must not count for the process that is started
    code = "import timing; a = timing.peak_memory(); b = b'x' * 2**26; c = timing.peak_memory()"
    shown = subprocess.run(
        [sys.executable, "-c", f"{code}; print(a, c - a)"],
        cwd=FOLDER,
        capture_output=True,
        text=True,
        check=True,
    )
    before, grown = map(int, shown.stdout.split())
    assert before < held.nbytes
    assert 2**26 - 2**20 < grown < 2**26 + 2**22


def test_a_fresh_process_is_another_one(timing: ModuleType) -> None:
    assert timing.in_fresh_process(os.getpid) != os.getpid()


def test_table_is_aligned_markdown(timing: ModuleType) -> None:
    text = timing.table("Title.", ["<name", ">s"], [["one", "1.50"], ["three", "12.00"]])
    assert text.splitlines() == [
        "Title.",
        "",
        "| name  |     s |",
        "| ----- | ----: |",
        "| one   |  1.50 |",
        "| three | 12.00 |",
    ]


@pytest.mark.parametrize("text", ["0", "-1", "1.5", "many", ""])
def test_only_positive_numbers_are_taken(timing: ModuleType, text: str) -> None:
    assert timing.positive("7") == 7
    with pytest.raises(argparse.ArgumentTypeError, match="is not a positive number"):
        timing.positive(text)
