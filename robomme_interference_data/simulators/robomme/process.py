"""RoboMME's process: its own interpreter, which answers on a pipe."""

import json
import os
import shutil
import subprocess
import threading
from collections import deque
from contextlib import suppress
from functools import cache
from multiprocessing.connection import Pipe
from typing import Any

from numpy.typing import NDArray

from robomme_interference_data.errors import (
    PRINTED_LINES,
    InvalidOptionError,
    MissingExtraError,
    SimulatorCrashError,
    UnknownNameError,
    printed_last,
)
from robomme_interference_data.storage.cache import default_cache_folder

from . import worker as robomme_worker

PYTHON_VARIABLE = "ROBOMME_PYTHON"
"""Environment variable with the path of RoboMME's interpreter."""

_ENVIRONMENT = {
    "PYTHONFAULTHANDLER": "1",  # a crash in a library leaves a traceback
    "PYTHONSAFEPATH": "1",  # else the worker's neighbours would hide modules of the same names
    "PYTHONUNBUFFERED": "1",  # else what it printed last is lost when it dies
}

_INSTALL = (
    "Install RoboMME (https://github.com/RoboMME/robomme_benchmark) into an environment of its own "
    f"and give its Python: robomme_python=PATH, or export {PYTHON_VARIABLE}=PATH."
)

Arrays = dict[str, NDArray[Any]]


class Process:
    """`worker.py` in RoboMME's interpreter; see `RoboMMESimulator` for what it raises.

    Args:
        python: What `find_python` returned.
        answer_s: Seconds that it may take to start, and for each answer.
    """

    def __init__(self, python: str, answer_s: float):
        self._python, self._answer_s = python, answer_s
        self._log: deque[bytes] = deque(maxlen=PRINTED_LINES)
        self._channel, theirs = Pipe()
        patched = default_cache_folder().parent / "robomme"
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [python, robomme_worker.__file__, str(theirs.fileno()), str(patched)],
                    pass_fds=[theirs.fileno()],
                    env={**os.environ, **_ENVIRONMENT},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                )
        except OSError as error:
            self._channel.close()
            raise InvalidOptionError(
                f"{python} cannot be run as RoboMME's Python: {error}", _INSTALL
            ) from error
        self.pid: int | None = self._process.pid
        self.played = 0
        self._logger = threading.Thread(target=self._keep_log, daemon=True)
        self._logger.start()
        hello, _ = self._answer("start")
        if "problem" in hello:
            self.end()
            raise MissingExtraError(f"{python} cannot run RoboMME: {hello['problem']}", _INSTALL)
        self.families: tuple[str, ...] = tuple(hello["families"])
        self.patches: tuple[str, ...] = tuple(hello["patches"])

    def call(self, call: str, **arguments: Any) -> tuple[dict[str, Any], Arrays]:
        """Call one of the worker's functions, `reset` or `step`."""
        with suppress(OSError):  # it died: the answer will say so
            robomme_worker.send(self._channel, {"call": call, **arguments})
        answer, found = self._answer(call)
        if "unknown" in answer:
            raise UnknownNameError(f"no such episode: in robomme {answer['unknown']}")
        if "failed" in answer:
            raise self.error(f"failed during {call}: {answer['failed']}")
        return answer, found

    def _answer(self, call: str) -> tuple[dict[str, Any], Arrays]:
        try:
            if not self._channel.poll(self._answer_s):
                self.end(now=True)
                raise self.error(
                    f"took more than {self._answer_s:g} s to {call}; its process was ended"
                )
            return robomme_worker.receive(self._channel)
        except (EOFError, OSError) as error:
            self.end()
            raise self.error(f"died during {call}, exit code {self._process.returncode}") from error
        except BaseException:  # such as Ctrl-C: what comes later would be taken for another answer
            self.end(now=True)
            raise

    def error(self, what: str) -> SimulatorCrashError:
        """Return an error that shows what was printed last, without a terminal's escapes."""
        if self.pid is None:
            self._logger.join(5)  # until it has read all
        return SimulatorCrashError(
            f"the robomme simulator in {self._python} {what}", printed_last(list(self._log))
        )

    def end(self, *, now: bool = False) -> None:
        """End the process, if it runs."""
        self.pid = None
        self._channel.close()  # the worker ends when it reads the end of it
        if now:
            self._process.kill()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _keep_log(self) -> None:
        """Keep the last lines that it prints, until it ends."""
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            self._log.extend(lines)


@cache
def installed_versions(python: str) -> dict[str, str]:
    """Return the versions in an interpreter that `find_python` returned; RoboMME is not started."""
    try:
        done = subprocess.run(
            [python, robomme_worker.__file__, "versions"],
            env={**os.environ, **_ENVIRONMENT},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            check=True,
            timeout=60,
        )
        found: dict[str, str] = json.loads(done.stdout)
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise InvalidOptionError(
            f"{python} cannot be run as RoboMME's Python: {error}", _INSTALL
        ) from error
    return found


def find_python(python: str | os.PathLike[str] | None) -> str:
    """Return the absolute path of the interpreter that is given, or that the environment names.

    Args:
        python: A path; or text, which may also be the name of a program, as in a shell.
    """
    given = os.fspath(python) if python is not None else os.environ.get(PYTHON_VARIABLE, "")
    if not given:
        raise InvalidOptionError(
            "the robomme simulator needs RoboMME's own interpreter, and none is given", _INSTALL
        )
    # As text: `Path` would take a "./" away, and the name of a program be left.
    path = os.path.expanduser(given)  # noqa: PTH111
    if isinstance(python, os.PathLike):
        path = os.path.abspath(path)  # noqa: PTH100
    if (found := shutil.which(path)) is None:
        raise InvalidOptionError(f"{given} is not an executable file", _INSTALL)
    # Not resolved: the interpreter of a virtual environment is a link.
    return os.path.abspath(found)  # noqa: PTH100
