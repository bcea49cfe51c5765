"""Workers on a Ray cluster. Only this module and `ray_actors` import Ray (extra `cluster`).

A worker is an actor: Ray places it on a node with enough resources and ends it with the job. A
worker that dies, or is lost with its node, is replaced. Only the caller writes files.
"""

import logging
import os
import pickle
import re
import shutil
import signal
import socket
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import chdir, closing, contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read when Ray is imported

import ray
from ray import cloudpickle
from ray.exceptions import OutOfMemoryError, RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from robomme_interference_data.errors import InvalidOptionError, WorkerError, first_line

from .executor import Executor, Resources, WorkerPool, describe
from .process import CLOSE_S, START_S
from .process_worker import ProcessWorker, read_remains
from .safe_path import SAFE_PATH, safe_path
from .sockets import long_path_error
from .tasks import Outcome, Scheduler, TaskFunction, end_if_starting, unpickle_outcome

logger = logging.getLogger(__name__)

_PASSED = (SAFE_PATH, "HF_ENDPOINT", "HF_HUB_OFFLINE")
"""Environment variables that workers inherit."""

_CONNECT_S = 10.0
"""Seconds to wait for the cluster's head."""

_COLLECT_S = 30.0
"""Seconds to wait for what a dead worker left on its node."""

_FAILURES = 5
"""How often a worker may fail to start."""

_WAIT_S = 30.0
"""Seconds after which a warning reports that no worker could start yet."""


@dataclass(frozen=True)
class RayWorkers(Executor):
    """Runs tasks in worker processes on the nodes of a Ray cluster; see `Executor`.

    When a worker starts, the result of `describe` on its node must equal that of this process.
    Workers run in the current folder of this process if their node has it.

    Attributes:
        workers: Maximum number of workers; those that do not fit start when a node joins.
        address: `auto` for the cluster of this machine, `HOST:PORT` of its head, or `local` for a
            cluster that ends with the work.
        resources: What Ray reserves for each worker.
    """

    workers: int
    address: str = "auto"
    resources: Resources = field(default_factory=Resources)

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InvalidOptionError.expected("workers", self.workers, "1 or more")
        if not re.fullmatch(r"auto|local|[^/]+:\d{1,5}", self.address):
            expected = "ray, ray:local or ray:HOST:PORT"
            raise InvalidOptionError.expected("executor", f"ray:{self.address}", expected)

    @contextmanager
    def pool(self, function: TaskFunction) -> Iterator[WorkerPool]:
        """Keep workers on nodes of a cluster in the block; see `Executor.pool`."""
        end_if_starting()
        with connected(self.address), closing(_RayScheduler(function, self)) as scheduler:
            yield scheduler


@ray.remote
def _read_remains(home: Path) -> Outcome:
    """Return, on the node of a dead worker, the outcome of its last task."""
    return read_remains(home)


@ray.remote
class WorkerActor:
    """A worker on the node where Ray starts it."""

    def begin(
        self, number: int, function: bytes, folder: str
    ) -> tuple[str, Path, dict[str, str] | str]:
        """Return the node's id, the worker's folder, and the result of `describe` or its error."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        with suppress(OSError):  # so that relative paths keep their meaning
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
        """Return the pickled outcome of a task and the files that it sent."""
        try:
            outcome = self._worker.work(self._function, task, time_limit)
        except SystemExit:  # Ray would end the actor without an error
            os._exit(1)
        return outcome, self._worker.take_files()

    def end(self) -> None:
        """Release the function's resources."""
        getattr(self._function, "close", lambda: None)()
        shutil.rmtree(self._home, ignore_errors=True)


class _RayWorker:
    """The driver's side of a worker, which starts when Ray has the resources for it."""

    def __init__(self, scheduler: "_RayScheduler", number: int):
        self._scheduler, self.number, self.ready = scheduler, number, False
        self._failures = 0
        self._node, self._home = "", Path()
        self._begin()

    def _begin(self) -> None:
        self.actor = self._scheduler.make_actor()
        self.call = self.actor.begin.remote(self.number, *self._scheduler.arguments)

    def finish_start(self) -> None:
        """Check the worker's node; if the worker died while it started, start it again."""
        try:
            self._node, self._home, versions = ray.get(self.call)
        except RayError as error:
            # A node may be lost while a worker starts on it.
            self._failures += 1
            if self._failures == _FAILURES:
                raise WorkerError(f"a worker cannot start: {_cause(error)}") from None
            self._begin()
            return
        check_node(self._node, versions, self._scheduler.versions)
        self.ready = True

    def send(self, task: Any, time_limit: float | None) -> None:
        """Start a task."""
        self.call = self.actor.work.remote(task, time_limit)

    def receive(self) -> Outcome:
        """Return the outcome, which has arrived."""
        try:
            data, files = ray.get(self.call)
        except RayTaskError as error:
            raise error.cause from None
        except RayError as error:
            return self._death(error)
        return unpickle_outcome(data, files, _name(self._node))

    def _death(self, error: RayError) -> Outcome:
        """Return the outcome of a worker that died, which its node knows, or was lost with it."""
        try:
            if isinstance(error, OutOfMemoryError):
                raise error
            strategy = NodeAffinitySchedulingStrategy(self._node, soft=False)
            # No CPU, since the node may have none free.
            read = _read_remains.options(num_cpus=0, scheduling_strategy=strategy)
            outcome = ray.get(read.remote(self._home), timeout=_COLLECT_S)
        except RayError:
            lost = RuntimeError(f"the worker was lost with its node: {_cause(error)}")
            return Outcome(error=lost, worker="lost")
        died = outcome.error or RuntimeError("the worker process died")
        return replace(outcome, error=died, node=_name(self._node))

    def kill(self) -> None:
        """Kill it; its guard kills the processes that it started."""
        ray.kill(self.actor)

    stop = kill


class _RayScheduler(Scheduler[_RayWorker]):
    """Runs tasks on the cluster."""

    def __init__(self, function: TaskFunction, config: RayWorkers):
        super().__init__(function, config.workers)
        actor: Any = WorkerActor
        dumps: Any = cloudpickle.dumps
        cpus, gpus = config.resources.cpus, config.resources.gpus
        # Restarts are ours: `_death` must first learn what the task was, and what it left.
        self.make_actor = actor.options(num_cpus=cpus, num_gpus=gpus, max_restarts=0).remote
        self.arguments, self.versions = (dumps(function), str(Path.cwd())), describe(function)
        self._needs = f"{cpus:g} CPUs and {gpus:g} GPUs"

    def start(self, number: int) -> _RayWorker:
        """Request a worker."""
        return _RayWorker(self, number)

    def wait(self, workers: Sequence[_RayWorker]) -> Iterable[_RayWorker]:
        """Wait until some have an outcome, or are ready; return those with an outcome."""
        calls = {worker.call: worker for worker in workers}
        done, _ = ray.wait([*calls], timeout=_WAIT_S)
        if not done and not any(worker.ready for worker in workers):
            logger.warning("Waiting for a node of the cluster with %s free", self._needs)
        arrived = [calls[call] for call in done]
        answered = [worker for worker in arrived if worker.ready]
        for worker in arrived:
            if not worker.ready:
                worker.finish_start()
        return answered

    def close(self) -> None:
        """End all actors."""
        ends = [worker.actor.end.remote() for worker in self.workers if worker.ready]
        if ends:
            ray.wait(ends, num_returns=len(ends), timeout=CLOSE_S)
        for worker in self.workers:
            worker.stop()


def check_node(node: str, versions: Mapping[str, str] | str, expected: Mapping[str, str]) -> None:
    """Compare what `describe` returned on a node, or its error, with this process's."""
    if versions == expected:
        return
    differences = versions
    if not isinstance(versions, str):
        differences = "; ".join(
            f"{key} is {versions.get(key, 'missing')} there, {expected.get(key, 'missing')} here"
            for key in sorted({*versions, *expected})
            if versions.get(key) != expected.get(key)
        )
    raise WorkerError(
        f"node {_name(node)} of the cluster differs from this process: {differences}",
        "Install the same packages on all nodes, and use a buffer set that all can read.",
    )


@contextmanager
def connected(address: str) -> Iterator[None]:
    """Connect to a cluster in the block, unless this process is connected already."""
    if ray.is_initialized():
        yield
        return
    environment = _worker_environment()
    # Ray prints messages about lost nodes to stdout, which is reserved for the rows.
    with redirect_stdout(sys.stderr):
        try:
            host, colon, port = address.rpartition(":")
            if colon:  # Ray itself would wait for minutes
                socket.create_connection((host, int(port)), timeout=_CONNECT_S).close()
            # Ray puts the folder that is current now on the import path of all workers.
            with safe_path(), chdir(sys.prefix):
                ray.init(
                    address=address,
                    include_dashboard=False if address == "local" else None,
                    log_to_driver=False,
                    logging_level=logging.ERROR,
                    runtime_env={"env_vars": environment},
                )
        except (OSError, OverflowError, ValueError, RuntimeError, RayError) as error:
            if "AF_UNIX path length" in str(error):  # Ray has no class of its own for it
                raise long_path_error(
                    os.environ.get("RAY_TMPDIR", tempfile.gettempdir())
                ) from error
            raise WorkerError(
                f"cannot connect to the Ray cluster at {address!r}: {first_line(error)}",
                'Start one with  ray start --head  and set its address, or set "local". Its nodes '
                "need the same Ray and Python as this machine. If it requires a token, set "
                "RAY_AUTH_MODE=token and copy the token to ~/.ray/auth_token.",
            ) from error
        try:
            yield
        finally:
            ray.shutdown()


def _worker_environment() -> dict[str, str]:
    """Return the environment variables that workers inherit, with absolute import paths."""
    with safe_path():
        environment = {name: os.environ[name] for name in _PASSED if name in os.environ}
    if paths := list(filter(None, os.environ.get("PYTHONPATH", "").split(os.pathsep))):
        environment["PYTHONPATH"] = os.pathsep.join(str(Path(path).absolute()) for path in paths)
    return environment


def _name(node_id: str) -> str:
    """Return a node's name in messages: its address and the beginning of its id."""
    nodes: Any = ray.nodes
    addresses = {node["NodeID"]: node["NodeManagerAddress"] for node in nodes()}
    return f"{addresses[node_id]}-{node_id[:6]}"


def _cause(error: RayError) -> str:
    return first_line(error.cause if isinstance(error, RayTaskError) else error)
