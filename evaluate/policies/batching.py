"""Batches: several rollouts ask one policy for actions, each through a session with its memory."""

import logging
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from functools import cached_property
from typing import Any

from .policy import BatchPolicy, Policy

logger = logging.getLogger(__name__)


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
        # Arguments of `act`, and where its answer goes; oldest first.
        self._waiting: dict[K, tuple[tuple[Any, ...], Future[Any]]] = {}
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
        """Close a session, if it is open, and cancel its request."""
        _, answer = self._waiting.pop(key, ((), None))
        if answer is not None:
            answer.cancel()
        session = self._sessions.pop(key, None)
        if session is not None:
            with suppress(Exception):  # of a session that nobody needs any more
                session.close()

    def close(self) -> None:
        """Close all sessions, and the policy if it was made."""
        for key in [*self._sessions]:
            self.drop(key)
        if "_policy" in vars(self):
            self._policy.close()

    def call(self, key: K, method: str, arguments: tuple[Any, ...], answer: Future[Any]) -> None:
        """Call a session's method at once and give its answer; `act` waits for a batch."""
        if method == "act":
            self._waiting[key] = arguments, answer
        else:
            give(answer, getattr(self._sessions[key], method), *arguments)

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

    def act(self) -> None:
        """Answer the oldest requests, as many as fit into a batch.

        After an exception in the batch, each request is answered alone: only those at fault fail.
        """
        keys = [*self._waiting][: self._size]
        sessions = [self._sessions[key] for key in keys]
        requests, answers = zip(*(self._waiting.pop(key) for key in keys), strict=True)
        self._since = None
        if len(keys) > 1:
            actions = self._act_batch(sessions, requests)
            if actions is not None:
                for answer, chunk in zip(answers, actions, strict=True):
                    answer.set_result(chunk)
                return
        # Alone, a request needs no batch, and one that raises fails alone.
        for session, request, answer in zip(sessions, requests, answers, strict=True):
            give(answer, session.act, *request)

    def _act_batch(
        self, sessions: Sequence[Policy], requests: Sequence[tuple[Any, ...]]
    ) -> Sequence[Any] | None:
        """Return the actions of each session; None, with a warning, if the batch fails."""
        observations, goals = zip(*requests, strict=True)
        try:
            actions = self._policy.act_batch(sessions, observations, goals)
            if len(actions) == len(sessions):
                return actions
            problem = f"it returned {len(actions)} results"
        except Exception as error:
            problem = str(error)
        if not self._warned:
            logger.warning("A batch of %d is repeated one by one: %s", len(sessions), problem)
            self._warned = True
        return None


def give(answer: Future[Any], function: Callable[..., Any], *arguments: Any) -> None:
    """Call a function; its value, or the exception that it raises, becomes the answer."""
    try:
        answer.set_result(function(*arguments))
    except Exception as error:
        answer.set_exception(error)
