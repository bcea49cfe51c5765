"""Who runs tasks: this process (`Serial`), processes (`Processes`), or a cluster (`RayWorkers`).

Whatever has tasks takes an executor, and gets outcomes as values. `concurrent.futures` gives up
on all work when one process dies and cannot stop a hung task; pebble stops one, but neither tries
it again, nor ends what the task had started, nor reports where it hung.
"""

import platform
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterable, Iterator
from contextlib import AbstractContextManager, closing, contextmanager
from dataclasses import dataclass, fields
from importlib import metadata
from typing import Any, Protocol, Unpack

from robomme_interference_data.errors import InvalidOptionError, WorkerRetiredError
from robomme_interference_data.lazy import load_extra
from robomme_interference_data.schema.settings import setting

from .process import ProcessScheduler, end_if_starting
from .scheduler import ATTEMPTS, Limits
from .worker import Outcome, Task, Worker, attempt

__all__ = [
    "Executor",
    "Outcome",
    "Processes",
    "Serial",
    "Session",
    "Task",
    "Worker",
    "end_if_starting",
    "make_executor",
]


@dataclass(frozen=True, kw_only=True)
class WorkersConfig:
    """Who does the work."""

    workers: int = setting(1, help="Worker processes.", metavar="N", group="Execution")
    executor: str = setting(
        "processes", help="processes (on this machine) or ray (on a cluster).", group="Execution"
    )
    ray_address: str = setting(
        "auto",
        metavar="ADDRESS",
        help="Address of the Ray cluster: auto, local or HOST:PORT.",
        group="Execution",
    )
    cpus_per_worker: float = setting(
        1.0, help="CPUs that Ray reserves for each worker.", group="Execution"
    )
    gpus_per_worker: float = setting(
        0.0, help="Share of a GPU that Ray reserves for each worker.", group="Execution"
    )


def make_executor(config: WorkersConfig) -> "Executor":
    """Make the executor of some settings."""
    if config.executor == "processes":
        for one in fields(WorkersConfig)[2:]:
            if getattr(config, one.name) != one.default:
                raise InvalidOptionError(
                    f'{one.name} has no effect with executor="processes"',
                    'Set executor="ray", or leave it out.',
                )
        return Processes(config.workers)
    if config.executor != "ray":
        raise InvalidOptionError.one_of("executor", config.executor, ("processes", "ray"))
    make = load_extra(f"{__package__}.ray_cluster", "RayWorkers", 'executor="ray"', "cluster")
    executor: Executor = make(
        config.workers, config.ray_address, config.cpus_per_worker, config.gpus_per_worker
    )
    return executor


def describe(function: Task) -> dict[str, str]:
    """Return what must be the same on all machines that run a function, as text by name.

    Versions of Python and this package, and what its method `describe` returns, if it has one.
    """
    package = "robomme-interference-data"
    versions = {"python": platform.python_version(), package: metadata.version(package)}
    return versions | getattr(function, "describe", dict)()


class Session(Protocol):
    """Workers that are kept, with what their copies of the function hold, from run to run."""

    def run(self, tasks: Iterable[Any], **limits: Unpack[Limits]) -> Generator[Outcome]:
        """Call the session's function on every task; see `Executor.run`."""
        ...


class Executor(ABC):
    """Runs tasks."""

    @abstractmethod
    def session(self, function: Task) -> AbstractContextManager[Session]:
        """Keep workers for a function in the block, through several runs.

        At its end all workers end: those without work may close what they hold.

        Args:
            function: What to do with each task.
        """

    def run(
        self, function: Task, tasks: Iterable[Any], **limits: Unpack[Limits]
    ) -> Generator[Outcome]:
        """Call a function on every task; yield outcomes as they come.

        A worker that dies or exceeds a limit is replaced, and its task is started again, up to
        `attempts` times; so is a task that raises one of `again`. Any other exception is final. A
        worker whose function raises `WorkerRetiredError` gives its task back to the others and
        ends. If the generator is closed early, workers that have a task are stopped.

        Args:
            function: What to do with each task.
            tasks: Picklable tasks.
            limits: See `Limits`.
        """
        end_if_starting()
        todo = list(tasks)
        if todo:
            with self.session(function) as session:
                yield from session.run(todo, **limits)


@dataclass(frozen=True)
class Serial(Executor):
    """Runs tasks in this process, one after the other; there are no time limits."""

    @contextmanager
    def session(self, function: Task) -> Iterator[Session]:
        """Close the function when the block ends; see `Executor.session`."""
        try:
            yield _SerialSession(function)
        finally:
            getattr(function, "close", lambda: None)()


@dataclass(frozen=True)
class _SerialSession:
    function: Task

    def run(self, tasks: Iterable[Any], **limits: Unpack[Limits]) -> Generator[Outcome]:
        attempts = limits.get("attempts", ATTEMPTS)
        worker = Worker()
        for task in tasks:
            for number in range(1, attempts + 1):
                result = attempt(self.function, task, worker)
                outcome = Outcome(task, *result, number, worker.take_files())
                if isinstance(outcome.error, WorkerRetiredError):
                    raise outcome.error
                if not isinstance(outcome.error, limits.get("again", ())):
                    break
            yield outcome


@dataclass(frozen=True)
class Processes(Executor):
    """Runs tasks in worker processes that may hang or die without taking the work with them.

    What workers print goes to stderr. They may start processes of their own, which end with them.

    Attributes:
        workers: How many.
    """

    workers: int

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InvalidOptionError.expected("workers", self.workers, "1 or more")

    @contextmanager
    def session(self, function: Task) -> Iterator[Session]:
        """Keep worker processes in the block; see `Executor.session`."""
        end_if_starting()
        with closing(ProcessScheduler(function, self.workers)) as scheduler:
            yield scheduler
