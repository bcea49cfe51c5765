"""Executors: run tasks in this process (`Serial`), in processes, or on a cluster (`RayWorkers`).

Outcomes are values. `concurrent.futures` stops all work when one process dies and cannot stop a
task that hangs. Pebble can, but neither retries it, nor ends the processes that it started, nor
reports where it hung.
"""

import math
import platform
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, replace
from importlib import import_module, metadata
from typing import Any, Self

from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.lazy import load_extra
from robomme_interference_data.schema.settings import setting

from .specs import bind_options
from .tasks import Outcome, Scheduler, TaskFunction, Worker, attempt, end_if_starting

__all__ = [
    "Executor",
    "Outcome",
    "Resources",
    "Serial",
    "WorkerPool",
    "TaskFunction",
    "Worker",
    "end_if_starting",
    "make_executor",
]


_EXECUTION = "Execution"


@dataclass(frozen=True, kw_only=True)
class WorkersConfig:
    """Settings of the workers."""

    workers: int = setting(1, help="Worker processes.", metavar="N", group=_EXECUTION)
    executor: str = setting(
        "processes",
        metavar="processes|ray|ray:ADDRESS",
        help="Where workers run: on this machine, or on the Ray cluster of this machine, of the "
        "head at HOST:PORT, or local (for this command).",
        group=_EXECUTION,
    )
    resources: tuple[str, ...] = setting(
        (),
        metavar="cpus=N,gpus=N",
        help="What Ray reserves for each worker; a GPU may be shared.",
        shown="cpus=1,gpus=0",
        group=_EXECUTION,
    )

    @property
    def on_cluster(self) -> bool:
        """Whether workers run on a cluster, which has resources to reserve."""
        return self.executor != "processes"


@dataclass(frozen=True)
class Resources:
    """What Ray reserves for a process: CPUs, and GPUs or a share of one."""

    cpus: float = 1.0
    gpus: float = 0.0

    @classmethod
    def parse(cls, setting: str, texts: Sequence[str]) -> Self:
        """Read `cpus=2` and `gpus=0.5`; `setting` is where they stand, for the message.

        Raises:
            InvalidOptionError: A resource is unknown, or its number cannot be reserved.
        """
        resources = cls(**bind_options(named(setting), cls, {}, texts))
        if not 0 <= resources.cpus < math.inf:
            raise InvalidOptionError.expected(
                f"{named(setting)}: cpus", resources.cpus, "0 or more"
            )
        whole = resources.gpus <= 1 or resources.gpus % 1 == 0  # Ray shares one GPU, not several
        if not (0 <= resources.gpus < math.inf and whole):
            expected = "0 to 1, or a whole number"
            raise InvalidOptionError.expected(f"{named(setting)}: gpus", resources.gpus, expected)
        return resources


def make_executor(config: WorkersConfig) -> "Executor":
    """Return the executor that the settings describe."""
    if not config.on_cluster:
        if config.resources:
            raise InvalidOptionError(
                f"{named('resources')} has no effect with {named('executor', 'processes')}",
                f"Set {named('executor', 'ray')}, or leave it out.",
            )
        # By name: a run in this process starts no others, and imports nothing to start them.
        processes: Any = import_module(f"{__package__}.process").Processes
        local: Executor = processes(config.workers)
        return local
    address, resources = ray_address(config), Resources.parse("resources", config.resources)
    make = load_extra(
        f"{__package__}.ray_cluster", "RayWorkers", named("executor", "ray"), "cluster"
    )
    executor: Executor = make(config.workers, address, resources)
    return executor


def ray_address(config: WorkersConfig) -> str:
    """Return the address of the Ray cluster that the settings name."""
    name, colon, address = config.executor.partition(":")
    if name != "ray":
        known = ("processes", "ray", "ray:HOST:PORT", "ray:local")
        raise InvalidOptionError.one_of("executor", config.executor, known)
    return address if colon else "auto"


def describe(function: TaskFunction) -> dict[str, str]:
    """Return what must be equal on all machines: versions, and what the function describes."""
    return own_versions() | getattr(function, "describe", dict)()


def own_versions() -> dict[str, str]:
    """Return the versions of Python and of this package."""
    package = "robomme-interference-data"
    return {"python": platform.python_version(), package: metadata.version(package)}


WorkerPool = Scheduler[Any]
"""Workers that keep their copies of a function, and its resources, between runs."""


class Executor(ABC):
    """Runs tasks.

    Attributes:
        workers: Maximum number of tasks that run at once.
    """

    workers: int

    @abstractmethod
    def pool(self, function: TaskFunction) -> AbstractContextManager[WorkerPool]:
        """Keep workers for a function in the block, through several runs; then end all workers.

        Args:
            function: What to do with each task.
        """

    def run(
        self, function: TaskFunction, tasks: Iterable[Any], **limits: Any
    ) -> Generator[Outcome]:
        """Call a function on every task; yield outcomes as they arrive.

        A worker that dies or exceeds a limit is replaced. Its task is retried, unless the task
        exceeded `time_limit`: a retry would likely take as long again. A worker whose function
        raises `WorkerRetiredError` returns its task to the others and ends; any other exception,
        except those in `again`, is final. If the generator is closed early, workers that
        have a task are stopped.

        Args:
            function: What to do with each task.
            tasks: Picklable tasks.
            limits: `time_limit`: seconds that one task may take; None, the default, for no limit.
                `attempts`: how often a task is started before its error is reported; 2 by default.
                `again`: errors after which a task is retried, such as `TimeoutError`; none by
                default.
        """
        end_if_starting()
        # No worker is started for nothing.
        todo = list(tasks)
        if todo:
            with self.pool(function) as pool:
                yield from pool.run(todo, **limits)


@dataclass(frozen=True)
class Serial(Executor):
    """Runs tasks in this process, one after the other, without time limits."""

    workers = 1

    @contextmanager
    def pool(self, function: TaskFunction) -> Iterator[WorkerPool]:
        """Release the function's resources when the block ends; see `Executor.pool`."""
        with closing(_SerialScheduler(function, 1)) as scheduler:
            yield scheduler


class _Inline:
    """The worker of `Serial`: a task runs when it is sent."""

    number, ready = 0, True

    def __init__(self, function: TaskFunction):
        self._function, self._worker = function, Worker()

    def send(self, task: Any, time_limit: float | None) -> None:
        outcome = attempt(self._function, task, self._worker)
        self._outcome = replace(outcome, files=self._worker.take_files())

    def receive(self) -> Outcome:
        return self._outcome

    def kill(self) -> None:
        """There is no other process."""

    stop = kill


class _SerialScheduler(Scheduler[_Inline]):
    def start(self, number: int) -> _Inline:
        return _Inline(self.function)

    def wait(self, workers: Sequence[_Inline]) -> Iterable[_Inline]:
        return workers

    def close(self) -> None:
        getattr(self.function, "close", lambda: None)()
