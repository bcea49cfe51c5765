"""The benchmarks run, at their smallest size, and print what docs/performance.md shows."""

import argparse
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import factories
import numpy as np
import pytest

from robomme_interference_data import Dataset
from robomme_interference_data.files import LocalFiles

FOLDER = Path(__file__).parent.parent / "benchmarks"


@pytest.fixture(scope="module")
def timing() -> ModuleType:
    return module("timing")


def module(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"benchmark_{name}", FOLDER / f"{name}.py")
    assert spec is not None and spec.loader is not None
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = loaded  # dataclasses look their module up
    spec.loader.exec_module(loaded)
    return loaded


def run(name: str, *options: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(FOLDER / f"{name}.py"), *map(str, options)]
    return subprocess.run(command, capture_output=True, text=True, timeout=560, check=False)


def printed(name: str, *options: str | Path) -> list[list[list[str]]]:
    """Run a benchmark; return the cells of its tables, without headers."""
    done = run(name, *options)
    assert done.returncode == 0, done.stderr
    machine, *blocks = done.stdout.strip().split("\n\n")
    assert re.match(r"\d+ cores \(.+\), Python 3\.\d+\.\d+, ", machine)
    tables = [block.splitlines() for block in blocks if block.startswith("|")]
    assert tables and all(re.fullmatch(r"\|( -+:? \|)+|\|( -+[-:] \|)+", t[1]) for t in tables)
    return [[[c.strip() for c in line.strip("|").split("|")] for line in t[2:]] for t in tables]


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
def test_load_prints_times_ratios_and_memory() -> None:
    options = ("--rounds", "1", "--lerobot-frames", "3", "--chunk", "8")
    split = factories.split()
    loading, streaming = printed("load", "--split", split, *options)
    assert [row[0] for row in loading] == [
        "Buffer.frames(), 1 thread",
        "Buffer.frames(), 2 threads",
        "Buffer.frames(), 1 thread",
        "LeRobotDataset[i], pyav",
        "LeRobotDataset[i], pyav",
        "Buffer.frames(), cached, 1 thread",
    ]
    assert [row[5] for row in loading] == ["≤ 1.1", "≤ 0.7", "", "≥ 15", "≥ 15", "≤ 3"]
    # One round: the printed ratio is that of the printed times, but for the cells' rounding.
    for _, seconds, _, other, ratio, _ in loading[:5]:
        assert is_quotient(ratio, seconds, other)
    # Median lesson: 20 or 36 frames, the smaller one; 32 frames a unit; 64 × 64 × 3 bytes a frame.
    frames = {"k0": 20, "k1": 52, "k3": 116, "k3, 4 times as long": 464}
    assert [row[:3] for row in streaming] == [
        [name, str(count), f"{count * 64 * 64 * 3 / 1e6:.1f}"] for name, count in frames.items()
    ]


@pytest.mark.slow
def test_build_prints_frames_per_second_of_each_step() -> None:
    source = f"frames:{factories.sample()}"
    (rows,) = printed("build", "--source", source, "--rounds", "1", "--workers", "1")
    assert [row[0] for row in rows] == [
        "bare encoder (PyAV)",
        "encode, hash, statistics",
        "… and decode again to verify",
        "… and read the recording",
        "whole build, 1 process",
        "whole build, 1 processes",
    ]
    assert rows[0][3] == "1.00"
    for _, milliseconds, rate, share, _ in rows:
        assert is_quotient(rate, "1000.000", milliseconds)
        assert 0 < float(share) < 1.5
    # Decoding, reading and LeRobot's part cost something even on the noisiest machine.
    assert float(rows[4][1]) > float(rows[0][1])


def test_manifests_prints_how_cost_grows() -> None:
    options = ("--units", "90", "--queries", "9", "18", "--rounds", "1")
    (rows,) = printed("manifests", *options)
    assert [row[0] for row in rows] == ["9", "18"]
    assert rows[0][2:4] == ["", ""]  # nothing above the first line
    assert all(float(cell.replace(",", "")) >= 0 for cell in rows[1][4:])
    assert float(rows[1][2]) > 0


def test_policies_prints_the_rate_and_the_ratio_to_a_bare_send() -> None:
    split = ("--split", factories.split(), "--episode", "MoveCube/test/0")
    rows, decoding = printed("policies", "--lesson", "10", "--rounds", "1", *split)
    assert [row[0] for row in rows] == [
        "bare send of the same bytes",
        "WebsocketPolicy",
        "WebsocketPolicy, server unpacks",
    ]
    assert rows[0][3] == "1.00"
    # 10 + 7 × 32 + 1 frames of 256 × 256 × 3 bytes, and a little around them.
    size = 235 * 256 * 256 * 3 / 1e6
    for _, milliseconds, rate, ratio in rows:
        assert is_quotient(rate, f"{size * 1e3:.0f}", milliseconds)
        assert float(ratio) > 0
    (turn, in_turn, one), (name, ahead, ratio) = decoding
    assert (turn, name) == ("decode a chunk, send it", "decode ahead, as evaluate does")
    assert one == "1.00" and is_quotient(ratio, ahead, in_turn)


@pytest.mark.slow
def test_score_prints_times_ratios_and_memory() -> None:
    pytest.importorskip("pandas")
    options = ("--rounds", "1", "--repeats", "2", "--draws", "50")
    grid, repeats = printed("score", *options)
    ways = ["score", "pandas, draws shared by hand", "pandas, scipy.stats.bootstrap"]
    # 11 systems × 5 conditions and one under one condition, × 9 families × 50 episodes
    assert [row[:2] for row in grid] == [["25,200", way] for way in ways]
    assert [row[:2] for row in repeats] == [["50,400", way] for way in ways[:2]]
    assert grid[0][3] == repeats[0][3] == repeats[0][5] == "1.0"
    for _, _, seconds, ratio in grid[1:]:
        assert is_quotient(ratio, seconds, grid[0][2])
    assert all(float(row[4].replace(",", "")) > 0 for row in repeats)


def test_all_ways_of_scoring_find_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pandas = pytest.importorskip("pandas")
    monkeypatch.syspath_prepend(FOLDER)  # for what the benchmarks share
    score = module("score")
    monkeypatch.setattr(score, "SYSTEMS", 2)
    rows = score.write_rows(tmp_path / "rows.parquet", 1)
    found = {}
    for place, (way, call) in enumerate(score.WAYS.items()):
        call(rows, out := tmp_path / str(place), 2000)
        found[way] = {path.stem: pandas.read_csv(path) for path in out.glob("*.csv")}
    tables = found.pop("score")
    main, effects = tables["main"], tables["effects"]
    effects = effects[effects["condition"] == "k7"]
    for other in found.values():
        assert other["main"]["mean"].tolist() == pytest.approx(
            main.dropna(subset="rate").sort_values(["system", "condition"])["rate"].tolist(),
            abs=1e-6,
        )
        same = other["effects"].query("condition == 'k7' and against == 'k0'")
        assert same["value"].tolist() == pytest.approx(effects["difference"].tolist(), abs=1e-6)
        assert same["p"].tolist() == pytest.approx(effects["p"].tolist(), rel=1e-5)
        for bound in ("low", "high"):  # of other draws
            assert same[bound].tolist() == pytest.approx(effects[bound].tolist(), abs=0.01)


@pytest.mark.slow
def test_retrieval_prints_rates_times_and_memory() -> None:
    pytest.importorskip("transformers")
    options = ("--model", "tiny", "--device", "cpu", "--rounds", "1", "--queries", "9")
    sizes = ("--history", "5000", "--size", "16")
    index, lookup, history = printed("retrieval", "--split", factories.split(), *options, *sizes)
    assert [row[0] for row in index] == ["index, thumbnail", "index, siglip tiny"]
    assert [row[2] for row in index] == ["bare decoding", "bare forward pass"]
    assert index[1][5] == "≥ 0.95"
    for _, rate, _, other, ratio, _ in index:  # one round: the ratio is that of the rates
        assert is_quotient(ratio, rate, other)
    # Nine queries at four k; lessons of up to 1,071 frames.
    assert [row[0] for row in lookup][2] == "grading 36 buffers"
    assert all(float(row[1].replace(",", "")) > 0 for row in lookup)
    # A block of 4,096 rows as float32 for one way, all 5,000 for the other; a little around them.
    block, whole = 4096 * 16 * 4 / 1e6, 5000 * 16 * 4 / 1e6
    for row in history:
        assert block <= float(row[2]) + 0.05 and float(row[2]) < 3 * block
        assert whole <= float(row[5]) + 0.05 and float(row[5]) < 1.5 * whole


@pytest.mark.slow
def test_made_up_episode_tables_have_the_columns_of_real_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(FOLDER)  # for what the benchmarks share
    manifests = module("manifests")
    for kind in ("demonstrations", "distractors"):
        made_up = Dataset(LocalFiles(manifests.write_episodes(tmp_path / kind, kind, 11)))
        real = Dataset(LocalFiles(factories.split() / kind))
        assert made_up.episodes.schema.names == real.episodes.schema.names
        assert [str(t) for t in made_up.episodes.schema.types] == [
            str(t) for t in real.episodes.schema.types
        ]
        assert len(list(made_up.records())) == 11


@pytest.mark.parametrize(
    "name", ["load", "build", "manifests", "policies", "evaluate", "score", "retrieval"]
)
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
