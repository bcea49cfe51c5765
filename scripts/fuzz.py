"""Feed a reader files that are wrong in a million ways, and keep those that it does not survive.

Inputs are read in child processes, a batch in each: one that crashes or hangs, in this package or
in a library under it, ends its child alone. It is kept in the folder given, named after what went
wrong; the same seed gives the same inputs. Findings so far:
`docs/explanation/untrusted-data.md`.

    python scripts/fuzz.py buffers --inputs 1000000
    python scripts/fuzz.py all --seconds 60
    python scripts/fuzz.py video --read FILE    # reads one file again
"""

import argparse
import json
import mmap
import os
import random
import resource
import select
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
sys.path.insert(0, str(ROOT / "tests"))

BATCH = 1000
"""Inputs that a child reads."""

LONGEST_S = 20
"""Seconds that one input may take."""

LONGEST_BOMB = 1 << 20
"""Bytes of a bomb that is mutated, too."""

MAX_BYTES = 4 << 30
"""Address space that a child gets beside what it has."""


def main() -> None:
    """Fuzz one target, or all in turn."""
    options = _options()
    from support.hostile import TARGETS

    for name in TARGETS if options.target == "all" else [options.target]:
        if options.read:
            with tempfile.TemporaryDirectory() as folder:
                print(repr(_place(TARGETS[name], folder)[2](options.read.read_bytes())))
            continue
        started = time.monotonic()
        count, refused, found = _mutate(name, options)
        print(
            json.dumps(
                {
                    "target": name,
                    "inputs": count,
                    "refused": refused,
                    "seconds": round(time.monotonic() - started, 1),
                    "findings": dict(found),
                }
            ),
            flush=True,
        )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("target", help="Name of a reader in tests/support/hostile.py, or all.")
    parser.add_argument("--inputs", type=int, default=1_000_000, help="Inputs of each target.")
    parser.add_argument("--seconds", type=float, help="Stop each target after so long.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("build/fuzz"), help="What is kept.")
    parser.add_argument("--read", type=Path, help="Read this file alone, in this process.")
    return parser.parse_args()


def _place(target: Any, folder: str) -> tuple[list[bytes], list[bytes], Any]:
    """Return sound files of a target, bombs of its kind, and what reads bytes in their place."""
    from support.bombs import BOMBS
    from support.hostile import places

    root = places(Path(folder))
    kind = {".parquet": "parquet", ".mp4": "video"}.get(Path(target.path).suffix)
    bombs = []
    for bomb in BOMBS.values():
        if bomb.kind == kind:
            bomb.write(root / "bomb")
            if (root / "bomb").stat().st_size <= LONGEST_BOMB:
                bombs.append((root / "bomb").read_bytes())
    return target.sound(root), bombs, lambda data: target(root, data)


def _keep(out: Path, name: str, what: str, data: bytes, told: str) -> str:
    """Keep an input and what it led to."""
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    place = folder / sha256(data).hexdigest()[:16]
    place.write_bytes(data)
    place.with_suffix(".txt").write_text(f"{what}\n{told}\n", errors="backslashreplace")
    return what


def _mutate(name: str, options: argparse.Namespace) -> tuple[int, int, Counter[str]]:
    """Mutate sound files at random, in children of this process."""
    from support.hostile import TARGETS, mutated

    target, found, refused, number = TARGETS[name], Counter[str](), 0, 0
    progress = mmap.mmap(-1, 8)
    with tempfile.TemporaryDirectory(dir="/dev/shm") as folder:
        sound, bombs, read = _place(target, folder)
        end = time.monotonic() + (options.seconds or float("inf"))

        def made(index: int) -> bytes:
            return mutated(sound, random.Random(f"{options.seed} {index}"), bombs)

        while number < options.inputs and time.monotonic() < end:
            stop = min(number + BATCH, options.inputs)
            progress[:] = number.to_bytes(8, "little")
            ours, theirs = os.pipe()
            child = os.fork()
            if child == 0:
                os.close(ours)
                _child(range(number, stop), made, read, progress, theirs, (options.out, name, end))
            os.close(theirs)
            report, ending = _wait(child, ours, progress)
            reached = int.from_bytes(progress[:], "little")
            if report is None:
                data = made(reached)
                found[_keep(options.out, name, ending, data, f"input {reached}")] += 1
                number = reached + 1
            else:
                refused += report["refused"]
                found.update(report["found"])
                number = reached
    return number, refused, found


def _child(
    numbers: range, made: Any, read: Any, progress: mmap.mmap, report: int, about: Any
) -> None:
    """Read inputs, and never return."""
    (out, name, end), refused, found = about, 0, Counter[str]()
    with suppress(ValueError):
        used = int(Path("/proc/self/statm").read_text().split()[0]) * mmap.PAGESIZE
        resource.setrlimit(resource.RLIMIT_AS, (used + MAX_BYTES, used + MAX_BYTES))
    for number in numbers:
        progress[:] = number.to_bytes(8, "little")
        data = made(number)
        try:
            refused += read(data) is not None
        except Exception as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            what = f"{type(error).__name__} in {Path(last.filename).name}:{last.lineno}"
            found[_keep(out, name, what, data, traceback.format_exc())] += 1
        if time.monotonic() > end:
            break
    progress[:] = (number + 1).to_bytes(8, "little")
    os.write(report, json.dumps({"refused": refused, "found": found}).encode())
    os._exit(0)


def _wait(child: int, pipe: int, progress: mmap.mmap) -> tuple[dict[str, Any] | None, str]:
    """Wait for a child; return its report, or None and how it ended."""
    last, since = progress[:], time.monotonic()
    hung = False
    while not select.select([pipe], [], [], 0.5)[0]:
        if progress[:] != last:
            last, since = progress[:], time.monotonic()
        elif time.monotonic() - since > LONGEST_S:
            hung = True
            os.kill(child, signal.SIGKILL)
            break
    data = b"".join(iter(lambda: os.read(pipe, 65536), b""))
    os.close(pipe)
    _, status = os.waitpid(child, 0)
    if data:
        return json.loads(data), ""
    return (
        None,
        f"over {LONGEST_S} s" if hung else f"ended with {os.waitstatus_to_exitcode(status)}",
    )


if __name__ == "__main__":
    main()
