"""What a run records of errors, and of first attempts that failed."""

from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.runtime.executor import Outcome

from .identity import plain
from .row import Rollout

_LETTERS = 2000
"""Maximum length of an error text in a row."""


def error_text(error: BaseException) -> str:
    """Return an error and its hint in one line, as text that every file can hold."""
    text = str(error)
    if isinstance(error, InterferenceError):
        hint = f" ({error.hint})" if error.hint else ""
        text = f"{type(error).__name__}: {error.message}{hint}"
    return str(plain(" ".join(text.split())[:_LETTERS]))


def first_fault(earlier: Rollout | None, outcome: Outcome) -> str | None:
    """Return what failed in the first attempt of all; None if there is no other attempt.

    Args:
        earlier: The row that an earlier invocation wrote, which is an error; or None.
        outcome: The outcome of this invocation, which may have several attempts too.
    """
    if earlier is not None:
        return earlier.repeated_because or earlier.error
    if outcome.first is None or outcome.first.error is None:
        return None
    return error_text(outcome.first.error)


def first_trace(outcome: Outcome) -> str | None:
    """Return what failed in the first of several attempts, with its traceback if that is known."""
    if outcome.first is None or outcome.first.error is None:
        return None
    fault = f"The first attempt failed: {error_text(outcome.first.error)}"
    return "\n".join(filter(None, (fault, outcome.first.trace)))
