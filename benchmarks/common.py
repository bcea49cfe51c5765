"""What the benchmarks share: interleaved timing, peak memory, the machine, a table, a buffer set.

Imported first, it also finds the tests' helpers (`support`).
"""

import argparse
import gc
import multiprocessing
import os
import platform
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from robomme_interference_data.errors import InterferenceError

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "tests"))


def run(main: Callable[[], None]) -> None:
    """Run a benchmark; an error of the package ends it with its message alone."""
    try:
        main()
    except InterferenceError as error:
        sys.exit(str(error))


def add_buffer_set(parser: argparse.ArgumentParser) -> None:
    """Let the command line name a buffer set."""
    text = "folder of a buffer set; by default that of make demo, made if need be"
    parser.add_argument("--buffer-set", type=Path, help=text)


def demo_buffers() -> Path:
    """Return the buffer set of `make demo`, made now if it is not there."""
    buffer_set = ROOT / "demo" / "buffers"
    if not (buffer_set / "manifests" / "manifest.json").is_file():
        demo = [sys.executable, str(ROOT / "scripts" / "demo.py")]
        subprocess.run(demo, check=True, stdout=sys.stderr)
    return buffer_set


@dataclass(frozen=True)
class Times:
    """Seconds that each way took, one number a round."""

    seconds: Mapping[str, Sequence[float]]

    def median(self, way: str) -> float:
        """Return the median seconds of a way."""
        return statistics.median(self.seconds[way])

    def ratio(self, way: str, against: str) -> float:
        """Return how many times as long a way took: the median of the rounds' own ratios.

        A round's ratio compares two times taken one after the other, so what else the machine
        did at that time weighs on both.
        """
        pairs = zip(self.seconds[way], self.seconds[against], strict=True)
        return statistics.median(one / other for one, other in pairs)


def interleave(
    ways: Mapping[str, Callable[[], object]],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> Times:
    """Time several ways in turn, A B C, C B A, A B C, …, after one round of warm-up."""
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    order = list(ways)
    for number in range(rounds + 1):
        for name in order:
            gc.disable()  # a collection would fall on whichever way happens to run
            began = clock()
            ways[name]()
            ended = clock()
            gc.enable()
            if number > 0:
                seconds[name].append(ended - began)
        order.reverse()
    return Times(seconds)


def in_fresh_process[T](function: Callable[..., T], *arguments: object) -> T:
    """Call a module-level function in a new Python process and return its result."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        return pool.submit(function, *arguments).result()


def peak_memory() -> int:
    """Return the most memory that this process has held so far, in bytes."""
    status = Path("/proc/self/status")
    if status.exists():
        # Not ru_maxrss: on Linux it starts at the size of the process that started this one.
        found = re.search(r"VmHWM:\s+(\d+) kB", status.read_text())
        if found:
            return int(found[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def print_machine(*distributions: str) -> None:
    """Print the processor, and the versions of Python and of distributions."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        found = re.search(r"model name\s*: (.+)", cpuinfo.read_text())
        model = found[1] if found else model
    versions = [f"{name} {metadata.version(name)}" for name in distributions]
    python = f"Python {platform.python_version()}"
    print(", ".join([f"{os.cpu_count()} cores ({model})", python, *versions]), flush=True)


def megabytes(size: float) -> str:
    """Return a size in bytes as MB (10⁶ bytes), for a table."""
    return f"{size / 1e6:,.1f}"


def positive(text: str) -> int:
    """Read a positive number from the command line (a `type` of argparse)."""
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return int(text)


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a Markdown table.

    Args:
        title: Sentence above the table.
        columns: Headers, each after its alignment: `<` left or `>` right.
        rows: Cells, row by row.
    """
    sides = [column[0] for column in columns]
    lines = [[column[1:] for column in columns], *map(list, rows)]
    widths = [max(map(len, cells)) for cells in zip(*lines, strict=True)]
    laid = [
        "| " + " | ".join(f"{c:{s}{w}}" for c, s, w in zip(line, sides, widths, strict=True)) + " |"
        for line in lines
    ]
    rules = ["-" * (w - 1) + {"<": "-", ">": ":"}[s] for s, w in zip(sides, widths, strict=True)]
    print("\n".join(["", title, "", laid[0], f"| {' | '.join(rules)} |", *laid[1:]]), flush=True)
