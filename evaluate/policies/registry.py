"""Policies by name; the libraries behind them are imported when one is made."""

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest
from robomme_interference_data.evaluate.policies.base import Policy
from robomme_interference_data.evaluate.policies.builtin import BUILTIN, make_builtin
from robomme_interference_data.evaluate.policies.replay import MEMORIES, ReplayPolicy

__all__ = ["check_workers", "default_system", "make_policy"]


def make_policy(spec: str, *, memory: str | None = None, worker: int = 0) -> Policy:
    """Make a policy."""
    if spec == "replay":
        return ReplayPolicy(memory or "full")
    if memory is not None:
        raise InvalidOptionError(f"--memory {memory}: only replay has memory rules")
    if spec in BUILTIN:
        return make_builtin(spec)
    raise UnknownNameError(f"there is no policy {spec!r}", nearest(spec, [*BUILTIN, "replay"]))


def check_workers(spec: str, workers: int) -> None:
    """Check that a policy can serve so many workers."""


def default_system(spec: str, *, memory: str | None = None, retrieval: bool = False) -> str:
    """Return the name under which rows of a policy stand if none is given."""
    name = f"replay-{memory or next(iter(MEMORIES))}" if spec == "replay" else spec
    return f"retrieval-{name}" if retrieval else name
