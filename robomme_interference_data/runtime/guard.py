"""Ends everything that a worker started, when the worker or the process that started it is gone.

    python guard.py WORKER PARENT_FD HOME

It runs in the worker's process group, so that the group's number cannot become another's, and
imports nothing of the package. PARENT_FD closes with the parent; -1 where a cluster watches the
worker. HOME is the worker's folder: its parent removes it, or, after a while, this process.
"""

import os
import select
import shutil
import signal
import subprocess
import sys

_REMOVE = ["sh", "-c", 'sleep 60; rm -rf -- "$0"']


def main() -> None:
    """Wait for the end of either, then kill the process group, this process included."""
    worker, parent, home = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
    watched = [parent] if parent >= 0 else []
    while os.getppid() == worker and not select.select(watched, [], [], 0.2)[0]:
        pass
    if not watched:
        subprocess.Popen([*_REMOVE, home], start_new_session=True)
    elif select.select(watched, [], [], 0)[0]:
        shutil.rmtree(home, ignore_errors=True)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    main()
