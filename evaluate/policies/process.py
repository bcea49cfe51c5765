"""The processes of shared policies, on this machine or a cluster; see `shared.py`.

A process that dies is started again: rollouts that it served are repeated, and those that ask next
wait until it has loaded the policy.
"""

import logging
import os
import secrets
import shutil
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import AuthenticationError
from multiprocessing.connection import Client, Connection, Listener
from pathlib import Path

from robomme_interference_data.errors import ServerDiedError, WorkerError, named
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.lazy import load_extra
from robomme_interference_data.runtime.executor import (
    Resources,
    Worker,
    WorkerPool,
    make_executor,
    ray_address,
)
from robomme_interference_data.runtime.process import CLOSE_S
from robomme_interference_data.runtime.sockets import socket_folder

from .shared import Address, Ask, PolicyHost, SharedPolicy, ended

logger = logging.getLogger(__name__)

_KEY_BYTES = 32

_PAUSE_S = 0.1
"""Seconds between tries to connect to a process that does not listen yet."""

_CONNECTIONS = 64
"""Connections that may wait to be accepted."""


@contextmanager
def policy_processes(config: RunConfig) -> Iterator[Sequence[Address]]:
    """Run the policy's processes in the block, where workers run; yield their addresses.

    When the block begins, each has loaded the policy.

    Raises:
        PolicyError: The policy cannot be made.
        ServerDiedError: A process died while it made it.
        WorkerError: The processes cannot start.
    """
    if config.on_cluster:
        what = named("executor", "ray")
        run = load_extra("robomme_interference_data.runtime.ray_actors", "actors", what, "cluster")
        resources = Resources.parse("policy_resources", config.policy_resources)
        hosts = [partial(PolicyHost, config, number) for number in range(config.policies or 0)]
        with run(hosts, ray_address(config), resources, workers=config.workers) as addresses:
            _load(addresses)
            yield addresses
    else:
        with _local_processes(config) as addresses:
            yield addresses


def _load(addresses: Sequence[Address]) -> None:
    """Wait until all processes have loaded the policy, which they do at the same time."""
    # Workers have numbers from 0, so this session is none of theirs.
    with ThreadPoolExecutor(len(addresses)) as pool:
        for policy in pool.map(lambda address: SharedPolicy.open(address, -1), addresses):
            policy.close()


@dataclass(frozen=True)
class SocketAddress:
    """The address of a policy's process on this machine: a socket in a folder of the run.

    When the run ends, the folder goes: processes end, and who waits for one gets an error.
    """

    path: Path
    key: bytes = field(repr=False)
    number: int

    def connect(self, worker: int) -> Ask:
        """Connect a worker; wait until the process listens."""
        while self.path.parent.exists():
            # Missing or refused: it has not begun, or died and is started again.
            with suppress(FileNotFoundError, ConnectionError, EOFError):
                connection = Client(str(self.path), "AF_UNIX", self.key)
                connection.send(worker)
                return partial(_ask, connection)
            time.sleep(_PAUSE_S)
        raise ServerDiedError("the policy's process ended", "Its output is above.")


def _ask(connection: Connection, request: bytes) -> bytes:
    """Return the answer of a process to a request."""
    try:
        connection.send_bytes(request)
        return connection.recv_bytes()
    except (EOFError, OSError) as error:
        raise ended(error) from error


@dataclass(frozen=True)
class ServePolicy:
    """What a policy's process does: a task of an executor, its address."""

    config: RunConfig

    def __call__(self, task: SocketAddress, worker: Worker) -> None:
        """Answer all workers until the run ends."""
        if self.config.policies != 1:
            choose_gpu(task.number)
        if task.path.exists():
            logger.warning("The policy's process %d was started again", task.number)
            task.path.unlink()
        host = PolicyHost(self.config, task.number)
        # At the end of the run the folder is gone, and with it what the listener would remove.
        with (
            suppress(FileNotFoundError),
            Listener(str(task.path), "AF_UNIX", _CONNECTIONS, task.key) as listener,
        ):
            threading.Thread(target=_accept, args=(listener, host), daemon=True).start()
            host.run(ended=lambda: not task.path.exists())


def _accept(listener: Listener, host: PolicyHost) -> None:
    """Answer each connection in a thread, until the listener is closed."""
    while True:
        try:
            connection = listener.accept()
        except (AuthenticationError, EOFError, ConnectionError):
            continue  # a stranger, or a worker that was killed meanwhile
        except OSError:  # closed: the run has ended
            return
        threading.Thread(target=_answer, args=(connection, host), daemon=True).start()


def _answer(connection: Connection, host: PolicyHost) -> None:
    """Answer the calls of a worker, until it closes the connection."""
    with closing(connection), suppress(EOFError, OSError, CancelledError):
        worker: int = connection.recv()
        while True:
            connection.send_bytes(host.answer(worker, connection.recv_bytes()))


def choose_gpu(number: int) -> None:
    """Let this process use one of the machine's GPUs; before it imports torch.

    The processes share the GPUs evenly. On a cluster Ray does it.
    """
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is None:
        gpus = [str(index) for index, _ in enumerate(Path("/proc/driver/nvidia/gpus").glob("*"))]
    else:
        gpus = visible.split(",")
    if len(gpus) > 1:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[number % len(gpus)]


@contextmanager
def _local_processes(config: RunConfig) -> Iterator[Sequence[Address]]:
    """Run the processes on this machine in the block."""
    count = config.policies or 0
    failures = list[WorkerError]()
    # Not below the run: the path of a socket holds about 100 bytes. Other users cannot enter it.
    folder = socket_folder("policies-")
    key = secrets.token_bytes(_KEY_BYTES)
    addresses = tuple(SocketAddress(folder / str(n), key, n) for n in range(count))
    with make_executor(replace(config, workers=count)).pool(ServePolicy(config)) as pool:

        def supervise() -> None:
            try:
                # However often a process dies, it is started again: rollouts have a limit.
                for outcome in pool.run(addresses, attempts=sys.maxsize):
                    if outcome.error is not None:
                        failures.append(WorkerError(f"the policy's process ended: {outcome.error}"))
                        break
            except WorkerError as error:  # a process cannot start
                failures.append(error)
            shutil.rmtree(folder, ignore_errors=True)  # whoever waits gets an error

        thread = threading.Thread(target=supervise, daemon=True)
        thread.start()
        try:
            try:
                _load(addresses)
            except ServerDiedError as error:
                raise (failures[0] if failures else error) from None
            yield addresses
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            _join(thread, pool)


def _join(thread: threading.Thread, pool: WorkerPool) -> None:
    """Wait for processes that end; kill those that do not in time, such as in a long call."""
    thread.join(CLOSE_S)
    while thread.is_alive():
        pool.kill()  # those that replace them find no folder, and end
        thread.join(CLOSE_S)
