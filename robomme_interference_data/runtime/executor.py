"""Who runs tasks: this process (`Serial`) or worker processes (`Processes`).

Whatever has tasks is handed an executor, and gets outcomes as values. `concurrent.futures` gives
up on all work when one process dies and cannot stop a hung task; pebble stops one, but neither
tries it again, nor ends what the task had started, nor tells where it hung.
"""

import platform
from collections import deque
from collections.abc import Generator, Iterable
from dataclasses import dataclass, fields
from functools import partial
from importlib import metadata
from typing import Any, Protocol, TypedDict, Unpack

from robomme_interference_data.errors import InvalidOptionError, WorkerRetiredError
from robomme_interference_data.lazy import load_extra
from robomme_interference_data.schema.settings import setting

from .process import (
    Outcome,
    Task,
    Worker,
    WorkerProcess,
    attempt,
    end_if_starting,
    end_workers,
    wait_for,
)

__all__ = ["Executor", "Outcome", "Processes", "Serial", "Task", "Worker", "end_if_starting"]


ATTEMPTS = 2


class Limits(TypedDict, total=False):
    """What may be said of tasks.

    Attributes:
        time_limit: Seconds that one task may take, and as many for the start of a worker; None,
            as if it is not given, for no limit.
        attempts: How often a task is started before what went wrong is reported; 2 by default.
        again: Errors of this package after which a task is started again; none by default.
    """

    time_limit: float | None
    attempts: int
    again: tuple[type[Exception], ...]


@dataclass(frozen=True, kw_only=True)
class WorkersConfig:
    """Who does the work."""

    workers: int = setting(1, help="Worker processes.", metavar="N")
    executor: str = setting("processes", help="processes, on this machine, or ray, on a cluster.")
    ray_address: str = setting(
        "auto", metavar="ADDRESS", help="ray: auto, local or HOST:PORT; see docs/cluster.md."
    )
    cpus_per_worker: float = setting(1.0, help="ray: processors that each worker takes.")
    gpus_per_worker: float = setting(0.0, help="ray: share of a GPU that each worker takes.")


def make_executor(config: WorkersConfig) -> "Executor":
    """Make who does the work.

    Raises:
        InvalidOptionError: A setting is not what it may be, or says nothing of the others.
        MissingExtraError: Ray is not installed.
    """
    if config.executor == "processes":
        for one in fields(WorkersConfig)[2:]:
            if getattr(config, one.name) != one.default:
                raise InvalidOptionError(
                    f"--{one.name.replace('_', '-')} says nothing of --executor processes",
                    "Add --executor ray, or leave it out.",
                )
        return Processes(config.workers)
    if config.executor != "ray":
        raise InvalidOptionError.one_of("--executor", config.executor, ("processes", "ray"))
    make = load_extra(f"{__package__}.ray_cluster", "RayWorkers", "--executor ray", "cluster")
    executor: Executor = make(
        config.workers, config.ray_address, config.cpus_per_worker, config.gpus_per_worker
    )
    return executor


def describe(function: Task) -> dict[str, str]:
    """Return what has to be the same wherever a function does tasks, as text by name.

    Versions of Python and this package, and what its method `describe` returns, if it has one.
    """
    package = "robomme-interference-data"
    versions = {"python": platform.python_version(), package: metadata.version(package)}
    return versions | getattr(function, "describe", dict)()


class Executor(Protocol):
    """Runs tasks."""

    def run(
        self, function: Task, tasks: Iterable[Any], **limits: Unpack[Limits]
    ) -> Generator[Outcome]:
        """Call a function on every task; yield outcomes as they come.

        A worker that dies or exceeds a limit is replaced, and its task is started again, up to
        `attempts` times; so is a task that raises one of `again`. Any other exception is final. A
        worker whose function raises `WorkerRetiredError` gives its task back to the others and
        ends. When the tasks are done, or the generator is closed, all workers end: those without
        work may close what they hold, the others are stopped.

        Args:
            function: What to do of a task.
            tasks: Picklable tasks.
            limits: See `Limits`.

        Raises:
            WorkerError: A worker ended before its first task, as it does when the script that it
                imports starts work outside `if __name__ == "__main__":`.
            WorkerRetiredError: No worker is left for the tasks that are; why the last one retired.
        """
        ...


@dataclass(frozen=True)
class Serial:
    """Runs tasks in this process, one after the other; there are no time limits."""

    def run(
        self, function: Task, tasks: Iterable[Any], **limits: Unpack[Limits]
    ) -> Generator[Outcome]:
        """Call a function on every task; see `Executor.run`."""
        attempts = limits.get("attempts", ATTEMPTS)
        try:
            for task in tasks:
                for number in range(1, attempts + 1):
                    files: dict[str, bytes] = {}
                    worker = Worker(0, partial(_take_file, files))
                    outcome = Outcome(task, *attempt(function, task, worker), number, files)
                    if isinstance(outcome.error, WorkerRetiredError):
                        raise outcome.error
                    if not isinstance(outcome.error, limits.get("again", ())):
                        break
                yield outcome
        finally:
            getattr(function, "close", lambda: None)()


def _take_file(files: dict[str, bytes], message: tuple[Any, ...]) -> None:
    """Keep what a task hands in of what it tells."""
    if message[0] == "file":
        files.update([message[1:]])


@dataclass(frozen=True)
class Processes:
    """Runs tasks in worker processes that may hang or die without taking the work with them.

    What workers print goes to stderr. They may start processes of their own, which end with them.

    Attributes:
        workers: How many.

    Raises:
        InvalidOptionError: `workers` is not positive.
    """

    workers: int

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InvalidOptionError.expected("workers", self.workers, "1 or more")

    def run(
        self, function: Task, tasks: Iterable[Any], **limits: Unpack[Limits]
    ) -> Generator[Outcome]:
        """Call a function on every task in worker processes; see `Executor.run`."""
        end_if_starting()
        time_limit, again = limits.get("time_limit"), limits.get("again", ())
        waiting = deque((task, 1) for task in tasks)
        to_start = deque(range(self.workers))  # numbers of workers that do not run
        running: list[WorkerProcess] = []
        try:
            while waiting or any(worker.busy for worker in running):
                idle = [worker for worker in running if not worker.busy]
                while waiting and (idle or to_start):
                    if not idle:
                        idle.append(WorkerProcess(function, to_start.popleft()))
                        running.append(idle[-1])
                    idle.pop().give(*waiting.popleft(), time_limit)
                wait_for(running)
                for worker in list(running):
                    outcome = worker.settle()
                    if outcome is None:
                        continue
                    if worker.over:
                        worker.stop()
                        running.remove(worker)
                        to_start.append(worker.number)
                    if isinstance(outcome.error, WorkerRetiredError):
                        worker.stop()
                        running.remove(worker)
                        waiting.appendleft((outcome.task, outcome.attempts))
                        if not running and not to_start:
                            raise outcome.error
                    elif outcome.attempts < limits.get("attempts", ATTEMPTS) and (
                        worker.over or isinstance(outcome.error, again)
                    ):
                        waiting.append((outcome.task, outcome.attempts + 1))
                    else:
                        yield outcome
        finally:
            end_workers(running)
