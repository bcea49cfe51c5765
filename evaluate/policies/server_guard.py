"""Runs a command, and ends all that it has started when whoever asked for it is gone.

    python server_guard.py COMMAND …

It is run by path, imports nothing of the package, and its stdin is a pipe that nobody writes to:
when that closes, its process group, in which the command is, is asked to end, and made to.
"""

import os
import signal
import subprocess
import sys
import threading
import time

_END_S = 5.0
"""Seconds that the command has to end when it is asked to."""


def main() -> None:
    """Run the command of the command line; its exit code is that of the command."""
    process = subprocess.Popen(sys.argv[1:], stdin=subprocess.DEVNULL)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it asks its whole group to end
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
    main()
