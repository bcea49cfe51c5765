"""Workers on a Ray cluster: the one place that imports Ray, which needs the extra `cluster`.

A worker is an actor: Ray finds a node with room for it, starts it again elsewhere when the node is
lost, and ends it with the job. In it runs a worker process as on one machine (`worker_process`),
so limits, hangs and deaths are what they are there. Only the caller writes.
"""

import logging
import os
import socket
import sys
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping, Set
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass, replace
from typing import Any, Unpack

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read when Ray is imported

import ray
from ray.exceptions import RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from robomme_interference_data.console import say
from robomme_interference_data.errors import (
    ClusterError,
    InterferenceError,
    InvalidOptionError,
    WorkerRetiredError,
    first_line,
)
from robomme_interference_data.execution import ATTEMPTS, Limits, describe
from robomme_interference_data.worker_process import (
    CLOSE_S,
    Outcome,
    Task,
    WorkerProcess,
    end_if_starting,
    end_workers,
    wait_for,
)

_PASSED = ("PYTHONPATH", "HF_ENDPOINT", "HF_HUB_OFFLINE")
"""What the environment of this process says to workers: where modules are, and where the Hub."""

_CONNECT_S = 10.0
"""Seconds to wait for a cluster's head."""

_LOSSES = 5
"""How often a task is started at most when its nodes are lost, which is no fault of the task."""

_LOOK_S = 30.0
"""Seconds after which it is told that no worker could begin yet."""


@dataclass(frozen=True)
class RayWorkers:
    """Runs tasks in worker processes on the nodes of a Ray cluster; see `Executor`.

    Every node that has room for a worker is asked first what it has installed, and what the tasks
    say of themselves there (`Task.describe`): a difference to this process is an error. A node
    that comes later is asked too, and left alone if it differs.

    Attributes:
        workers: How many, at most; those for which there is no room start when a node comes.
        address: `auto` for the cluster that this machine is a node of, `HOST:PORT` of its head, or
            `local` for one that lasts as long as the work.
        cpus: Processors that each takes, of those that Ray counts.
        gpus: Share of a GPU that each takes.

    Raises:
        InvalidOptionError: A number is not what it may be.
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
                told = f"--{name}-per-worker"
                raise InvalidOptionError.expected(told, getattr(self, name), "0 or more")

    def run(
        self, function: Task, tasks: Iterable[Any], **limits: Unpack[Limits]
    ) -> Generator[Outcome]:
        """Call a function on every task in worker processes of a cluster; see `Executor.run`.

        A worker that is lost with its node counts as one that died. `Outcome.node` says where a
        task ran.

        Raises:
            ClusterError: There is no cluster, nodes differ from this process, or no worker can
                begin on any of them.
        """
        end_if_starting()
        todo = list(tasks)
        if not todo:
            return
        with _connected(self.address):
            own, shared = describe(function), ray.put(function)
            known = self._check_nodes(shared, own)
            options = {"num_cpus": self.cpus, "num_gpus": self.gpus, "max_restarts": -1}
            made: Any = _Host
            hosts = [
                made.options(**options).remote(shared, number)
                for number in range(min(self.workers, len(todo)))
            ]
            work = _Work(hosts, limits, own, known)
            try:
                yield from work.run(todo, self._wanted)
            finally:
                work.end()

    @property
    def _wanted(self) -> str:
        return f"{self.cpus:g} CPUs" + (f" and {self.gpus:g} GPUs" if self.gpus else "")

    def _check_nodes(self, shared: Any, own: Mapping[str, str]) -> set[str]:
        """Compare all nodes that have room for a worker with this process; return their ids.

        One that is lost meanwhile is left out.

        Raises:
            ClusterError: Some differ.
        """
        asked: dict[str, Any] = {}
        for node in _nodes():
            has = node["Resources"]
            if node["Alive"] and has.get("CPU", 0) >= self.cpus and has.get("GPU", 0) >= self.gpus:
                there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                call = _describe.options(num_cpus=0, scheduling_strategy=there)
                asked[node["NodeID"]] = call.remote(shared)
        wrong, known = [], set()
        for node_id, answer in asked.items():
            name = _name(node_id)
            try:
                wrong += _differences(name, ray.get(answer), own)
                known.add(node_id)
            except InterferenceError as error:
                wrong.append(f"{name}: {error.message}")
            except RayTaskError as error:
                wrong.append(f"{name}: {_cause(error)}")
            except RayError:  # Ray learns late that a node is gone
                continue
        if wrong:
            raise ClusterError(
                "nodes of the cluster are not as this process is:\n  " + "\n  ".join(wrong),
                "Install the same on all nodes, and give a split that all of them see.",
            )
        return known


@ray.remote
def _describe(function: Task) -> dict[str, str]:
    return describe(function)


@ray.remote
class _Host:
    """Holds one worker process, on whatever node Ray starts it."""

    def __init__(self, function: Task, number: int):
        self._function, self._number = function, number
        self._process: WorkerProcess | None = None
        self._node = ray.get_runtime_context().get_node_id()
        self._name = _name(self._node)

    def begin(self, known: Set[str]) -> tuple[str, dict[str, str] | None]:
        """Return the node's id, and unless that is known, what `describe` says there."""
        return self._node, None if self._node in known else describe(self._function)

    def work(self, task: Any, attempts: int, time_limit: float | None) -> tuple[Outcome, bool]:
        """Do a task; return what became of it, and whether the worker process went with it."""
        self._process = self._process or WorkerProcess(self._function, self._number)
        self._process.give(task, attempts, time_limit)
        while (outcome := self._process.settle()) is None:
            wait_for([self._process])
        over = self._process.over
        if over:
            self._process.stop()
            self._process = None
        return replace(outcome, node=self._name), over

    def end(self) -> None:
        """Let the worker process, which has no task, close what it holds."""
        end_workers([self._process] if self._process else [])


class _Work:
    """Hosts, and the tasks that they work on."""

    def __init__(
        self, hosts: Iterable[Any], limits: Limits, own: Mapping[str, str], known: set[str]
    ):
        self._limits, self._own, self._known = limits, own, known
        self._waiting: deque[tuple[Any, int]] = deque()
        self._idle: list[Any] = []
        self._calls: dict[Any, tuple[Any, tuple[Any, int] | None]] = {}
        for host in hosts:
            self._begin(host)

    def run(self, tasks: Iterable[Any], wanted: str) -> Iterator[Outcome]:
        """Yield outcomes as they come; `wanted` says what a worker takes, for who waits."""
        self._waiting += [(task, 1) for task in tasks]
        begun = False
        while self._waiting or any(given for _, given in self._calls.values()):
            while self._waiting and self._idle:
                host, given = self._idle.pop(), self._waiting.popleft()
                call = host.work.remote(*given, self._limits.get("time_limit"))
                self._calls[call] = host, given
            done, _ = ray.wait([*self._calls], timeout=_LOOK_S)
            begun = begun or bool(done)
            if not begun:
                say(f"No node of the cluster has {wanted} for a worker yet; waiting for one")
            for call in done:
                yield from self._settle(call, *self._calls.pop(call))

    def end(self) -> None:
        """End all hosts: those without a task may close what they hold, within a time."""
        ends = [host.end.remote() for host in self._idle]
        if ends:
            ray.wait(ends, num_returns=len(ends), timeout=CLOSE_S)
        for host in (*self._idle, *(host for host, _ in self._calls.values())):
            ray.kill(host)

    def _begin(self, host: Any) -> None:
        self._calls[host.begin.remote(self._known)] = host, None

    def _settle(self, call: Any, host: Any, given: tuple[Any, int] | None) -> Iterator[Outcome]:
        """Take what came of a call; yield the outcome of its task, unless that is done again."""
        try:
            answer = ray.get(call)
        except RayError as error:
            told = error.cause if isinstance(error, RayTaskError) else None
            if given is None and (told or getattr(error, "actor_init_failed", False)):
                self._retire(host, ClusterError(f"a worker cannot begin: {_cause(error)}"))
                return
            if told is not None:
                raise told from None
            self._begin(host)  # Ray starts it again, where there is room
            if given is not None and not self._again(given, _LOSSES):
                lost = RuntimeError(f"the worker was lost with its node: {_cause(error)}")
                yield Outcome(given[0], None, lost, None, given[1])
            return
        if given is None:
            node, found = answer
            wrong = [] if found is None else _differences(_name(node), found, self._own)
            if wrong:
                self._retire(host, ClusterError("; ".join(wrong), "Install the same there."))
            else:
                self._known.add(node)
                self._idle.append(host)
            return
        outcome, over = answer
        if isinstance(outcome.error, WorkerRetiredError):
            self._waiting.appendleft(given)
            self._retire(host, outcome.error)
            return
        self._idle.append(host)
        if not (
            (over or isinstance(outcome.error, self._limits.get("again", ())))
            and self._again(given, self._limits.get("attempts", ATTEMPTS))
        ):
            yield outcome

    def _again(self, given: tuple[Any, int], most: int) -> bool:
        """Queue a task once more, unless it was started so often already."""
        task, attempts = given
        if attempts >= most:
            return False
        self._waiting.append((task, attempts + 1))
        return True

    def _retire(self, host: Any, why: InterferenceError) -> None:
        """Do without a host; if it was the last one, that is an error."""
        ray.kill(host)
        if not self._idle and not self._calls:
            raise why
        say(f"A worker is left out: {why.message}")


@contextmanager
def _connected(address: str) -> Iterator[None]:
    """Be a driver of a cluster in the block, unless this process is one already.

    Raises:
        ClusterError: There is none at the address.
    """
    if ray.is_initialized():
        yield
        return
    unreached = ClusterError(
        f"no Ray cluster can be reached at {address!r}",
        "Start one with  ray start --head  and give its address, or --ray-address local.",
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
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise unreached from error
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
    return f"{known.get(node_id, socket.gethostname())}-{node_id[:6]}"


def _differences(name: str, found: Mapping[str, str], own: Mapping[str, str]) -> list[str]:
    """Return in words in what a node is not as this process is."""
    return [
        f"{name}: {key} is {found.get(key, 'missing')} there, {own.get(key, 'missing')} here"
        for key in sorted({*found, *own})
        if found.get(key) != own.get(key)
    ]


def _cause(error: RayError) -> str:
    return first_line(error.cause if isinstance(error, RayTaskError) else error)
