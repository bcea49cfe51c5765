"""The process that runs RoboMME: `worker.py` in RoboMME's interpreter, connected by a pipe."""

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
from robomme_interference_data.runtime.safe_path import SAFE_PATH
from robomme_interference_data.storage.cache import cache_folder

from . import versions as robomme_versions
from . import worker as robomme_worker

PYTHON_VARIABLE = "ROBOMME_PYTHON"
"""Environment variable with the path of RoboMME's interpreter."""

_ENVIRONMENT = {
    "PYTHONFAULTHANDLER": "1",  # a crash in a library prints a traceback
    SAFE_PATH: "1",  # nor may files beside the worker hide modules of the same names
    "PYTHONUNBUFFERED": "1",  # the last lines are not lost when it dies
}


def _advice() -> str:
    return (
        "Install RoboMME (https://github.com/RoboMME/robomme_benchmark) into a separate "
        f"environment, and set the environment variable {PYTHON_VARIABLE} to the path of its "
        "Python."
    )


Arrays = dict[str, NDArray[Any]]


class Process:
    """RoboMME's process; see `RoboMMESimulator` for the errors that its methods raise.

    `pid` is None after it has ended; `played` counts the episodes of its user.
    """

    def __init__(self, python: str, answer_s: float):
        self._python, self._answer_s = python, answer_s
        self._log: deque[bytes] = deque(maxlen=PRINTED_LINES)
        self._channel, theirs = Pipe()
        folder = cache_folder("robomme")
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [python, robomme_worker.__file__, str(theirs.fileno()), str(folder)],
                    pass_fds=[theirs.fileno()],
                    env={**os.environ, **_ENVIRONMENT},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                )
        except OSError as error:
            self._channel.close()
            raise _unusable(python, error) from error
        self.pid: int | None = self._process.pid
        self.played = 0
        self._logger = threading.Thread(target=self._keep_log, daemon=True)
        self._logger.start()
        hello, _ = self._answer("start")
        if "problem" in hello:
            self.end()
            raise MissingExtraError(f"{python} cannot run RoboMME: {hello['problem']}", _advice())
        self.families: tuple[str, ...] = tuple(hello["families"])
        self.patches: tuple[str, ...] = tuple(hello["patches"])

    def call(self, call: str, **arguments: Any) -> tuple[dict[str, Any], Arrays]:
        """Call `reset`, `step`, `act` or `follow` of the worker."""
        with suppress(OSError):  # if it died, reading the answer raises
            robomme_worker.send(self._channel, {"call": call, **arguments})
        answer, arrays = self._answer(call)
        if "unknown" in answer:
            raise UnknownNameError(f"no such episode: in robomme {answer['unknown']}")
        if "failed" in answer:
            raise self.error(f"failed during {call}: {answer['failed']}")
        return answer, arrays

    def _answer(self, call: str) -> tuple[dict[str, Any], Arrays]:
        try:
            if self._channel.poll(self._answer_s):
                return robomme_worker.receive(self._channel)
        except (EOFError, OSError) as error:
            self.end()
            raise self.error(f"died during {call}, exit code {self._process.returncode}") from error
        except BaseException:  # such as Ctrl-C: the next call must not read this answer
            self.end(now=True)
            raise
        self.end(now=True)
        raise self.error(f"took more than {self._answer_s:g} s to {call}; its process was ended")

    def error(self, what: str) -> SimulatorCrashError:
        """Return an error with the last printed lines as its hint."""
        if self.pid is None:
            self._logger.join(5)  # until all output is read
        return SimulatorCrashError(
            f"the robomme simulator in {self._python} {what}", printed_last(list(self._log))
        )

    def end(self, *, now: bool = False) -> None:
        """End the process, if it runs."""
        self.pid = None
        self._channel.close()  # then the worker exits
        if now:
            self._process.kill()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _keep_log(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            self._log.extend(lines)


def _unusable(python: str, error: Exception) -> InvalidOptionError:
    return InvalidOptionError(f"{python} cannot be run as RoboMME's Python: {error}", _advice())


@cache
def installed_versions(python: str) -> dict[str, str]:
    """Return the versions in an interpreter, and the patches, without starting RoboMME."""
    try:
        output = subprocess.check_output(
            [python, robomme_versions.__file__, str(cache_folder("robomme"))],
            env={**os.environ, **_ENVIRONMENT},
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=300,  # importing ManiSkill takes 10 s, on overloaded machines far longer
        )
        versions: dict[str, str] = json.loads(output)
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise _unusable(python, error) from error
    return versions


def find_python(python: str | os.PathLike[str] | None) -> str:
    """Return the absolute path of RoboMME's interpreter.

    `python` is a path, or the name of a program on `PATH`; None reads `ROBOMME_PYTHON`.
    """
    given = os.fspath(python) if python is not None else os.environ.get(PYTHON_VARIABLE, "")
    if not given:
        raise InvalidOptionError(
            "the robomme simulator needs RoboMME's own Python, and none is given", _advice()
        )
    # As text: `Path` would remove a leading "./" and leave the name of a program.
    if (executable := shutil.which(os.path.expanduser(given))) is None:  # noqa: PTH111
        raise InvalidOptionError(f"{given} is not an executable file", _advice())
    # Not resolved: the interpreter of a virtual environment is a link.
    return os.path.abspath(executable)  # noqa: PTH100
