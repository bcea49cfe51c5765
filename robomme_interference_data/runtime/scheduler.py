"""Assigns tasks to workers, and retries tasks whose worker died."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

from robomme_interference_data.errors import WorkerRetiredError

from .worker import Outcome, TaskFunction

_LOSSES = 5
"""How often the worker of a task may be lost with its node."""


class Handle(Protocol):
    """The caller's side of a worker.

    Attributes:
        number: The worker's number.
        ready: Whether it accepts tasks already.
    """

    number: int
    ready: bool

    def send(self, task: Any, time_limit: float | None) -> None:
        """Start a task."""

    def receive(self) -> Outcome:
        """Return the outcome, which has arrived."""
        ...

    def kill(self) -> None:
        """Kill the worker; if it has a task, the outcome is that of a worker that died."""

    def stop(self) -> None:
        """Kill the worker, and release what it used."""


@dataclass
class QueuedTask:
    """A task, how often it failed or killed its worker, and how often its worker was lost."""

    task: Any
    failures: int = 0
    losses: int = 0

    def needs_retry(
        self, outcome: Outcome, attempts: int, again: tuple[type[Exception], ...]
    ) -> bool:
        """Count an outcome; return whether the task is to be started again."""
        if outcome.worker == "lost":
            self.losses += 1
            return self.losses < _LOSSES
        self.failures += 1
        repeatable = outcome.worker == "dead" or isinstance(outcome.error, again)
        return repeatable and self.failures < attempts


class Scheduler[H: Handle](ABC):
    """Calls a function on tasks, with at most so many workers, started when there is work."""

    def __init__(self, function: TaskFunction, workers: int):
        self.function = function
        self._numbers = deque(range(workers))  # of workers that do not run
        self.workers: list[H] = []

    @abstractmethod
    def start(self, number: int) -> H:
        """Start a worker."""

    @abstractmethod
    def wait(self, workers: Sequence[H]) -> Iterable[H]:
        """Wait until some have an outcome, or are ready; return those with an outcome."""

    @abstractmethod
    def close(self) -> None:
        """End all workers, which may release their resources, within a time."""

    def run(
        self,
        tasks: Iterable[Any],
        *,
        time_limit: float | None = None,
        attempts: int = 2,
        again: tuple[type[Exception], ...] = (),
    ) -> Generator[Outcome]:
        """Yield the outcomes of tasks as they arrive; see `Executor.run`."""
        waiting = deque(map(QueuedTask, tasks))
        busy: dict[H, QueuedTask] = {}
        try:
            while waiting or busy:
                free = [worker for worker in self.workers if worker not in busy]
                while self._numbers and len(free) < len(waiting):
                    free.append(self.start(self._numbers.popleft()))
                    self.workers.append(free[-1])
                # Those on a cluster are ready only when a node has room for them.
                for worker in [worker for worker in free if worker.ready][: len(waiting)]:
                    busy[worker] = waiting.popleft()
                    worker.send(busy[worker].task, time_limit)
                starting = []
                if waiting:
                    starting = [worker for worker in self.workers if not worker.ready]
                for worker in self.wait([*busy, *starting]):
                    outcome, queued = worker.receive(), busy.pop(worker)
                    # The task is not at fault, such as where a node's policy server is gone.
                    if isinstance(outcome.error, WorkerRetiredError):
                        waiting.appendleft(queued)
                        self._drop(worker, replaced=False)
                        if not self.workers and not self._numbers:
                            raise outcome.error
                        continue
                    if outcome.worker != "alive":
                        self._drop(worker)  # its number is free for the one that replaces it
                    if queued.needs_retry(outcome, attempts, again):
                        # At the end: it may kill another worker, and the other tasks come first.
                        waiting.append(queued)
                    else:
                        count = queued.failures + queued.losses
                        yield replace(outcome, task=queued.task, attempts=count)
        finally:
            # The caller wants no more outcomes; idle workers stay for its next tasks.
            for worker in busy:
                self._drop(worker)

    def kill(self) -> None:
        """Kill all workers; another thread may be in `run`, which starts their tasks again."""
        for worker in [*self.workers]:
            worker.kill()

    def _drop(self, worker: H, *, replaced: bool = True) -> None:
        worker.stop()
        self.workers.remove(worker)
        if replaced:
            self._numbers.append(worker.number)
