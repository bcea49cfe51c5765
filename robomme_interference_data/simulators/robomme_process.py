"""RoboMME's interpreter as a process of ours: started, asked, and ended, whatever it does."""

import os
import shutil
import socket
import subprocess
import threading
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.simulators import robomme_worker

__all__ = ["PYTHON_VARIABLE", "RoboMMEProcess", "find_python"]

PYTHON_VARIABLE = "ROBOMME_PYTHON"
"""Environment variable with the path of RoboMME's interpreter."""

_LOG_LINES = 20
"""How much of what the worker printed last is kept, and shown when it breaks."""

_ENVIRONMENT = {
    "PYTHONFAULTHANDLER": "1",  # a crash in a library leaves a traceback
    "PYTHONSAFEPATH": "1",  # else the worker's neighbours would hide modules of the same names
    "PYTHONUNBUFFERED": "1",  # else what it printed last is lost when it dies
}

_INSTALL = (
    "Install RoboMME (https://github.com/RoboMME/robomme_benchmark) into an environment of its own "
    f"and give its Python: --robomme-python PATH, or export {PYTHON_VARIABLE}=PATH."
)


class RoboMMEProcess:
    """`robomme_worker.py` in RoboMME's interpreter. When it dies or takes too long, it is ended.

    Args:
        python: The interpreter, as `find_python` returns it.
        limits: Seconds that it may take to `start`, and for each call by name.

    Attributes:
        families: RoboMME's task families.
        versions: Versions in the interpreter: `robomme_python`, `robomme_numpy`, and `robomme` if
            it is installed as a package.

    Raises:
        InvalidOptionError: The interpreter cannot be run.
        MissingExtraError: It has no RoboMME, cannot import it, or has numpy 2.
        SimulatorCrashError: It died, or took too long to start.
    """

    def __init__(self, python: str, limits: Mapping[str, float]):
        self._python, self._limits = python, limits
        self._log: deque[bytes] = deque(maxlen=_LOG_LINES)
        self._channel, theirs = socket.socketpair()
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [python, robomme_worker.__file__, str(theirs.fileno())],
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
        self._running = True
        self._logger = threading.Thread(target=_keep, args=(self._process, self._log), daemon=True)
        self._logger.start()
        hello, _ = self._answer("start", "")
        if "problem" in hello:
            self.end()
            raise MissingExtraError(f"{python} cannot run RoboMME: {hello['problem']}", _INSTALL)
        self.families: tuple[str, ...] = tuple(hello["families"])
        self.versions = {f"robomme_{name}": str(hello[name]) for name in ("python", "numpy")}
        if hello["version"] is not None:
            self.versions["robomme"] = str(hello["version"])

    @property
    def pid(self) -> int | None:
        """The process id; None once it was ended."""
        return self._process.pid if self._running else None

    def call(
        self,
        call: str,
        arrays: dict[str, NDArray[Any]] | None = None,
        *,
        where: str = "",
        **arguments: Any,
    ) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Call one of the worker's functions, and return plain values and arrays by name.

        Args:
            call: `reset` or `step`.
            arrays: Arrays by name.
            where: The episode that runs, for the error.
            **arguments: Plain values by name.

        Raises:
            UnknownNameError: RoboMME has no such episode.
            SimulatorCrashError: The call failed, the process died, or it took too long.
        """
        with suppress(OSError):  # it died: the answer will say so
            robomme_worker.send(self._channel, {"call": call, **arguments}, arrays)
        answer, found = self._answer(call, where)
        if "unknown" in answer:
            raise UnknownNameError(f"no such episode: in robomme {answer['unknown']}")
        if "failed" in answer:
            raise self.error(f"failed during {call}: {answer['failed']}", where)
        return answer, found

    def _answer(self, call: str, where: str) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        limit = self._limits[call]
        try:
            self._channel.settimeout(limit)
            return robomme_worker.receive(self._channel)
        except TimeoutError:
            self._process.kill()
            self.end()
            raise self.error(
                f"took more than {limit:g} s to {call}; its process was ended", where
            ) from None
        except (EOFError, OSError) as error:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(5)
            self.end()
            raise self.error(
                f"died during {call}, exit code {self._process.returncode}", where
            ) from error
        except BaseException:  # such as Ctrl-C: an answer half read leaves the two out of step
            self._process.kill()
            self.end()
            raise

    def error(self, what: str, where: str = "") -> SimulatorCrashError:
        """Return an error that shows what was printed last."""
        if not self._running:
            self._logger.join(5)  # until it has read all
        lines = [line.decode(errors="replace").rstrip() for line in list(self._log)]
        return SimulatorCrashError(
            f"the robomme simulator in {self._python} {what}" + (f" ({where})" if where else ""),
            "\n".join(["It printed last:", *lines]) if lines else None,
        )

    def end(self) -> None:
        """End the process, if it runs."""
        self._running = False
        self._channel.close()  # the worker ends when it reads the end of its socket
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def find_python(python: str | os.PathLike[str] | None) -> str:
    """Return the path of the interpreter that is given, or that the environment names.

    Raises:
        InvalidOptionError: None is given, or there is none at that path.
    """
    given = os.fspath(python) if python is not None else os.environ.get(PYTHON_VARIABLE, "")
    if not given:
        raise InvalidOptionError(
            "the robomme simulator needs RoboMME's own interpreter, and none is given", _INSTALL
        )
    # Not resolved: the interpreter of a virtual environment is a link.
    found = shutil.which(Path(given).expanduser())
    if found is None:
        raise InvalidOptionError(f"{given} is not an executable file", _INSTALL)
    return found


def _keep(process: subprocess.Popen[bytes], log: deque[bytes]) -> None:
    """Keep the last lines that a process prints, until it ends."""
    assert process.stdout is not None
    with process.stdout as lines:
        log.extend(lines)
