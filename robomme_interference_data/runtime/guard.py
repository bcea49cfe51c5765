"""Ends a process group when the process that needs it is gone. Imports nothing of the package.

    python guard.py --worker WORKER PARENT_FD HOME
    python guard.py COMMAND …

The first form runs in the group of a worker process, so that the group's number stays taken. It
ends the group when the worker ends or PARENT_FD closes (-1 where a cluster watches the worker), and
removes the worker's folder HOME, after a while where its parent may still read it.

The second form runs a command in its own group until the command ends or stdin closes.
"""

import os
import select
import shutil
import signal
import subprocess
import sys
import threading
import time

_END_S = 5.0
"""Seconds that a command has to end after SIGTERM."""

_REMOVE_LATER = ["sh", "-c", 'sleep 60; rm -rf -- "$0"']


def _watch_worker(worker: int, parent: int, home: str) -> None:
    watched = [parent] if parent >= 0 else []
    # A change of the parent process wakes nobody, so it is looked at five times a second.
    while os.getppid() == worker and not select.select(watched, [], [], 0.2)[0]:
        pass
    if not watched:
        subprocess.Popen([*_REMOVE_LATER, home], start_new_session=True)
    elif select.select(watched, [], [], 0)[0]:
        shutil.rmtree(home, ignore_errors=True)
    os.killpg(0, signal.SIGKILL)


def _run(command: list[str]) -> None:
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # sent to the whole group below
    threading.Thread(target=_end_with_stdin, args=(process,), daemon=True).start()
    code = process.wait()
    os.killpg(0, signal.SIGTERM)
    os._exit(code if code >= 0 else 128 - code)


def _end_with_stdin(process: subprocess.Popen[bytes]) -> None:
    while os.read(0, 1 << 16):
        pass
    os.killpg(0, signal.SIGTERM)
    end = time.monotonic() + _END_S
    while process.poll() is None and time.monotonic() < end:
        time.sleep(0.05)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    if sys.argv[1] == "--worker":
        _watch_worker(int(sys.argv[2]), int(sys.argv[3]), sys.argv[4])
    else:
        _run(sys.argv[1:])
