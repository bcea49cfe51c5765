"""What commands share: messages on stderr, JSON on stdout, and how they are stopped."""

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


def echo(text: str, *, nl: bool = True) -> None:
    """Print output to stdout; what a terminal would obey instead of showing it is escaped."""
    typer.echo(visible(text), nl=nl)


def print_status(text: str, **style: Any) -> None:
    """Print a message to stderr; styles are those of `typer.secho`."""
    typer.secho(visible(text), err=True, **style)


class _Messages(logging.Handler):
    """Prints log records as plain messages, above a progress bar if there is one."""

    def emit(self, record: logging.LogRecord) -> None:
        print_status(self.format(record))


def log_to_stderr() -> None:
    """Print what the package logs, from INFO on, to stderr."""
    logger = logging.getLogger("robomme_interference_data")
    logger.handlers = [_Messages()]
    logger.setLevel(logging.INFO)


def check_output(*paths: Path | None) -> None:
    """Raise if a path is inside a dataset or manifests, whose files are hashed."""
    for path in filter(None, paths):
        for folder in (path.resolve(), *path.resolve().parents):
            manifests = (folder / name for name in (MANIFEST_HEADER, MANIFEST_ROWS))
            if (folder / IDENTITY_PATH).is_file() or all(path.is_file() for path in manifests):
                raise InvalidOptionError(
                    f"{path} lies inside {folder}, whose files are a buffer set's",
                    "Give a place outside the buffer set.",
                )


def print_json(value: Any) -> None:
    """Print one JSON value to stdout."""
    text = json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False)
    typer.echo(visible(text, "\\u{:04x}"))


def command_line() -> str:
    """Return the command that runs, to be typed again."""
    return shlex.join(["robomme-interference", *sys.argv[1:]])


class _Terminated(KeyboardInterrupt):
    """SIGTERM came."""


@contextmanager
def graceful_interrupt(kept: str, place: Path | None = None) -> Iterator[None]:
    """Let Ctrl-C, and SIGTERM as schedulers send it, end a command in peace; tell how to go on.

    Args:
        kept: What an interrupted command leaves behind, such as `Finished episodes are kept`.
        place: Where that is, if it may not have been made yet.
    """

    def told() -> str:
        return kept if place is None or place.is_dir() else "Nothing was written yet"

    def stop(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one must not cut the ending short
        raise _Terminated

    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    except KeyboardInterrupt as interrupt:
        print_status(f"\nStopped. {told()}; go on with:\n{command_line()}")
        raise typer.Exit(143 if isinstance(interrupt, _Terminated) else 130) from None
    except OSError as error:
        if error.errno is not None:  # the system's word on a file, such as that the disk is full
            print_status(f"Stopped. {told()}; once mended, go on with:\n{command_line()}")
        raise
    finally:
        signal.signal(signal.SIGTERM, before)
