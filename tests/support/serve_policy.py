"""A program that serves a policy, for `websocket:COMMAND`."""

import argparse
import asyncio
import json
import os
import shlex
import sys
from pathlib import Path
from typing import Any

from support.policy_server import Memory, PolicyServer, RetraceMemory


def command(*words: object) -> str:
    """The command; the tests' modules have to be on PYTHONPATH."""
    program = [sys.executable, "-m", "support.serve_policy", "--port", "{port}"]
    return shlex.join([*program, *map(str, words)])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--metadata", default='{"checkpoint": "tiny/1"}')
    parser.add_argument("--pids", type=Path, help="where its process id is written")
    parser.add_argument("--dies", type=Path, help="ends at once when asked, until that is there")
    parser.add_argument("--differs", type=Path, help="says something else once that is there")
    parser.add_argument("--leaks", action="store_true", help="retraces, and clears no history")
    given: Any = parser.parse_args()
    memory = RetraceMemory(clears=False) if given.leaks else Memory(keep=False)
    server = PolicyServer(memory, port=given.port)
    server.metadata = json.loads(given.metadata)
    if given.differs is not None and given.differs.exists():
        server.metadata["checkpoint"] = "other"
    if given.differs is not None:
        given.differs.touch()

    def before(message: dict[str, Any]) -> None:
        if given.dies is not None and "prompt" in message and not given.dies.exists():
            given.dies.touch()
            sys.stderr.write("out of memory\n")
            os._exit(3)

    server.before = before
    sys.stderr.write(f"serving at {given.port}\n")
    if given.pids is not None:
        with given.pids.open("a") as file:
            file.write(f"{os.getpid()}\n")
    asyncio.run(server.serve(lambda: None))


if __name__ == "__main__":
    main()
