"""The process of a simulator in its own interpreter: `worker.py`, connected by a pipe."""

import re
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping
from contextlib import suppress
from multiprocessing.connection import Pipe
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from robomme_interference_data.errors import (
    PRINTED_LINES,
    InterferenceError,
    InvalidOptionError,
    MissingExtraError,
    NoRendererError,
    SimulatorCrashError,
    UnknownNameError,
    printed_last,
)

from . import worker as remote_worker
from .interpreter import Interpreter

Arrays = dict[str, NDArray[Any]]

_NO_RENDERER = re.compile(
    r"vk::(createInstance|Instance::|PhysicalDevice::)"
    r"|failed to find (a rendering device|device \")"
    r"|find a supported physical device"
)
"""What sapien raises where Vulkan does not work: no episode can be drawn then."""


class RemoteProcess:
    """The process of a simulator; see `RemoteSimulator` for the errors that its methods raise.

    `pid` is None after it has ended; `played` counts the episodes of its user.

    Args:
        interpreter: What runs it.
        worker: File with the class `Episodes`.
        settings: Arguments of that class.
        answer_s: Seconds that it may take to start, and for each call.
    """

    def __init__(
        self, interpreter: Interpreter, worker: Path, settings: Mapping[str, Any], answer_s: float
    ):
        self._interpreter, self._answer_s = interpreter, answer_s
        self._log: deque[bytes] = deque(maxlen=PRINTED_LINES)
        self._channel, theirs = Pipe()
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [interpreter.path, remote_worker.__file__, str(theirs.fileno()), str(worker)],
                    pass_fds=[theirs.fileno()],
                    env=interpreter.environment,
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.STDOUT,
                )
        except OSError as error:
            self._channel.close()
            raise interpreter.unusable(error) from error
        self.pid: int | None = self._process.pid
        self.played = 0
        self._logger = threading.Thread(target=self._keep_log, daemon=True)
        self._logger.start()
        try:
            self.call("start", **settings)
        except InterferenceError as error:
            self.end()
            if (old := interpreter.too_old()) is not None:
                raise old from error
            raise

    def call(self, call: str, **arguments: Any) -> tuple[dict[str, Any], Arrays]:
        """Call a method of the worker; return the facts and the arrays of its answer."""
        with suppress(OSError):  # if it died, reading the answer raises
            remote_worker.send(self._channel, {"call": call, **arguments})
        answer, arrays = self._answer(call)
        if "problem" in answer:
            # This package's own environment must not get the libraries of a simulator.
            fix = None if self._interpreter.path == sys.executable else answer["fix"]
            raise MissingExtraError(
                f"{self._interpreter.path} cannot run the simulator "
                f"{self._interpreter.simulator}: {answer['problem']}",
                fix or self._interpreter.advice,
            )
        if "refused" in answer:
            raise InvalidOptionError(
                f"simulator {self._interpreter.simulator!r}: its worker {answer['refused']}",
                f"It takes {', '.join(answer['takes'])}.",
            )
        if "unknown" in answer:
            simulator = self._interpreter.simulator
            raise UnknownNameError(f"no such episode: in {simulator} {answer['unknown']}")
        if "failed" in answer:
            if _NO_RENDERER.search(answer["failed"]):
                raise NoRendererError.without_vulkan(self._what(f"failed: {answer['failed']}"))
            raise self.error(f"failed during {call}: {answer['failed']}")
        return answer, arrays

    def _answer(self, call: str) -> tuple[dict[str, Any], Arrays]:
        try:
            if self._channel.poll(self._answer_s):
                return remote_worker.receive(self._channel)
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
        return SimulatorCrashError(self._what(what), printed_last(list(self._log)))

    def _what(self, what: str) -> str:
        return f"the {self._interpreter.simulator} simulator in {self._interpreter.path} {what}"

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
