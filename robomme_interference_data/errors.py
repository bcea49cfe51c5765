"""Every error that this package raises on purpose.

Each is also a fitting builtin, so that callers can catch either, and carries a `hint` on what to do
next. Messages and hints name settings as Python does: `workers`, `executor="ray"`. The command line
prints those that stand in backticks, and any `name="value"`, as its options (`cli/hints.py`).
"""

import re
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from typing import Any, Self

_LONGEST_MESSAGE = 4000
"""Characters of a message, at most: it may quote a file that somebody else wrote."""

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""What a terminal would obey instead of showing it; line breaks and tabs are none of these."""

_COLOUR = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")

PRINTED_LINES = 20
"""How many of the last lines that a process printed are shown when it breaks."""


class InterferenceError(Exception):
    """Base of all errors of this package.

    Args:
        message: What was given and what was expected.
        hint: What to do next, or None.
        command: Command of this package that helps, without the program's name, such as
            `verify my-buffers`; only the command line shows it.
    """

    def __init__(self, message: str, hint: str | None = None, command: str | None = None):
        if len(message) > _LONGEST_MESSAGE:
            message = f"{message[:_LONGEST_MESSAGE]}… ({len(message):,} characters)"
        message = visible(message)
        super().__init__(message)
        self.message = message
        self.hint = visible(hint) if hint else None
        self.command = command

    def __str__(self) -> str:
        return self.message if self.hint is None else f"{self.message}\n{self.hint}"

    def about(self, what: object) -> Self:
        """Return the same error with what it is about in front, such as an episode."""
        error = type(self)(f"{what}: {self.message}")
        error.__dict__ |= {**self.__dict__, "message": error.message}
        return error


class InvalidIdError(InterferenceError, ValueError):
    """An episode id or condition that does not read as one."""


class UnknownNameError(InterferenceError, LookupError):
    """An episode, family, condition or camera that the data does not hold."""

    @classmethod
    def among(cls, what: str, given: object, where: object, known: Iterable[object]) -> Self:
        """Return the error for a name that is not there: `what` it names, and what there is."""
        hint = nearest(str(given), map(str, known))
        return cls(f"{what} {given!r} is not in {where}", hint)

    @classmethod
    def none(cls, what: str, given: str, known: Iterable[str]) -> Self:
        """Return the error for a name that nothing has: `what` it names, and what there is."""
        return cls(f"there is no {what} {given!r}", nearest(given, known))


class InvalidOptionError(InterferenceError, ValueError):
    """An option or argument outside what it may be.

    `option` is the name of the setting in Python, such as `workers`, if the message contains it.
    """

    def __init__(
        self,
        message: str,
        hint: str | None = None,
        command: str | None = None,
        option: str | None = None,
    ):
        super().__init__(message, hint, command)
        self.option = option

    @classmethod
    def expected(cls, option: str, given: object, expected: str, hint: str | None = None) -> Self:
        """Return the error for a setting: its Python name, what was given, what was expected."""
        return cls(f"{option} {given!r}; expected {expected}", hint, option=option)

    @classmethod
    def one_of(cls, option: str, given: object, known: Iterable[str]) -> Self:
        """Return the error for a setting that is none of the known names."""
        names = list(known)
        message = f"{option} {given!r} is none of {', '.join(names)}"
        return cls(message, nearest(str(given), names, more=""), option=option)


class MissingExtraError(InterferenceError, ImportError):
    """A library of an optional extra is not installed."""

    @classmethod
    def needs(cls, what: str, library: str, extra: str) -> Self:
        """Return the error for work that needs a library of an extra."""
        return cls(
            f"{what} needs {library}, which is not installed",
            f'Install it: pip install "robomme-interference-data[{extra}]"',
        )


class MissingFileError(InterferenceError, FileNotFoundError):
    """A file that a dataset or buffer set must have is not there."""


class HubError(InterferenceError, OSError):
    """The Hub refuses a repository, does not know it, or cannot be reached."""


class PublishError(InterferenceError, RuntimeError):
    """Something that cannot be published as it is, or under the version that is asked for."""


class FormatError(InterferenceError, ValueError):
    """A file that is not what it should be: damaged, inconsistent, or of an unknown version."""

    @classmethod
    def damaged(cls, path: object, what: object) -> Self:
        """Return the error for a file that holds what it should not: its path, and what."""
        hint = "The file is damaged: download or build it again."
        return cls(f"{path}: {what}", hint)


class HashMismatchError(InterferenceError, ValueError):
    """Data whose SHA-256 is not the recorded one."""


class SourceError(InterferenceError, ValueError):
    """Recorded episodes that cannot be used as they are."""


class MissingIndexError(InterferenceError, FileNotFoundError):
    """A dataset without the embeddings, or with ones of other data or another encoder."""


class BuildError(InterferenceError, RuntimeError):
    """A build that cannot go on, as where a buffer needs more units than there are."""


class HistoryTooLongError(InterferenceError, ValueError):
    """A buffer that exceeds the position limit of the systems it is planned for."""


class NoRendererError(InterferenceError, RuntimeError):
    """No Vulkan device on this machine can render the simulator's cameras."""


class SimulatorCrashError(InterferenceError, RuntimeError):
    """A simulator broke: its process died or did not answer in time, or it says so itself."""


class PolicyError(InterferenceError, RuntimeError):
    """A policy that does not fit, breaks, is called out of order, or answers what it may not."""


class PolicyServerError(InterferenceError, ConnectionError):
    """A policy server that cannot be reached, reports an error, or does not answer in time."""


class ServerKeepaliveError(PolicyServerError):
    """A policy server that closed its own connection, over a call that kept it for too long."""


class ServerDiedError(PolicyServerError):
    """A policy server that a worker had started, and that ended."""


class ModelError(InterferenceError, ConnectionError):
    """A vision-language model that cannot be reached, is not there, or gives no usable answer."""


class WireError(InterferenceError, ValueError):
    """A message that the protocol of the policy servers cannot carry."""


class RolloutError(InterferenceError, RuntimeError):
    """A rollout that cannot be run as planned, as where simulator and data differ."""


class RunFolderError(InterferenceError, FileExistsError):
    """A run's folder that holds another run, or that another process is writing."""


class WorkerError(InterferenceError, RuntimeError):
    """Workers that cannot be started, or whose cluster is not there or not as it must be."""


class WorkerRetiredError(InterferenceError, RuntimeError):
    """A worker that can do no further task: what it had to do is left to the others."""


def nearest(given: str, known: Iterable[str], *, more: str = "Known: ") -> str:
    """Return a sentence that offers the nearest valid names, or else lists at most 10 of them.

    Args:
        given: The unknown name.
        known: All valid names.
        more: What the list begins with; empty for no list.
    """
    names = sorted(known)
    folded = {name.lower(): name for name in names}
    close = get_close_matches(given.lower(), list(folded), n=3, cutoff=0.6)
    if close:
        return "Did you mean " + " or ".join(repr(folded[name]) for name in close) + "?"
    if not names or not more:
        return ""
    rest = f", … ({len(names)} in all)" if len(names) > 10 else ""
    return more + ", ".join(names[:10]) + rest


def visible(text: str, escape: str = "\\x{:02x}") -> str:
    """Return text with control characters escaped: a terminal would obey them."""
    return _CONTROL.sub(lambda match: escape.format(ord(match[0])), text)


def printed_last(lines: Sequence[bytes]) -> str | None:
    """Return the last of what a process printed, as a hint; None if that is nothing."""
    told = [line.decode(errors="replace").rstrip() for line in lines[-PRINTED_LINES:]]
    text = _COLOUR.sub("", "\n".join(["It printed last:", *told]))
    return _CONTROL.sub("", text) if told else None


def first_line(error: BaseException) -> str:
    """Return what an error says, in one line without its hint."""
    text: Any = error.message if isinstance(error, InterferenceError) else str(error)
    return (str(text).splitlines() or [type(error).__name__])[0]
