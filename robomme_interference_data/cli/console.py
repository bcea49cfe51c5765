"""Output of commands (results on stdout, messages on stderr) and their interruption."""

import io
import json
import logging
import shlex
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from robomme_interference_data.constants import IDENTITY_PATH, MANIFEST_HEADER, MANIFEST_ROWS
from robomme_interference_data.errors import InvalidOptionError, visible


def write_utf8() -> None:
    """Write UTF-8 into files and pipes: the code page of Windows lacks characters of tables."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and not stream.isatty():
            stream.reconfigure(encoding="utf-8", errors=stream.errors)


def echo(text: str, *, nl: bool = True) -> None:
    """Print a result to stdout; control sequences are escaped."""
    typer.echo(visible(text), nl=nl)


def print_status(text: str, **style: Any) -> None:
    """Print a message to stderr; styles are those of `typer.secho`."""
    typer.secho(visible(text), err=True, **style)


class _Messages(logging.Handler):
    """Prints log records as plain messages, above a progress bar if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        print_status(self.format(record))


def log_to_stderr() -> None:
    """Print log messages of the package, from INFO on, to stderr."""
    logger = logging.getLogger("robomme_interference_data")
    logger.handlers = [_Messages()]
    logger.setLevel(logging.INFO)
    logger.propagate = False  # libraries, such as datasets, log to stderr as well


def check_output(*paths: Path | None) -> None:
    """Raise if a path is inside a dataset or manifests, whose files are hashed."""
    for path in filter(None, paths):
        for folder in (path.resolve(), *path.resolve().parents):
            manifests = (folder / name for name in (MANIFEST_HEADER, MANIFEST_ROWS))
            if (folder / IDENTITY_PATH).is_file() or all(path.is_file() for path in manifests):
                raise InvalidOptionError(
                    f"{path} is inside {folder}, a part of a buffer set",
                    "Write to a path outside the buffer set.",
                )


def print_json(value: Any) -> None:
    """Print one JSON value to stdout."""
    text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
    typer.echo(visible(text, "\\u{:04x}"))


def confirm(question: str, what: str, *, yes: bool) -> None:
    """Ask for confirmation, unless it is given; a refusal ends the command.

    Raises:
        InvalidOptionError: There is no terminal to ask on; the message names `what` needs it.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        raise InvalidOptionError(
            f"{what} needs a confirmation, and there is no terminal to ask on",
            "To confirm, run the same command with --yes.",
        )
    typer.confirm(question, abort=True, err=True)


def command_line() -> str:
    """Return the current command as text."""
    return shlex.join(["robomme-interference", *sys.argv[1:]])


class _Terminated(KeyboardInterrupt):
    """SIGTERM arrived."""


@contextmanager
def graceful_interrupt(kept: str, place: Path | None = None) -> Iterator[None]:
    """End a command cleanly after Ctrl-C or SIGTERM, and print how to resume.

    Args:
        kept: What the command leaves when interrupted, such as `Finished episodes are kept`.
        place: Its folder, if that may not exist yet.
    """

    def stop(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # schedulers may send it again
        raise _Terminated

    def print_kept(instruction: str) -> None:
        state = kept if place is None or place.is_dir() else "Nothing was written yet"
        print_status(f"\nStopped. {state}; {instruction}:\n{command_line()}")

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt as interrupt:
        print_kept("resume with")
        raise typer.Exit(143 if isinstance(interrupt, _Terminated) else 130) from None
    except OSError as error:
        # Such as a full disk; the same command cannot mend a file where a folder must be.
        if error.errno is not None and not isinstance(error, FileExistsError | NotADirectoryError):
            print_kept("once this is fixed, resume with")
        raise
    finally:
        signal.signal(signal.SIGTERM, before)
