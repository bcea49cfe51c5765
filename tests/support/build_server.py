"""Runs the command line again and again, each time in a process of its own that can be killed.

Importing lerobot takes longer than the builds of these tests, so it is imported once, here, and
every command runs in a fork. Only for tests; used through `BuildServer`.
"""

import json
import multiprocessing.util
import os
import subprocess
import sys
import time
import uuid
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

_MARK = "ROBOMME_INTERFERENCE_TEST_SERVER"


@dataclass
class Finished:
    """How a command ended: its exit code (negative: the signal) and what it printed."""

    code: int
    stderr: str


class BuildServer:
    """Starts commands; use as a context manager.

    Args:
        log: File for what a command prints.
        hash_seed: Value of PYTHONHASHSEED.
    """

    def __init__(self, log: Path, hash_seed: int):
        self._log = log
        self.mark = uuid.uuid4().hex
        environment = {
            **os.environ,
            _MARK: self.mark,
            "PYTHONHASHSEED": str(hash_seed),
            "OPENBLAS_NUM_THREADS": "1",
        }
        self._process = subprocess.Popen(
            [sys.executable, __file__, str(log)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )

    def __enter__(self) -> "BuildServer":
        assert self._ask(None) == "ready"
        return self

    def __exit__(self, *exception: object) -> None:
        assert self._process.stdin
        self._process.stdin.close()
        self._process.wait(60)

    def start(self, *arguments: object) -> int:
        """Start a command in a process group of its own; returns its process id."""
        return self._ask(["start", *map(str, arguments)])

    def wait(self, pid: int) -> Finished:
        """Wait for a command to end."""
        return Finished(self._ask(["wait", pid]), self._log.read_text())

    def run(self, *arguments: object) -> Finished:
        """Run a command to its end."""
        return self.wait(self.start(*arguments))

    def survivors(self, patience: float) -> dict[int, str]:
        """Processes of commands that still run after so many seconds, with their command line."""
        end = time.monotonic() + patience
        while (found := self._running()) and time.monotonic() < end:
            time.sleep(0.05)
        return found

    def _running(self) -> dict[int, str]:
        found = {}
        for folder in Path("/proc").iterdir():
            try:
                pid = int(folder.name)
                environment = (folder / "environ").read_bytes()
                command = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except (ValueError, OSError):
                continue
            if f"{_MARK}={self.mark}".encode() in environment and pid != self._process.pid:
                found[pid] = command
        return found

    def _ask(self, question: Any) -> Any:
        assert self._process.stdin
        assert self._process.stdout
        if question is not None:
            self._process.stdin.write(json.dumps(question) + "\n")
            self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


def _serve(log: str) -> None:
    from robomme_interference_data.build_dataset.dataset.lerobot_writer import load_lerobot
    from robomme_interference_data.cli import main as cli

    load_lerobot()
    # The one other thread is pyarrow's allocator, which is made to be forked.
    warnings.filterwarnings("ignore", message=".*multi-threaded", category=DeprecationWarning)
    _say("ready")
    for line in sys.stdin:
        action, *rest = json.loads(line)
        if action == "wait":
            answer = os.waitstatus_to_exitcode(os.waitpid(rest[0], 0)[1])
        elif (answer := os.fork()) == 0:
            os.setpgid(0, 0)
            file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            for stream in (1, 2):
                os.dup2(file, stream)
            sys.argv = ["robomme-interference", *rest]
            try:
                cli.main()
            except SystemExit as end:
                sys.stderr.flush()
                multiprocessing.util._exit_function()  # as at the end of any interpreter
                os._exit(end.code if isinstance(end.code, int) else 1)
        if action == "start":
            with suppress(OSError):  # whoever of the two comes first
                os.setpgid(answer, answer)
        _say(answer)
    os._exit(0)  # taking the libraries down takes seconds


def _say(answer: Any) -> None:
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    _serve(sys.argv[1])
