"""Every error that this package raises on purpose.

Each is also a fitting builtin, so that callers can catch either, and carries a `hint`: what to
do next, with the command to type where there is one.
"""

from bisect import bisect
from collections.abc import Iterable
from difflib import get_close_matches

__all__ = [
    "InterferenceError",
    # what was asked for
    "InvalidIdError",
    "UnknownNameError",
    "InvalidOptionError",
    "MissingExtraError",
    # what was read
    "MissingFileError",
    "HubError",
    "FormatError",
    "HashMismatchError",
    "TruncatedVideoError",
    "SourceError",
    "BadRowsError",
    "MissingIndexError",
    "StaleIndexError",
    "MissingWeightsError",
    # what was to be written
    "BuildError",
    "PoolTooSmallError",
    "HistoryTooLongError",
    # simulators
    "NoRendererError",
    "MotionError",
    "SimulatorCrashError",
    # evaluation
    "PolicyError",
    "PolicyServerError",
    "WireError",
    "RolloutError",
    "RunFolderError",
    # processes
    "WorkerError",
    "WorkerRetiredError",
    # helpers
    "nearest",
]


class InterferenceError(Exception):
    """Base of all errors of this package.

    Args:
        message: What was given and what was expected.
        hint: What to do next, or None.
    """

    def __init__(self, message: str, hint: str | None = None):
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __str__(self) -> str:
        return self.message if self.hint is None else f"{self.message}\n{self.hint}"


class InvalidIdError(InterferenceError, ValueError):
    """An episode id that does not read `<Family>/<split>/<index>`."""


class UnknownNameError(InterferenceError, LookupError):
    """An episode, family, k or camera that the data does not hold."""


class InvalidOptionError(InterferenceError, ValueError):
    """An option or argument outside what it may be."""


class MissingExtraError(InterferenceError, ImportError):
    """A library of an optional extra is not installed."""


class MissingFileError(InterferenceError, FileNotFoundError):
    """A file that a dataset or split must have is not there."""


class HubError(InterferenceError, OSError):
    """The Hub refuses a repository, does not know it, or cannot be reached."""


class FormatError(InterferenceError, ValueError):
    """A file that cannot be read as what it should be, or of an unknown format version."""


class HashMismatchError(InterferenceError, ValueError):
    """Decoded data whose SHA-256 is not the recorded one."""


class TruncatedVideoError(InterferenceError, ValueError):
    """A video that ends before the frames that it should hold, or skips some of them."""


class SourceError(InterferenceError, ValueError):
    """Recorded episodes that cannot be used as they are."""


class BadRowsError(InterferenceError, ValueError):
    """Rows of rollouts that contradict themselves, each other or the protocol."""


class MissingIndexError(InterferenceError, FileNotFoundError):
    """A dataset without the embeddings that are asked for."""


class StaleIndexError(InterferenceError, ValueError):
    """Embeddings that were made of other data, or with another encoder, than is asked for."""


class MissingWeightsError(InterferenceError, FileNotFoundError):
    """The weights of a model are not on this machine."""


class BuildError(InterferenceError, RuntimeError):
    """A build that cannot go on."""


class PoolTooSmallError(InterferenceError, ValueError):
    """Fewer eligible distractor units than a buffer needs."""


class HistoryTooLongError(InterferenceError, ValueError):
    """A buffer that exceeds the position limit of the systems it is planned for."""


class NoRendererError(InterferenceError, RuntimeError):
    """No Vulkan device on this machine can render the simulator's cameras."""


class MotionError(InterferenceError, RuntimeError):
    """A scripted motion asks for a pose that the arm cannot take."""


class SimulatorCrashError(InterferenceError, RuntimeError):
    """A simulator broke: its process died or did not answer in time, or it says so itself."""


class PolicyError(InterferenceError, RuntimeError):
    """A policy that does not fit, breaks, is called out of order, or answers what it may not."""


class PolicyServerError(InterferenceError, ConnectionError):
    """A policy server that cannot be reached, reports an error, or does not answer in time."""


class WireError(InterferenceError, ValueError):
    """A message that the protocol of the policy servers cannot carry."""


class RolloutError(InterferenceError, RuntimeError):
    """A rollout that cannot be run as planned: simulator and data contradict each other."""


class RunFolderError(InterferenceError, FileExistsError):
    """A run's folder that holds another run, or that another process is writing."""


class WorkerError(InterferenceError, RuntimeError):
    """Worker processes that cannot be started."""


class WorkerRetiredError(InterferenceError, RuntimeError):
    """A worker that can do no further task: what it had to do is left to the others."""


def nearest(given: str, known: Iterable[str]) -> str:
    """Return a sentence that offers the nearest valid names.

    Args:
        given: The unknown name.
        known: All valid names; at most 10 of them are listed when none is near.

    Returns:
        `"Did you mean 'a' or 'b'?"`, `"Known: …"`, or an empty string if `known` is empty.
    """
    names = sorted(known)
    # Comparing takes long: of very many names, those that begin alike are compared.
    place = bisect(names, given)
    folded = {name.lower(): name for name in names[max(0, place - 1000) : place + 1000]}
    close = get_close_matches(given.lower(), list(folded), n=3, cutoff=0.6)
    if close:
        return "Did you mean " + " or ".join(repr(folded[name]) for name in close) + "?"
    if not names:
        return ""
    more = f", … ({len(names)} in all)" if len(names) > 10 else ""
    return "Known: " + ", ".join(names[:10]) + more
