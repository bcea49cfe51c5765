"""What the programs share: kinds of options, and errors without a traceback."""

import argparse
import math
from collections.abc import Callable

import torch

from robomme_interference_data.errors import InterferenceError, naming_options


def whole(least: int, step: int = 1) -> Callable[[str], int]:
    """Return a reader of whole numbers of 32 bits, from `least`, in steps."""

    def read(text: str) -> int:
        if not text.isdecimal() or not least <= int(text) < 2**32 or int(text) % step:
            kind = "whole number" if step == 1 else f"multiple of {step}"
            raise argparse.ArgumentTypeError(f"{text!r}; expected a {kind} from {least}")
        return int(text)

    return read


def number(text: str) -> float:
    """Read a finite number from 0."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}; expected a number from 0")
    return value


def names(text: str) -> tuple[str, ...]:
    """Read `NAME,…`."""
    return tuple(weights(text))


def weights(text: str) -> dict[str, float]:
    """Read `NAME,…`, of which each may be `NAME=WEIGHT`."""
    found: dict[str, float] = {}
    for part in text.split(","):
        name, _, weight = part.strip().partition("=")
        if not name or name in found:
            raise argparse.ArgumentTypeError(f"{text!r}; expected names that differ")
        try:
            found[name] = float(weight or 1)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{part!r}; expected NAME or NAME=WEIGHT") from None
    return found


def device(text: str) -> str:
    """Read the name of a device that is there."""
    try:
        torch.empty(0, device=text)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise argparse.ArgumentTypeError(f"{text!r}; expected cpu or cuda ({reason})") from None
    return text


def default_device() -> str:
    """Return a GPU if there is one."""
    return "cuda" if torch.cuda.is_available() else "cpu"


def run(main: Callable[[argparse.Namespace], None], args: argparse.Namespace) -> None:
    """Run a program; end it with one text if the input is wrong or the user interrupts."""
    options = {name: f"--{name.replace('_', '-')}" for name in vars(args)}
    try:
        with naming_options(options):
            main(args)
    except InterferenceError as error:
        command = "" if error.command is None else f"\nRun: robomme-interference {error.command}"
        raise SystemExit(f"error: {error}{command}") from None
    except OSError as error:
        raise SystemExit(f"error: {error}") from None
    except KeyboardInterrupt:
        raise SystemExit("interrupted: run the same command again") from None
