"""Batches: several rollouts ask one policy for actions, each through a session with its memory."""

import logging
from collections.abc import Callable, Hashable
from functools import cached_property
from typing import Any

from .policy import BatchPolicy, Policy

logger = logging.getLogger(__name__)

CallResult = tuple[Any, Exception | None]
"""What a call returned, or the exception that it raised."""


class Batcher[K: Hashable]:
    """Collects requests for actions, and answers those that wait together in one call.

    A batch is due when `max_batch_size` requests wait, when every open session waits, so that no
    other request can come, or when requests have waited long enough since the last batch ended. All
    other calls are made at once. No two calls run at the same time.

    Args:
        make: Makes the policy, for the first session; called again if it raised.
        max_batch_size: Maximum requests in a batch; with 1, `act_batch` is never called.
        timeout_s: Maximum seconds that requests wait for others while no batch runs.
    """

    def __init__(self, make: Callable[[], BatchPolicy], max_batch_size: int, timeout_s: float):
        self._make, self._size, self._timeout_s = make, max_batch_size, timeout_s
        self._sessions: dict[K, Policy] = {}
        self._waiting: dict[K, tuple[Any, ...]] = {}  # arguments of `act`, oldest first
        self._since: float | None = None  # when the next batch began to be collected
        self._warned = False

    @cached_property
    def _policy(self) -> BatchPolicy:
        return self._make()

    def __contains__(self, key: K) -> bool:
        """Whether a session is open under a key."""
        return key in self._sessions

    def open(self, key: K) -> Policy:
        """Open a session under a key, and return it."""
        self._sessions[key] = self._policy.session()
        return self._sessions[key]

    def drop(self, key: K) -> None:
        """Close a session, if it is open, and forget its request."""
        self._waiting.pop(key, None)
        if (session := self._sessions.pop(key, None)) is not None:
            attempt(session.close)

    def close(self) -> None:
        """Close all sessions, and the policy if it was made."""
        for key in [*self._sessions]:
            self.drop(key)
        if "_policy" in vars(self):
            self._policy.close()

    def call(self, key: K, request: tuple[str, tuple[Any, ...]]) -> CallResult | None:
        """Call a session's method, by its name and arguments; None if it is `act`, which waits."""
        method, arguments = request
        if method == "act":
            self._waiting[key] = arguments
            return None
        return attempt(getattr(self._sessions[key], method), *arguments)

    def until_batch_s(self, now: float) -> float | None:
        """Return the seconds until `act` is to be called, 0 for now; None if no request waits."""
        if not self._waiting:
            self._since = None
            return None
        if self._since is None:
            self._since = now
        # If every session waits, nobody is left who could make the batch larger.
        if len(self._waiting) >= min(self._size, len(self._sessions)):
            return 0.0
        return max(0.0, self._since + self._timeout_s - now)

    def act(self) -> dict[K, CallResult]:
        """Answer the oldest requests, as many as fit into a batch.

        After an exception in the batch, each request is answered alone: only those at fault fail.
        """
        keys = [*self._waiting][: self._size]
        sessions = [self._sessions[key] for key in keys]
        requests = [self._waiting.pop(key) for key in keys]
        self._since = None
        if len(keys) > 1:
            observations, goals = zip(*requests, strict=True)
            actions, error = attempt(self._policy.act_batch, sessions, observations, goals)
            if error is None and len(actions) == len(keys):
                return {key: (chunk, None) for key, chunk in zip(keys, actions, strict=True)}
            if not self._warned:
                problem = error or f"it returned {len(actions)} results"
                logger.warning("A batch of %d is repeated one by one: %s", len(keys), problem)
                self._warned = True
        # Alone, a request needs no batch, and one that raises fails alone.
        pairs = zip(sessions, requests, strict=True)
        answers = [attempt(session.act, *request) for session, request in pairs]
        return dict(zip(keys, answers, strict=True))


def attempt(function: Any, *arguments: Any) -> CallResult:
    """Call a function; return its value, or the exception that it raised."""
    try:
        return function(*arguments), None
    except Exception as error:
        return None, error
