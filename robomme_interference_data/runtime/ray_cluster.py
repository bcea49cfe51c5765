"""Workers on a Ray cluster: the one place that imports Ray, which needs the extra `cluster`.

A worker is an actor: Ray finds a node with room for it, starts it again elsewhere when the node is
lost, and ends it with the job. In it runs a worker process as on one machine (`worker_process`),
so limits, hangs and deaths are what they are there. Only the caller writes.
"""

import logging
import os
import socket
import sys
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Set
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Unpack

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # read when Ray is imported

import ray
from ray.exceptions import RayError, RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from robomme_interference_data.cli.console import say
from robomme_interference_data.errors import (
    ClusterError,
    InterferenceError,
    InvalidOptionError,
    WorkerRetiredError,
    first_line,
)

from .executor import ATTEMPTS, Limits, describe
from .process import (
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

_TOKEN = (
    "If its nodes want a token: set RAY_AUTH_MODE=token, and put theirs into ~/.ray/auth_token."
)

_CONNECT_S = 10.0
"""Seconds to wait for a cluster's head."""

_LOSSES = 5
"""How often a task's worker may be lost, with its node or to Ray's watch over memory."""

_LOOK_S = 30.0
"""Seconds after which it is told that no worker could begin yet."""


@dataclass(frozen=True)
class RayWorkers:
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
        if self.gpus > 1 and self.gpus % 1:  # so Ray has it
            raise InvalidOptionError.expected("--gpus-per-worker", self.gpus, "1 or less, or whole")
        port = self.address.rpartition(":")[2]
        if self.address not in ("auto", "local") and not (
            port != self.address and port.isdecimal() and int(port) < 1 << 16
        ):
            raise InvalidOptionError.expected(
                "--ray-address", self.address, "auto, local or HOST:PORT"
            )

    def run(
        self, function: Task, tasks: Iterable[Any], **limits: Unpack[Limits]
    ) -> Generator[Outcome]:
        """Call a function on every task in worker processes of a cluster; see `Executor.run`.

        A worker that is lost with its node counts as one that died. `Outcome.node` says where a
        task ran.

        Raises:
            ClusterError: There is no cluster, it is this machine and has no room, nodes differ
                from this process, or workers cannot be made.
        """
        end_if_starting()
        todo = list(tasks)
        if not todo:
            return
        with _connected(self.address):
            # As a value of each call: what lies in Ray's store is lost with its node.
            own, folder = describe(function), str(Path.cwd())
            known = self._check_nodes(function, own, folder)
            options = {"num_cpus": self.cpus, "num_gpus": self.gpus, "max_restarts": -1}
            host: Any = _Host
            make = partial(host.options(**options).remote, function, folder)
            work = _Work(make, min(self.workers, len(todo)), limits, own, known)
            try:
                yield from work.run(todo, self._wanted)
            finally:
                work.end()

    @property
    def _wanted(self) -> str:
        return f"{self.cpus:g} CPUs" + (f" and {self.gpus:g} GPUs" if self.gpus else "")

    def _check_nodes(self, function: Task, own: Mapping[str, str], folder: str) -> set[str]:
        """Compare all nodes that have room for a worker with this process; return their ids.

        One that is lost meanwhile is left out.

        Raises:
            ClusterError: Some differ; or there is none, and none can come.
        """
        asked: dict[str, Any] = {}
        for node in _nodes():
            has = node["Resources"]
            if node["Alive"] and has.get("CPU", 0) >= self.cpus and has.get("GPU", 0) >= self.gpus:
                there = NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
                call = _describe.options(num_cpus=0, scheduling_strategy=there)
                asked[node["NodeID"]] = call.remote(function, folder)
        if not asked and self.address == "local":
            raise ClusterError(
                f"this machine does not have {self._wanted} for a worker",
                "Give less with --cpus-per-worker and --gpus-per-worker.",
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
            raise ClusterError(
                "nodes of the cluster are not as this process is:\n  " + "\n  ".join(wrong),
                "Install the same on all nodes, and give a split that all of them see.",
            )
        return known


@ray.remote
def _describe(function: Task, folder: str) -> dict[str, str]:
    _enter(folder)
    return describe(function)


@ray.remote
class _Host:
    """Holds one worker process, on whatever node Ray starts it."""

    def __init__(self, function: Task, folder: str, number: int):
        _enter(folder)
        self._function, self._number, self._begun = function, number, False
        self._process: WorkerProcess | None = None
        self._node = ray.get_runtime_context().get_node_id()
        self._name = _name(self._node)

    def begin(self, known: Set[str]) -> tuple[str, dict[str, str] | None]:
        """Return the node's id, and unless that is known, what `describe` says there."""
        self._begun = True
        return self._node, None if self._node in known else describe(self._function)

    def work(
        self, task: Any, attempts: int, time_limit: float | None
    ) -> tuple[Outcome, bool] | None:
        """Do a task; return what became of it, and whether the worker process went with it.

        None, before `begin`: Ray has started it again, maybe on a node that nobody has looked at.
        """
        if not self._begun:
            return None
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


class _Given(NamedTuple):
    """A task, with how often it broke its worker, and how often its worker was lost."""

    task: Any
    broke: int = 0
    lost: int = 0

    @property
    def attempt(self) -> int:
        return self.broke + self.lost + 1


class _Work:
    """Hosts, and the tasks that they work on.

    Args:
        make: Makes a host of a number.
        hosts: How many there are.
        limits: Of the tasks.
        own: What `describe` says here.
        known: Ids of nodes where it says the same.
    """

    def __init__(
        self,
        make: Callable[[int], Any],
        hosts: int,
        limits: Limits,
        own: Mapping[str, str],
        known: set[str],
    ):
        self._make, self._limits, self._own, self._known = make, limits, own, known
        self._waiting: deque[_Given] = deque()
        self._idle: list[Any] = []
        self._left_out: list[Any] = []
        self._calls: dict[Any, tuple[Any, _Given | None]] = {}
        self._made = 0
        self._why = ""
        for _ in range(hosts):
            self._begin(self._new())

    def run(self, tasks: Iterable[Any], wanted: str) -> Iterator[Outcome]:
        """Yield outcomes as they come; `wanted` says what a worker takes, for who waits."""
        self._waiting += map(_Given, tasks)
        told = time.monotonic()
        while self._waiting or any(given for _, given in self._calls.values()):
            while self._waiting and self._idle:
                host, given = self._idle.pop(), self._waiting.popleft()
                call = host.work.remote(given.task, given.attempt, self._limits.get("time_limit"))
                self._calls[call] = host, given
            done, _ = ray.wait([*self._calls], timeout=_LOOK_S)
            for call in done:
                yield from self._settle(call, *self._calls.pop(call))
            if self._idle or any(given for _, given in self._calls.values()):
                told = time.monotonic()
            elif time.monotonic() - told > _LOOK_S:
                told = time.monotonic()
                say(f"No node of the cluster has {wanted} for a worker; waiting for one{self._why}")

    def end(self) -> None:
        """End all hosts: those without a task may close what they hold, within a time."""
        ends = [host.end.remote() for host in self._idle]
        if ends:
            ray.wait(ends, num_returns=len(ends), timeout=CLOSE_S)
        working = [host for host, _ in self._calls.values()]
        for host in (*self._idle, *self._left_out, *working):
            ray.kill(host)

    def _new(self) -> Any:
        self._made += 1
        return self._make(self._made - 1)

    def _begin(self, host: Any) -> None:
        self._calls[host.begin.remote(self._known)] = host, None

    def _settle(self, call: Any, host: Any, given: _Given | None) -> Iterator[Outcome]:
        """Take what came of a call; yield the outcome of its task, unless that is done again."""
        try:
            answer = ray.get(call)
        except RayTaskError as error:
            if given is not None:
                raise error.cause from None
            self._leave_out(host, _cause(error))
        except RayError as error:
            self._lose(host, error)
            if given is not None:
                yield from self._again(given._replace(lost=given.lost + 1), error)
        else:
            if given is None:
                self._take(host, *answer)
            elif answer is None:
                self._waiting.append(given)
                self._begin(host)
            else:
                yield from self._outcome(host, given, *answer)

    def _take(self, host: Any, node: str, found: Mapping[str, str] | None) -> None:
        """Let a host that has begun work, if its node is as it should be."""
        wrong = [] if found is None else _differences(_name(node), found, self._own)
        if wrong:
            self._leave_out(host, "; ".join(wrong))
        else:
            self._known.add(node)
            self._idle.append(host)

    def _leave_out(self, host: Any, why: str) -> None:
        """Do without a host, which keeps its place, so that the next one is put elsewhere."""
        say(f"A worker is left out: {why}")
        self._left_out.append(host)
        self._begin(self._new())

    def _lose(self, host: Any, error: RayError) -> None:
        """Begin a host again that Ray starts again, where there is room; or do without it."""
        self._why = f" (the last one: {_cause(error)})"
        if getattr(error, "actor_init_failed", False):
            self._retire(host, ClusterError(f"a worker cannot begin: {_cause(error)}"))
        else:
            self._begin(host)

    def _outcome(self, host: Any, given: _Given, outcome: Outcome, over: bool) -> Iterator[Outcome]:
        if isinstance(outcome.error, WorkerRetiredError):
            self._waiting.appendleft(given)
            self._retire(host, outcome.error)
            return
        self._idle.append(host)
        broke = given._replace(broke=given.broke + 1)
        again = over or isinstance(outcome.error, self._limits.get("again", ()))
        if again and broke.broke < self._limits.get("attempts", ATTEMPTS):
            self._waiting.append(broke)
        else:
            yield outcome

    def _again(self, given: _Given, error: RayError) -> Iterator[Outcome]:
        """Queue a task whose worker was lost, unless that was so often already."""
        if given.lost < _LOSSES:
            self._waiting.append(given)
        else:
            lost = RuntimeError(f"the worker was lost with its node: {_cause(error)}")
            yield Outcome(given.task, None, lost, None, given.attempt - 1)

    def _retire(self, host: Any, why: InterferenceError) -> None:
        """Do without a host; if it was the last one, that is an error."""
        ray.kill(host)
        if not self._idle and not self._calls:
            raise why
        say(f"A worker is left out: {why.message}")


def _enter(folder: str) -> None:
    """Be in the folder of the caller, where relative paths mean what they mean there."""
    with suppress(OSError):
        os.chdir(folder)


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
        except ConnectionError as error:
            unreached.hint = f"{unreached.hint}\n{_TOKEN}"
            raise unreached from error
        except (ValueError, RuntimeError, RayError) as error:  # such as another version of Ray
            raise ClusterError(
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
