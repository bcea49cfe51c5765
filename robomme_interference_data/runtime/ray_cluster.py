"""Workers on a Ray cluster: the one place that imports Ray, which needs the extra `cluster`.

A worker is an actor: Ray finds a node with room for it, and ends it with the job. One that died,
or was lost with its node, is replaced by another. Only the caller writes.
"""

import logging
import os
import pickle
import shutil
import signal
import socket
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read when Ray is imported

import ray
from ray import cloudpickle
from ray.exceptions import OutOfMemoryError, RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from robomme_interference_data.errors import InvalidOptionError, WorkerError, first_line

from .executor import Executor, Session, describe
from .process import CLOSE_S, START_S, end_if_starting
from .scheduler import Reply, Scheduler
from .worker import ProcessWorker, Task, left_behind, unpickled

logger = logging.getLogger(__name__)

_PASSED = ("PYTHONPATH", "HF_ENDPOINT", "HF_HUB_OFFLINE")
"""What the environment of this process says to workers: where modules are, and where the Hub."""

_TOKEN = (
    "If its nodes want a token: set RAY_AUTH_MODE=token, and put theirs into ~/.ray/auth_token."
)

_CONNECT_S = 10.0
"""Seconds to wait for a cluster's head."""

_COLLECT_S = 30.0
"""Seconds that a node has to say what a worker that died left there."""

_FAILURES = 5
"""How often a worker may fail to begin."""

_WAIT_S = 30.0
"""Seconds after which a message says that no worker could begin yet."""


@dataclass(frozen=True)
class RayWorkers(Executor):
    """Runs tasks in worker processes on the nodes of a Ray cluster; see `Executor`.

    A worker says, as it begins, what its node has installed, and what the tasks say of themselves
    there (`Task.describe`): a difference to this process is an error. Workers are in the folder
    that this process is in, where a node has it.

    Attributes:
        workers: How many, at most; those for which there is no room start when a node comes.
        address: `auto` for the cluster that this machine is a node of, `HOST:PORT` of its head, or
            `local` for one that lasts as long as the work.
        cpus: Processors that each takes, of those that Ray counts.
        gpus: Share of a GPU that each takes.
    """

    workers: int
    address: str = "auto"
    cpus: float = 1.0
    gpus: float = 0.0

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InvalidOptionError.expected("workers", self.workers, "1 or more")
        for name in ("cpus", "gpus"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise InvalidOptionError.expected(
                    f"{name}_per_worker", getattr(self, name), "0 or more"
                )
        if self.gpus > 1 and self.gpus % 1:  # so Ray has it
            raise InvalidOptionError.expected("gpus_per_worker", self.gpus, "1 or less, or whole")
        port = self.address.rpartition(":")[2]
        if self.address not in ("auto", "local") and not (
            port != self.address and port.isdecimal() and int(port) < 1 << 16
        ):
            raise InvalidOptionError.expected(
                "ray_address", self.address, "auto, local or HOST:PORT"
            )

    @contextmanager
    def session(self, function: Task) -> Iterator[Session]:
        """Keep workers on nodes of a cluster in the block; see `Executor.session`.

        A worker that is lost with its node costs only the task that it works on.
        """
        end_if_starting()
        with _connected(self.address):
            resources: Any = ray.cluster_resources
            has = resources()
            if self.address == "local" and not (
                has.get("CPU", 0) >= self.cpus and has.get("GPU", 0) >= self.gpus
            ):
                raise WorkerError(
                    f"this machine does not have {self.wanted} for a worker",
                    "Set smaller cpus_per_worker and gpus_per_worker.",
                )
            with closing(_RayScheduler(function, self)) as scheduler:
                yield scheduler

    @property
    def wanted(self) -> str:
        """What a worker takes, for messages."""
        return f"{self.cpus:g} CPUs" + (f" and {self.gpus:g} GPUs" if self.gpus else "")


@ray.remote
def _left_behind(home: Path) -> tuple[TimeoutError | None, str | None, dict[str, bytes]]:
    """Return what a worker that died left on its node."""
    return left_behind(home)


@ray.remote
class WorkerActor:
    """A worker, on whatever node Ray starts it."""

    def begin(
        self, number: int, function: bytes, folder: str
    ) -> tuple[str, Path, dict[str, str] | str]:
        """Return the node's id, the worker's folder, and what `describe` says, or why it fails."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with suppress(OSError):  # relative paths mean what they mean in the caller's folder
            os.chdir(folder)
        self._home = Path(tempfile.mkdtemp(prefix="robomme-interference-"))
        self._worker = ProcessWorker(number, self._home)
        node = ray.get_runtime_context().get_node_id()
        with self._worker.limit(START_S, "the worker's start"):
            try:
                self._function = pickle.loads(function)
                return node, self._home, describe(self._function)
            except Exception as error:
                return node, self._home, first_line(error)

    def work(self, task: Any, time_limit: float | None) -> tuple[bytes, dict[str, bytes]]:
        """Return what came of a task, pickled, and the files that it sent."""
        try:
            done = self._worker.work(self._function, task, time_limit)
        except SystemExit:  # which Ray would take for a wish of the actor
            os._exit(1)
        return done, self._worker.take_files()

    def end(self) -> None:
        """Release what the function holds."""
        getattr(self._function, "close", lambda: None)()
        shutil.rmtree(self._home, ignore_errors=True)


class _RayWorker:
    """The driver's side of a worker; it begins as soon as there is room for it."""

    def __init__(self, scheduler: "_RayScheduler", number: int):
        self._all, self.number, self.ready = scheduler, number, False
        self._failures = 0
        self._node, self._home = "", Path()
        self._begin()

    def _begin(self) -> None:
        self.actor = self._all.make()
        self.call = self.actor.begin.remote(self.number, *self._all.given)

    def settle(self) -> None:
        """Take note that it has begun; where its process was lost, begin again."""
        try:
            self._node, self._home, found = ray.get(self.call)
        except RayError as error:
            self._failures += 1
            if self._failures == _FAILURES:
                raise WorkerError(f"a worker cannot begin: {_cause(error)}") from None
            self._begin()
            return
        if found != (own := self._all.own):
            wrong = found
            if isinstance(found, dict):
                wrong = "; ".join(
                    f"{key} is {found.get(key, 'missing')} there, {own.get(key, 'missing')} here"
                    for key in sorted({*found, *own})
                    if found.get(key) != own.get(key)
                )
            raise WorkerError(
                f"node {_name(self._node)} of the cluster is not as this process is: {wrong}",
                "Install the same on all nodes, and give a buffer set that all of them see.",
            )
        self.ready = True

    def send(self, task: Any, time_limit: float | None) -> None:
        """Let it work on a task."""
        self.call = self.actor.work.remote(task, time_limit)

    def receive(self) -> Reply:
        """Return its answer, or what became of it."""
        try:
            data, files = ray.get(self.call)
        except RayTaskError as error:
            raise error.cause from None
        except RayError as error:
            return self._death(error)
        return Reply(*unpickled(data), files, _name(self._node))

    def _death(self, error: RayError) -> Reply:
        """Tell a worker that broke, whose node can be asked why, from one that was lost."""
        try:
            if isinstance(error, OutOfMemoryError):
                raise error
            there = NodeAffinitySchedulingStrategy(self._node, soft=False)
            ask = _left_behind.options(num_cpus=0, scheduling_strategy=there)
            late, trace, files = ray.get(ask.remote(self._home), timeout=_COLLECT_S)
        except RayError:
            lost = RuntimeError(f"the worker was lost with its node: {_cause(error)}")
            return Reply(error=lost, worker="lost")
        broke = late or RuntimeError("the worker process died")
        return Reply(None, broke, trace, files, _name(self._node), "dead")

    def stop(self) -> None:
        """End it now; its guard ends what it started."""
        ray.kill(self.actor)


class _RayScheduler(Scheduler[_RayWorker]):
    """Runs tasks on the cluster.

    Args:
        function: What to do with each task.
        config: How many workers there are, and what each takes.
    """

    def __init__(self, function: Task, config: RayWorkers):
        super().__init__(config.workers)
        actor: Any = WorkerActor
        dumps: Any = cloudpickle.dumps
        options = {"num_cpus": config.cpus, "num_gpus": config.gpus, "max_restarts": 0}
        self.make = actor.options(**options).remote
        self.given, self.own = (dumps(function), str(Path.cwd())), describe(function)
        self._wanted = config.wanted

    def start(self, number: int) -> _RayWorker:
        """Start a worker, now or when there is room for it."""
        return _RayWorker(self, number)

    def wait(self, workers: Sequence[_RayWorker]) -> Iterable[_RayWorker]:
        """Wait until some have an answer, or are ready; return those with an answer."""
        calls = {one.call: one for one in workers}
        done, _ = ray.wait([*calls], timeout=_WAIT_S)
        if not done and not any(one.ready for one in workers):
            logger.warning("No node of the cluster has %s for a worker; waiting", self._wanted)
        answered = [calls[call] for call in done if calls[call].ready]
        for call in done:
            if not calls[call].ready:
                calls[call].settle()
        return answered

    def close(self) -> None:
        """End all actors."""
        ends = [one.actor.end.remote() for one in self.workers if one.ready]
        if ends:
            ray.wait(ends, num_returns=len(ends), timeout=CLOSE_S)
        for one in self.workers:
            one.stop()


@contextmanager
def _connected(address: str) -> Iterator[None]:
    """Be a driver of a cluster in the block, unless this process is one already."""
    if ray.is_initialized():
        yield
        return
    unreached = WorkerError(
        f"no Ray cluster can be reached at {address!r}",
        'Start one with  ray start --head  and give its address, or "local".',
    )
    host, colon, port = address.rpartition(":")
    if colon:  # Ray itself would wait for minutes
        try:
            socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()
        except (OSError, ValueError):
            raise unreached from None
    # What Ray says of nodes that are lost goes to stdout, which is for the rows.
    with redirect_stdout(sys.stderr):
        try:
            ray.init(
                address=address,
                include_dashboard=False if address == "local" else None,
                log_to_driver=False,
                logging_level=logging.ERROR,
                runtime_env={"env_vars": {k: v for k, v in os.environ.items() if k in _PASSED}},
            )
        except ConnectionError as error:
            unreached.hint = f"{unreached.hint}\n{_TOKEN}"
            raise unreached from error
        except (ValueError, RuntimeError, RayError) as error:  # such as another version of Ray
            raise WorkerError(
                f"the Ray cluster at {address!r} refuses: {first_line(error)}",
                f"Install the same Ray and Python here and on its nodes.\n{_TOKEN}",
            ) from error
        try:
            yield
        finally:
            ray.shutdown()


def _name(node_id: str) -> str:
    """Return what a node is called in messages: its address, and the beginning of its id."""
    nodes: Any = ray.nodes
    known = {node["NodeID"]: node["NodeManagerAddress"] for node in nodes()}
    return f"{known[node_id]}-{node_id[:6]}"


def _cause(error: RayError) -> str:
    return first_line(error.cause if isinstance(error, RayTaskError) else error)
