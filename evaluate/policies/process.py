"""Policies in processes of their own, which workers share (`policies`).

A worker has a `SharedPolicy`: it forwards every call over a socket to its session in a policy's
process, in which one thread answers all workers. A process that dies is started again: rollouts
that it served are repeated, and those that ask next wait until it has loaded the policy.
"""

import logging
import os
import pickle
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from multiprocessing import AuthenticationError
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, cast, get_type_hints

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import (
    InterferenceError,
    PolicyError,
    ServerDiedError,
    WorkerError,
)
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.runtime.executor import Session, Worker, make_executor
from robomme_interference_data.runtime.process import CLOSE_S
from robomme_interference_data.simulators.episode import Observation

from .batching import Answer, Batcher, attempt
from .policy import Frames, Policy, RolloutInfo
from .registry import check_members, make_policy
from .sockets import Address, Directory, accept

logger = logging.getLogger(__name__)

_OPEN = "open"
"""The first message of a session; others name a method."""


class SharedPolicy(Policy):
    """A session of a policy in another process; it waits until that has loaded the policy.

    Every call raises what the policy's method raises, or `ServerDiedError` if the process ends.

    Args:
        connection: A connection that `connect` made.
    """

    def __init__(self, connection: Connection):
        self._connection = connection
        try:
            vars(self).update(self._answer())  # the attributes of a policy
        except BaseException:
            self.close()
            raise

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
        self._connection.close()

    def _call(self, method: str, *arguments: Any) -> Any:
        with _death():
            _send(self._connection, (method, arguments))
        return self._answer()

    def _answer(self) -> Any:
        with _death():
            value, error = _receive(self._connection)
        if error is not None:
            raise error
        return value


def connect(address: Address) -> Connection:
    """Request a session from a policy's process."""
    with _death():
        connection = address.connect()
        _send(connection, (_OPEN, ()))
        return connection


@dataclass(frozen=True)
class ServePolicy:
    """What a policy's process does: a task of an executor, its address.

    The first session makes the policy. If that fails, its connection gets the error, and the next
    session makes it again.
    """

    config: RunConfig

    def __call__(self, task: Address, worker: Worker) -> None:
        """Answer all connections until the run ends."""
        config, number = self.config, task.number
        if not config.on_cluster and config.policies != 1:
            choose_gpu(number)  # on a cluster Ray does it
        batcher: Batcher[Connection] = Batcher(
            lambda: make_policy(config.policy, config.policy_options, worker=number),  # type: ignore[arg-type, return-value]
            config.max_batch_size,
            config.batch_wait_timeout_s,
        )
        clients: list[Connection] = []
        with closing(batcher), task.listen() as (listener, ended):
            while True:
                ready: list[Any] = wait(
                    [ended, listener, *clients], batcher.due_s(time.monotonic())
                )
                if ended in ready:
                    return
                with worker.limit(config.rollout_timeout_s, "a call of the policy"):
                    for client in ready:
                        if client is listener:
                            if (new := accept(listener, task.key)) is not None:
                                clients.append(new)
                            continue
                        request, end = attempt(_receive, client)
                        if end is not None:  # its worker ended, or closed it
                            clients.remove(client)
                            batcher.drop(client)
                        elif request[0] == _OPEN:
                            _reply(client, attempt(self._open, batcher, client))
                        elif answer := batcher.call(client, request):
                            _reply(client, answer)
                    if batcher.due_s(time.monotonic()) == 0:
                        for client, answer in batcher.act().items():
                            _reply(client, answer)

    def _open(self, batcher: Batcher[Connection], client: Connection) -> dict[str, Any]:
        """Open a session; return its attributes."""
        text = f"policy {self.config.policy!r}"
        try:
            session = batcher.open(client)
        except InterferenceError:
            raise
        except Exception as error:
            problem = f"{text}: its session() raised {type(error).__name__}: {error}"
            raise PolicyError(problem, traceback.format_exc().rstrip()) from error
        check_members(f"{text}, session()", session)
        return {name: getattr(session, name) for name in get_type_hints(Policy)}


def choose_gpu(number: int) -> None:
    """Let this process use one of the machine's GPUs; before it imports torch.

    The processes share the GPUs evenly.
    """
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    found = sorted(Path("/proc/driver/nvidia/gpus").glob("*")) if chosen is None else []
    gpus = chosen.split(",") if chosen else [*map(str, range(len(found)))]
    if len(gpus) > 1:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[number % len(gpus)]


@contextmanager
def policy_processes(config: RunConfig) -> Iterator[tuple[Address, ...]]:
    """Run the policy's processes in the block, where workers run; yield their addresses.

    When the block begins, each has loaded the policy.

    Raises:
        PolicyError: The policy cannot be made.
        ServerDiedError: A process died while it made it.
    """
    failures = list[WorkerError]()
    count = config.policies or 0
    executor = make_executor(replace(config, workers=count, resources=config.policy_resources))
    with ExitStack() as stack:
        session = stack.enter_context(executor.session(ServePolicy(config)))
        directory = Directory(executor.host)
        addresses = tuple(map(directory.address, range(count)))

        def supervise() -> None:
            try:
                for outcome in session.run(addresses, attempts=sys.maxsize):
                    if outcome.error is not None:
                        failures.append(WorkerError(f"the policy's process ended: {outcome.error}"))
                        break
            except WorkerError as error:  # a process cannot start
                failures.append(error)
            directory.close()  # whoever waits gets an error

        thread = threading.Thread(target=supervise, daemon=True)
        thread.start()
        stack.callback(_join, thread, session)
        stack.callback(directory.close)
        with ExitStack() as first:
            try:  # connect to all before waiting for one: they load at the same time
                connections = [first.enter_context(connect(address)) for address in addresses]
                for connection in connections:
                    SharedPolicy(connection)
            except ServerDiedError as error:
                raise (failures[0] if failures else error) from None
        yield addresses


def _join(thread: threading.Thread, session: Session) -> None:
    """Wait for processes that end; kill those that do not in time, such as in a long call."""
    thread.join(CLOSE_S)
    while thread.is_alive():
        session.kill()  # those that replace them find no directory, and end
        thread.join(CLOSE_S)


@contextmanager
def _death() -> Iterator[None]:
    """Convert the end of a connection into the error of a process that ended."""
    try:
        yield
    except (AuthenticationError, EOFError, OSError) as error:
        reason = f": {error}" if str(error) else ""
        problem = f"the policy's process ended{reason}"
        raise ServerDiedError(problem, "Its output is above.") from error


def _reply(client: Connection, answer: Answer) -> None:
    """Send an answer; an exception with its traceback, and as text if it cannot be pickled."""
    value, error = answer
    if error is None:
        _, error = attempt(_send, client, (value, None))
        if error is None or isinstance(error, OSError):  # its worker ended
            return
    trace = "".join(traceback.format_exception(error))
    copied, _ = attempt(lambda: pickle.loads(pickle.dumps(error)))
    if not isinstance(copied, Exception):
        copied = RuntimeError(f"{type(error).__name__}: {error}")
    copied.add_note(f"In the policy's process:\n{trace}")
    attempt(_send, client, (None, copied))


def _send(connection: Connection, value: Any) -> None:
    """Send a value, and then the bytes of its arrays, which are not copied into its pickle."""
    buffers: list[pickle.PickleBuffer] = []
    data = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    views = [one.raw() for one in buffers]
    connection.send_bytes(pickle.dumps((data, [len(view) for view in views])))
    for view in views:
        connection.send_bytes(view)


def _receive(connection: Connection) -> Any:
    """Receive a value; its arrays can be written to."""
    data, sizes = pickle.loads(connection.recv_bytes())
    buffers = [bytearray(size) for size in sizes]
    for one in buffers:
        connection.recv_bytes_into(one)
    return pickle.loads(data, buffers=buffers)
