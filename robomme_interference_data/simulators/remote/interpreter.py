"""The Python interpreters of simulators that run in a process of their own."""

import json
import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.runtime.safe_path import SAFE_PATH

_ANSWER_S = 300.0
"""Seconds for a program that does not start the simulator: imports are slow where much runs."""

_VERSION = "import sys; print('%d.%d' % sys.version_info[:2])"
"""A program in any Python."""


def python_variable(simulator: str) -> str:
    """Return the environment variable with the path of a simulator's interpreter.

    Such as `ROBOMME_PYTHON`.
    """
    return re.sub(r"\W", "_", simulator).upper() + "_PYTHON"


@dataclass(frozen=True)
class Interpreter:
    """An interpreter that runs a simulator.

    Attributes:
        path: Its absolute path.
        simulator: Name of the simulator.
        oldest: Oldest Python that can run it.
        advice: What to do if it cannot run it.
    """

    path: str
    simulator: str
    oldest: tuple[int, int]
    advice: str

    @classmethod
    def find(
        cls,
        simulator: str,
        needs: str,
        oldest: tuple[int, int],
        python: str | os.PathLike[str] | None = None,
    ) -> "Interpreter":
        """Find the interpreter of a simulator.

        Args:
            simulator: Name of the simulator.
            needs: What is installed in its environment, for errors.
            oldest: Oldest Python that can run it.
            python: A path, or the name of a program on `PATH`; None reads the environment variable.

        Raises:
            InvalidOptionError: None is given, or it is not an executable file.
        """
        variable, option = python_variable(simulator), named("simulator_python")
        advice = (
            f"Install {needs} into a separate environment, and set {option}, or the environment "
            f"variable {variable}, to the path of its Python."
        )
        given = os.fspath(python) if python is not None else os.environ.get(variable, "")
        if not given:
            raise InvalidOptionError(
                f"the simulator {simulator} needs a Python of its own, and none is given", advice
            )
        # As text: `Path` would remove a leading "./" and leave the name of a program.
        if (executable := shutil.which(os.path.expanduser(given))) is None:  # noqa: PTH111
            origin = given if python is not None else f"{variable}={given}"
            raise InvalidOptionError(f"{origin} is not an executable file", advice)
        # Not resolved: the interpreter of a virtual environment is a link.
        path = os.path.abspath(executable)  # noqa: PTH100
        return cls(path, simulator, oldest, advice)

    @property
    def environment(self) -> dict[str, str]:
        """The environment variables of its processes."""
        return {
            **os.environ,
            "PYTHONFAULTHANDLER": "1",  # a crash in a library prints a traceback
            SAFE_PATH: "1",  # files beside a program must not hide modules of the same names
            "PYTHONUNBUFFERED": "1",  # the last lines are not lost when it dies
        }

    def versions(self, program: Path, arguments: Sequence[str] = ()) -> dict[str, str]:
        """Run a program that prints versions as JSON, once in this process.

        Raises:
            InvalidOptionError: The interpreter does not run it.
        """
        return _versions(self, program, tuple(arguments))

    def unusable(self, error: Exception) -> InvalidOptionError:
        """Return the error for an interpreter that does not run."""
        if (old := self.too_old()) is not None:
            return old
        printed = getattr(error, "stderr", None) or b""
        what: object = (printed.decode(errors="replace").strip().splitlines() or [error])[-1]
        return InvalidOptionError(
            f"{self.path} cannot be run as the Python of the simulator {self.simulator}: {what}",
            self.advice,
        )

    def too_old(self) -> InvalidOptionError | None:
        """Return the error for an interpreter that is too old; None if it is not."""
        with suppress(OSError, ValueError, subprocess.SubprocessError):
            version = self._run("-c", _VERSION).decode().strip()
            if tuple(map(int, version.split("."))) < self.oldest:
                needed = "{}.{}".format(*self.oldest)
                return InvalidOptionError(
                    f"{self.path} is Python {version}; the simulator {self.simulator} needs Python "
                    f"{needed} or newer",
                    self.advice,
                )
        return None

    def _run(self, *arguments: str) -> bytes:
        return subprocess.check_output(
            [self.path, *arguments],
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=_ANSWER_S,
        )


@cache
def _versions(
    interpreter: Interpreter, program: Path, arguments: tuple[str, ...]
) -> dict[str, str]:
    try:
        versions: dict[str, str] = json.loads(interpreter._run(str(program), *arguments))
    except (OSError, ValueError, subprocess.SubprocessError) as error:
        raise interpreter.unusable(error) from error
    return versions
