"""Workers on a Ray cluster: the one place that imports Ray, which needs the extra `cluster`.

A worker is an actor: Ray finds a node with room for it, and ends it with the job. One that died,
or was lost with its node, is replaced by another. Only the caller writes.
"""

import logging
import os
import shutil
import signal
import socket
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Set
from contextlib import closing, contextmanager, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read when Ray is imported

import ray
from ray.exceptions import OutOfMemoryError, RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    WorkerError,
    first_line,
)

from .executor import Executor, Session, describe
from .process import CLOSE_S, end_if_starting
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

    Every node that has room for a worker is asked first what it has installed, and what the tasks
    say of themselves there (`Task.describe`): a difference to this process is an error. A node
    that comes later is asked too, and left alone if it differs. Workers are in the folder that
    this process is in, where a node has it.

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
            folder = str(Path.cwd())
            own = describe(function)
            known = self._check_nodes(function, own, folder)
            actor: Any = WorkerActor
            make = actor.options(num_cpus=self.cpus, num_gpus=self.gpus, max_restarts=0).remote
            scheduler = _RayScheduler(make, (function, folder), own, known, self)
            with closing(scheduler):
                yield scheduler

    @property
    def wanted(self) -> str:
        """What a worker takes, for messages."""
        return f"{self.cpus:g} CPUs" + (f" and {self.gpus:g} GPUs" if self.gpus else "")

    def _check_nodes(self, function: Task, own: Mapping[str, str], folder: str) -> set[str]:
        """Compare all nodes that have room for a worker with this process; return their ids.

        One that is lost meanwhile is left out.
        """
        asked: dict[str, Any] = {}
        for node in _nodes():
            has = node["Resources"]
            if node["Alive"] and has.get("CPU", 0) >= self.cpus and has.get("GPU", 0) >= self.gpus:
                asked[node["NodeID"]] = _on_node(_describe, node["NodeID"]).remote(function, folder)
        if not asked and self.address == "local":
            raise WorkerError(
                f"this machine does not have {self.wanted} for a worker",
                "Set smaller cpus_per_worker and gpus_per_worker.",
            )
        wrong, known = [], set()
        for node_id, answer in asked.items():
            name = _name(node_id)
            try:
                wrong += _differences(name, ray.get(answer), own)
                known.add(node_id)
            except InterferenceError as error:
                wrong.append(f"{name}: {error.message}")
            except RayError as error:
                if any(node["Alive"] for node in _nodes() if node["NodeID"] == node_id):
                    wrong.append(f"{name}: {_cause(error)}")
        if wrong:
            raise WorkerError(
                "nodes of the cluster are not as this process is:\n  " + "\n  ".join(wrong),
                "Install the same on all nodes, and give a split that all of them see.",
            )
        return known


@ray.remote
def _describe(function: Task, folder: str) -> dict[str, str]:
    _enter(folder)
    return describe(function)


@ray.remote
def _left_behind(home: Path) -> tuple[TimeoutError | None, str | None, dict[str, bytes]]:
    """Return what a worker that died left on its node."""
    return left_behind(home)


@ray.remote
class WorkerActor:
    """A worker, on whatever node Ray starts it."""

    def begin(
        self, number: int, function: Task, folder: str, known: Set[str]
    ) -> tuple[str, Path, dict[str, str] | None]:
        """Return the node's id, the worker's folder and, unless the node is known, `describe`."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        _enter(folder)
        home = Path(tempfile.mkdtemp(prefix="robomme-interference-"))
        self._home, self._function, self._worker = home, function, ProcessWorker(number, home)
        node = ray.get_runtime_context().get_node_id()
        return node, home, None if node in known else describe(function)

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
        self.call = self.actor.begin.remote(self.number, *self._all.given, self._all.known)

    def settle(self) -> None:
        """Take note that it has begun; where it cannot, begin elsewhere."""
        try:
            self._node, self._home, found = ray.get(self.call)
        except RayTaskError as error:
            self._leave_out(_cause(error))
        except RayError as error:
            self._failures += 1
            if self._failures == _FAILURES:
                raise WorkerError(f"a worker cannot begin: {_cause(error)}") from None
            self._begin()
        else:
            wrong = [] if found is None else _differences(_name(self._node), found, self._all.own)
            if wrong:
                self._leave_out("; ".join(wrong))
            else:
                self._all.known.add(self._node)
                self.ready = True

    def _leave_out(self, why: str) -> None:
        """Do without an actor, which keeps its place, so that the next one is put elsewhere."""
        logger.warning("A worker is left out: %s", why)
        self._all.left_out.append(self.actor)
        self._begin()

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
            late, trace, files = ray.get(
                _on_node(_left_behind, self._node).remote(self._home), timeout=_COLLECT_S
            )
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
        make: Makes an actor.
        given: Function and folder, for `WorkerActor.begin`.
        own: What `describe` returns here.
        known: Ids of nodes where it returns the same.
        config: How many workers there are, and what each takes.
    """

    def __init__(
        self,
        make: Callable[[], Any],
        given: tuple[Task, str],
        own: Mapping[str, str],
        known: set[str],
        config: RayWorkers,
    ):
        super().__init__(config.workers)
        self.make, self.given, self.own, self.known = make, given, own, known
        self._wanted = config.wanted
        self.left_out: list[Any] = []  # actors on nodes that differ

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
        for actor in (*self.left_out, *(one.actor for one in self.workers)):
            ray.kill(actor)


def _on_node(function: Any, node_id: str) -> Any:
    """Return a remote function that runs on one node, whatever else runs there."""
    there = NodeAffinitySchedulingStrategy(node_id, soft=False)
    return function.options(num_cpus=0, scheduling_strategy=there)


def _enter(folder: str) -> None:
    """Be in the folder of the caller, where relative paths mean what they mean there."""
    with suppress(OSError):
        os.chdir(folder)


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


def _nodes() -> list[dict[str, Any]]:
    """Return what Ray knows of the nodes, those that are gone among them."""
    nodes: Any = ray.nodes
    found: list[dict[str, Any]] = nodes()
    return found


def _name(node_id: str) -> str:
    """Return what a node is called in messages: its address, and the beginning of its id."""
    known = {node["NodeID"]: node["NodeManagerAddress"] for node in _nodes()}
    return f"{known[node_id]}-{node_id[:6]}"


def _differences(name: str, found: Mapping[str, str], own: Mapping[str, str]) -> list[str]:
    """Return in words in what a node is not as this process is."""
    return [
        f"{name}: {key} is {found.get(key, 'missing')} there, {own.get(key, 'missing')} here"
        for key in sorted({*found, *own})
        if found.get(key) != own.get(key)
    ]


def _cause(error: RayError) -> str:
    return first_line(error.cause if isinstance(error, RayTaskError) else error)
