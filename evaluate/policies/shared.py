"""Policies that workers share (`policies`): the worker's side, and what answers all workers.

A worker has a `SharedPolicy`, which sends every call to its session in the policy's process: on
this machine (`process.py`) or on a node of a cluster (`runtime/ray_actors.py`). There a
`PolicyHost` answers. Both ways move only bytes: pickled calls and answers.
"""

import faulthandler
import pickle
import time
import traceback
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import closing, contextmanager, suppress
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any, Protocol, Self, cast, get_type_hints

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InterferenceError, PolicyError, ServerDiedError
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.simulators.episode import Observation

from .batching import Batcher, give
from .policy import Frames, Policy, RolloutInfo
from .registry import check_members, make_policy

_PING, _OPEN, _CLOSE = "ping", "open", "close"
"""Calls that do nothing, and that begin and end a session; all others are methods of a policy."""

_LOOK_S = 0.2
"""Seconds between two looks whether the run has ended."""


Ask = Callable[[bytes], bytes]
"""A worker's connection to a policy's process: it returns the answer to a request.

It raises `ServerDiedError` if the process ended, and is closed with its last reference.
"""


class Address(Protocol):
    """Where a policy's process is, also after it was started again."""

    def connect(self, worker: int) -> Ask:
        """Connect a worker, by its number; wait until the process listens.

        Raises:
            ServerDiedError: The run is over.
        """
        ...


class SharedPolicy(Policy):
    """A session of a policy in another process; it waits until that has loaded the policy.

    Every call raises what the policy's method raises, or `ServerDiedError` if the process ends.
    """

    def __init__(self, ask: Ask):
        self._ask = ask
        vars(self).update(self._call(_OPEN))  # the attributes of a policy

    @classmethod
    def open(cls, address: Address, worker: int) -> Self:
        """Open the session of a worker, by its number; wait for a process that is started again."""
        while True:
            ask = address.connect(worker)
            # It may have hung or died in the call of another worker: then it is started again.
            with suppress(ServerDiedError):
                ask(pickle.dumps((_PING, ())))
                break
        return cls(ask)

    def reset(self, info: RolloutInfo) -> None:
        """Prepare the session for a rollout."""
        self._call("reset", info)

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Add the next chunk of the history to the session's memory."""
        self._call("add_history", dict(frames), states, exec_start_idx)

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        """Add live observations to the session's memory."""
        self._call("observe", dict(frames), states)

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the next actions, which the policy may compute in a batch with others."""
        return cast("NDArray[np.float32]", self._call("act", observation, goal))

    def metadata(self) -> dict[str, Any]:
        """Return the session's metadata."""
        return cast("dict[str, Any]", self._call("metadata"))

    def close(self) -> None:
        """Close the session."""
        with suppress(ServerDiedError):
            self._call(_CLOSE)

    def _call(self, method: str, *arguments: Any) -> Any:
        value, error = pickle.loads(self._ask(pickle.dumps((method, arguments))))
        if error is not None:
            raise error
        return value


class PolicyHost:
    """Answers the calls of all workers; one thread makes them, so a policy needs no locks.

    A worker has one session; when it opens another, as after an error or its death, the former one
    is closed. The first session makes the policy. If that fails, its worker gets the error, and the
    next session makes it again. A call that takes too long ends the process.

    Args:
        config: Settings of the run.
        number: Number of the policy's process.
    """

    def __init__(self, config: RunConfig, number: int):
        self._config = config
        self._batcher: Batcher[int] = Batcher(
            lambda: make_policy(config.policy, config.policy_options, worker=number),  # type: ignore[arg-type, return-value]
            config.max_batch_size,
            config.batch_wait_timeout_s,
        )
        self._calls = SimpleQueue[tuple[int, str, tuple[Any, ...], Future[Any]]]()

    def start(self) -> None:
        """Make the calls in a thread, until this process ends."""
        Thread(target=self.run, args=(lambda: False,), daemon=True).start()

    def answer(self, worker: int, request: bytes) -> bytes:
        """Return the answer to a worker's call, in the worker's own thread.

        Raises:
            CancelledError: The worker opened another session meanwhile.
        """
        method, arguments = pickle.loads(request)
        answer = Future[Any]()
        self._calls.put((worker, method, arguments, answer))
        error = answer.exception()  # waits
        if error is None:
            try:
                return pickle.dumps((answer.result(), None))
            except Exception as problem:
                error = problem
        return pickle.dumps((None, _portable(error)))

    def run(self, ended: Callable[[], bool]) -> None:
        """Make the calls until the run has ended."""
        with closing(self._batcher):
            while not ended():
                until_batch_s = self._batcher.until_batch_s(time.monotonic())
                wait_s = _LOOK_S if until_batch_s is None else min(until_batch_s, _LOOK_S)
                with suppress(Empty):
                    self._make(*self._calls.get(timeout=wait_s))
                    while True:  # all that wait, so that a batch is as large as it can be
                        self._make(*self._calls.get(block=False))
                if self._batcher.until_batch_s(time.monotonic()) == 0:
                    with _time_limit(self._config.rollout_timeout_s):
                        self._batcher.act()

    def _make(
        self, worker: int, method: str, arguments: tuple[Any, ...], answer: Future[Any]
    ) -> None:
        with _time_limit(self._config.rollout_timeout_s):
            if method == _PING:
                answer.set_result(None)
            elif method == _CLOSE:
                give(answer, self._batcher.drop, worker)
            elif method == _OPEN:
                give(answer, self._open, worker)
            elif worker in self._batcher:
                self._batcher.call(worker, method, arguments, answer)
            else:
                # An actor that died is started again under its name, without its sessions.
                answer.set_exception(ended(RuntimeError("it was started again")))

    def _open(self, worker: int) -> dict[str, Any]:
        """Open a session in place of the worker's former one; return its attributes."""
        self._batcher.drop(worker)
        text = f"policy {self._config.policy!r}"
        try:
            session = self._batcher.open(worker)
        except InterferenceError:
            raise
        except Exception as error:
            problem = f"{text}: its session() raised {type(error).__name__}: {error}"
            raise PolicyError(problem, traceback.format_exc().rstrip()) from error
        check_members(f"{text}, session()", session)
        return {name: getattr(session, name) for name in get_type_hints(Policy)}


def ended(error: BaseException) -> ServerDiedError:
    """Return the error of a process that ended, from that of the connection to it."""
    reason = f": {error}" if str(error) else ""
    return ServerDiedError(f"the policy's process ended{reason}", "Its output is above.")


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    """End this process if the block takes longer, even while C code holds Python's lock."""
    faulthandler.dump_traceback_later(seconds, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


def _portable(error: BaseException) -> Exception:
    """Return an exception that can be pickled, with the traceback: itself, or its text."""
    portable: Any = None
    with suppress(Exception):
        portable = pickle.loads(pickle.dumps(error))
    if not isinstance(portable, Exception):
        portable = RuntimeError(f"{type(error).__name__}: {error}")
    portable.add_note(f"In the policy's process:\n{''.join(traceback.format_exception(error))}")
    return portable
