"""Every error that this package raises on purpose.

Each is also a fitting builtin, so that callers can catch either, and carries a `hint` on what to do
next. Messages and hints name settings with `named`: as in Python, or as the options of the command
that runs. Hints name pages of the documentation as in a checkout, such as
`docs/how-to/connect-a-policy.md`, and show their address.
"""

import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from typing import Self

from .constants import DOCS_URL

_LONGEST_MESSAGE = 4000
"""Most characters of a message, which may quote an untrusted file."""

_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
"""Characters that a terminal interprets instead of showing; line breaks and tabs excepted."""

_PAGE = re.compile(r"(?<![\w/.-])docs/([\w/-]+)\.md\b")
"""A page of the documentation, as in a checkout."""

_COLOR = re.compile(r"\x1b\[[0-?]*[ -/]*[@-~]")

PRINTED_LINES = 20
"""Last lines of a process's output that the error about its failure quotes."""


class InterferenceError(Exception):
    """Base of all errors of this package.

    Args:
        message: What was given and what was expected.
        hint: What to do next, or None.
        command: Command of this package that helps, without the program's name, such as
            `verify my-buffers`.
        option: Python name of the setting that is wrong, such as `workers`; None if it is none.
    """

    def __init__(
        self,
        message: str,
        hint: str | None = None,
        command: str | None = None,
        option: str | None = None,
    ):
        if len(message) > _LONGEST_MESSAGE:
            message = f"{message[:_LONGEST_MESSAGE]}… ({len(message):,} characters)"
        message = visible(message)
        super().__init__(message)
        self.message = message
        self.hint = with_addresses(visible(hint)) if hint else None
        self.command = command
        self.option = option

    def __str__(self) -> str:
        lines = [self.message]
        if self.hint:
            lines.append(self.hint)
        if self.command is not None:
            lines.append(f"Run: robomme-interference {visible(self.command)}")
        return "\n".join(lines)

    def about(self, what: object) -> Self:
        """Return the same error with its subject in front of the message, such as an episode."""
        error = type(self)(f"{what}: {self.message}")
        error.__dict__ |= {**self.__dict__, "message": error.message}
        return error


class InvalidIdError(InterferenceError, ValueError):
    """An episode id or condition that cannot be parsed.

    Fix: write `<Family>/<split>/<index>`, such as `VideoRepick/test/7`; conditions such as `k3`.
    """


class UnknownNameError(InterferenceError, LookupError):
    """An episode, family, condition or camera that the data does not hold.

    Fix: use one of the names that the message offers; `list BUFFER_SET` prints all.
    """

    @classmethod
    def among(cls, what: str, given: object, where: object, known: Iterable[object]) -> Self:
        """Return the error for a name that `where` does not have, with the nearest known ones."""
        hint = nearest(str(given), map(str, known))
        return cls(f"{what} {given!r} is not in {where}", hint)

    @classmethod
    def none(cls, what: str, given: str, known: Iterable[str]) -> Self:
        """Return the error for a name that nothing has, with the nearest known ones."""
        return cls(f"there is no {what} {given!r}", nearest(given, known))


class InvalidOptionError(InterferenceError, ValueError):
    """An option or argument with a value that is not allowed.

    Fix: use a value that the message names; `--help` of the command lists them.
    """

    @classmethod
    def expected(cls, option: str, given: object, expected: str, hint: str | None = None) -> Self:
        """Return the error for a setting: its Python name, the given value, the expected one."""
        return cls(f"{_name_of(option)} {given!r}; expected {expected}", hint, option=option)

    @classmethod
    def one_of(cls, option: str, given: object, known: Iterable[str]) -> Self:
        """Return the error for a setting that is none of the known names."""
        names = list(known)
        message = f"{_name_of(option)} {given!r} is none of {', '.join(names)}"
        return cls(message, nearest(str(given), names, more=""), option=option)


class MissingExtraError(InterferenceError, ImportError):
    """A library of an optional extra is not installed.

    Fix: install the extra that the message names.
    """

    @classmethod
    def needs(cls, what: str, library: str, extra: str) -> Self:
        """Return the error for work that needs a library of an extra."""
        return cls(
            f"{what} needs {library}, which is not installed",
            f'Install it: pip install "robomme-interference-data[{extra}]"',
        )


class MissingFileError(InterferenceError, FileNotFoundError):
    """A dataset, buffer set or embedding index lacks a required file, or was made of other data.

    Fix: check the path; fetch or build the missing part, or run `index`.
    """


class FormatError(InterferenceError, ValueError):
    """A file or message that is damaged, inconsistent, or of an unknown version.

    Fix: download or build the file again; `verify` lists everything that is damaged.
    """

    @classmethod
    def damaged(cls, path: object, what: object) -> Self:
        """Return the error for a damaged file: its path, and what is wrong with it."""
        hint = "The file is damaged: restore it from a copy, or download or build it again."
        return cls(f"{path}: {what}", hint)


class HashMismatchError(InterferenceError, ValueError):
    """Data whose SHA-256 differs from the recorded one.

    Fix: download or build the data again; `verify` lists every mismatch.
    """

    @classmethod
    def damaged(cls, what: str) -> Self:
        """Return the error for data of a buffer set that differ from what is recorded."""
        hint = "The data is damaged or belongs to another version: download or build it again."
        return cls(what, hint, "verify BUFFER_SET")


class HubError(InterferenceError, OSError):
    """The Hub does not know a repository, denies access to it, or cannot be reached.

    Fix: check the repository's name, log in with `hf auth login`, or try again later.
    """


class SourceError(InterferenceError, ValueError):
    """Recorded episodes that cannot be used.

    Fix: correct the recording that the message names, or exclude it.
    """


class BuildError(InterferenceError, RuntimeError):
    """A build that cannot continue, for example because the pool has too few units.

    Fix: provide more distractor units, or plan fewer sessions.
    """


class BusyError(BuildError):
    """Another process is building the same folder.

    Fix: wait for it to end, or stop it.
    """


class PublishError(InterferenceError, RuntimeError):
    """Data or results that cannot be published, or not under the requested version.

    Fix: run `verify`, or choose the version that the message suggests.
    """


class RunError(InterferenceError, RuntimeError):
    """A run or rollout that cannot proceed: folder in use, other settings, simulator mismatch.

    Fix: use another `--out`, or the settings of the existing run.
    """


class NoRendererError(InterferenceError, RuntimeError):
    """No Vulkan device on this machine can render the simulator's cameras.

    Fix: install a Vulkan driver: `sudo make vulkan`; then `doctor`.
    """

    @classmethod
    def without_vulkan(cls, why: object) -> Self:
        """Return the error for what a simulator raised without a Vulkan device."""
        return cls(
            f"no Vulkan device on this machine can render: {why}",
            "Install a software driver: sudo make vulkan. Without the repository: libvulkan1 and "
            "mesa-vulkan-drivers 24.3 or newer (Debian 12 has it in bookworm-backports).",
        )


class SimulatorError(InterferenceError, RuntimeError):
    """A simulator that cannot be made, lacks a method, or returns data of another shape.

    Fix: the hint states the shapes; the how-to "Interference on another benchmark" has an example.
    """


class SimulatorCrashError(InterferenceError, RuntimeError):
    """A simulator's process ended, timed out, or reported an internal error.

    Fix: re-run the same command; see `errors.log` if it happens again.
    """


class PolicyError(InterferenceError, RuntimeError):
    """A policy that does not fit, fails, is called out of order, or returns invalid actions.

    Fix: correct the policy; its own traceback is in `errors.log`.
    """


class LeakError(InterferenceError, RuntimeError):
    """A policy, simulator or subgoal writer that carries a state from one rollout to the next.

    Fix: let its reset clear what is left: docs/how-to/your-own-policy.md.

    Attributes:
        component: What gave the first different value: `policy`, `simulator`, `subgoal writer` or
            `retrieval step`.
        step: Executed steps before it.
    """

    component: str = ""
    step: int = 0

    @classmethod
    def of(cls, component: str, step: int, message: str, hint: str) -> Self:
        """Return the error for a component that keeps a state, found after so many steps."""
        error = cls(message, hint)
        error.component, error.step = component, step
        return error


class PolicyServerError(InterferenceError, ConnectionError):
    """A policy server that cannot be reached, reports an error, or does not answer in time.

    Fix: check that the server runs and is reachable; its log has the details.
    """

    @classmethod
    def changed(cls, server: str, reported: object, first: object) -> Self:
        """Return the error for a server that reports something else than at first."""
        return cls(
            f"policy server {server} reports {reported}; it began with {first}",
            "Serve the same model until the run ends.",
        )


class ServerKeepaliveError(PolicyServerError):
    """A policy server that closed its connection because one call blocked it for too long.

    Fix: re-run the same command: a server that has compiled answers faster.
    """


class ServerDiedError(PolicyServerError):
    """A policy server that a worker started, or a policy's own process, that ended.

    Fix: read the server's log in `RUN/servers`, or the process's output.
    """


class ModelError(InterferenceError, ConnectionError):
    """A vision-language model that cannot be reached or gives no usable answer.

    Fix: check the endpoint and the model's name.
    """


class WorkerError(InterferenceError, RuntimeError):
    """Workers that cannot be started, or a cluster that is missing or not set up as required.

    Fix: follow the message; with `--workers 1` a problem is easier to see.
    """


class WorkerRetiredError(InterferenceError, RuntimeError):
    """A worker that can run no further task; the other workers take over its tasks.

    Fix: nothing: it is handled inside a run.
    """


SAME_FOR_ALL = (InvalidOptionError, MissingExtraError, NoRendererError, SimulatorError)
"""Errors about settings or this machine: after one, other episodes would fail alike."""


# The names under which the reader of an error sets what is wrong: one command runs in a process.
_option_names: Mapping[str, str] = {}


@contextmanager
def naming_options(names: Mapping[str, str]) -> Iterator[None]:
    """Let errors name settings by the options of a command, `{"workers": "--workers"}`."""
    global _option_names  # noqa: PLW0603 - also errors of other threads name the options
    before, _option_names = _option_names, names
    try:
        yield
    finally:
        _option_names = before


def option_names() -> Mapping[str, str]:
    """Return the names that are in use, which worker processes do not have."""
    return _option_names


def named(setting: str, value: object = None) -> str:
    """Return a setting as the reader of an error writes it, with a value if one is given.

    In Python that is `workers` in backticks, or `executor="ray"`; in a command `--workers`, or
    `--executor ray`.
    """
    if value is None:
        return _option_names.get(setting, f"`{setting}`")
    option = _option_names.get(setting)
    if option is None:
        return f'{setting}="{value}"' if isinstance(value, str) else f"{setting}={value}"
    between = "=" if option.startswith("--set ") else " "
    return f"{option}{between}{shlex.quote(str(value))}"


def _name_of(setting: str) -> str:
    return _option_names.get(setting, setting)


def nearest(given: str, known: Iterable[str], *, more: str = "Known: ") -> str:
    """Return a sentence that offers the nearest valid names, or else lists at most 10 of them.

    `more` is the beginning of the list; if it is empty, nothing is listed.
    """
    names = sorted(str(name) for name in known)  # members of an enumeration are quoted as values
    folded = {name.lower(): name for name in names}
    close = get_close_matches(given.lower(), list(folded), n=3, cutoff=0.6)
    if close:
        return "Did you mean " + " or ".join(repr(folded[name]) for name in close) + "?"
    if not names or not more:
        return ""
    rest = f", … ({len(names)} in all)" if len(names) > 10 else ""
    return more + ", ".join(names[:10]) + rest


def with_addresses(text: str) -> str:
    """Return text with pages of the documentation, `docs/PAGE.md`, as their addresses."""
    return _PAGE.sub(rf"{DOCS_URL}/\1.html", text)


def counted(count: int, noun: str, plural: str | None = None) -> str:
    """Return a number with its noun, such as `1 episode` or `1,200 episodes`."""
    return f"{count:,} {noun if count == 1 else plural or f'{noun}s'}"


def visible(text: str, escape: str = "\\x{:02x}") -> str:
    """Return text with control characters escaped, which a terminal would interpret."""
    return _CONTROL.sub(lambda match: escape.format(ord(match[0])), text)


def printed_last(lines: Sequence[bytes]) -> str | None:
    """Return the last lines of a process's output as a hint; None if there are none."""
    if not lines:
        return None
    printed = [line.decode(errors="replace").rstrip() for line in lines[-PRINTED_LINES:]]
    return _CONTROL.sub("", _COLOR.sub("", "\n".join(["Its last output:", *printed])))


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message, without its hint."""
    text = error.message if isinstance(error, InterferenceError) else str(error)
    return (str(text).splitlines() or [type(error).__name__])[0]
