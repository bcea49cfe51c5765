"""Hands tasks to workers, whatever these are, and starts again what broke."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, TypedDict, Unpack

from robomme_interference_data.errors import WorkerRetiredError

from .worker import Outcome

ATTEMPTS = 2

_LOSSES = 5
"""How often the worker of a task may be lost through no fault of the task."""


class Limits(TypedDict, total=False):
    """Limits of tasks.

    Attributes:
        time_limit: Seconds that one task may take; None, the default, for no limit.
        attempts: How often a task is started before its error is reported; 2 by default.
        again: Errors of this package after which a task is started again; none by default.
    """

    time_limit: float | None
    attempts: int
    again: tuple[type[Exception], ...]


@dataclass(frozen=True)
class Reply:
    """What a worker answered, and whether it can go on.

    Attributes:
        worker: `fine`; `dead`, because of its task; or `lost`, with its node.
    """

    value: Any = None
    error: BaseException | None = None
    trace: str | None = None
    files: dict[str, bytes] = field(default_factory=dict)
    node: str | None = None
    worker: Literal["fine", "dead", "lost"] = "fine"


class Handle(Protocol):
    """What the caller holds of a worker.

    Attributes:
        number: The worker's number.
        ready: Whether it takes tasks already.
    """

    number: int
    ready: bool

    def send(self, task: Any, time_limit: float | None) -> None:
        """Let it work on a task."""

    def receive(self) -> Reply:
        """Return its answer, which has arrived."""
        ...

    def stop(self) -> None:
        """End it now."""


@dataclass
class QueuedTask:
    """A task, how often it broke its worker or failed, and how often its worker was lost."""

    task: Any
    broke: int = 0
    lost: int = 0


class Scheduler[H: Handle](ABC):
    """Runs tasks on workers that it starts when there is work for them, until it is closed.

    Args:
        workers: How many, at most.
    """

    def __init__(self, workers: int):
        self._numbers = deque(range(workers))  # of workers that do not run
        self.workers: list[H] = []

    @abstractmethod
    def start(self, number: int) -> H:
        """Start a worker."""

    @abstractmethod
    def wait(self, workers: Sequence[H]) -> Iterable[H]:
        """Wait until some have an answer, or are ready; return those with an answer."""

    @abstractmethod
    def close(self) -> None:
        """End all workers, which may release what they hold, within a time."""

    def run(self, tasks: Iterable[Any], **limits: Unpack[Limits]) -> Generator[Outcome]:
        """Yield the outcomes of tasks as they come; see `Executor.run`."""
        waiting = deque(map(QueuedTask, tasks))
        busy: dict[H, QueuedTask] = {}
        try:
            while waiting or busy:
                free = [one for one in self.workers if one not in busy]
                while self._numbers and len(free) < len(waiting):
                    free.append(self.start(self._numbers.popleft()))
                    self.workers.append(free[-1])
                for worker in [one for one in free if one.ready][: len(waiting)]:
                    busy[worker] = waiting.popleft()
                    worker.send(busy[worker].task, limits.get("time_limit"))
                starting = [one for one in self.workers if not one.ready] if waiting else []
                for worker in self.wait([*busy, *starting]):
                    reply = worker.receive()
                    outcome = self._settle(worker, busy.pop(worker), reply, waiting, limits)
                    if outcome is not None:
                        yield outcome
        finally:
            for worker in busy:
                self._drop(worker)

    def _drop(self, worker: H, *, replace: bool = True) -> None:
        worker.stop()
        self.workers.remove(worker)
        if replace:
            self._numbers.append(worker.number)

    def _settle(
        self,
        worker: H,
        queued: QueuedTask,
        reply: Reply,
        waiting: deque[QueuedTask],
        limits: Limits,
    ) -> Outcome | None:
        """Return the outcome of a task, or queue it again."""
        if isinstance(reply.error, WorkerRetiredError):
            waiting.appendleft(queued)
            self._drop(worker, replace=False)
            if not self.workers and not self._numbers:
                raise reply.error
            return None
        if reply.worker != "fine":
            self._drop(worker)
        if reply.worker == "lost":
            queued.lost += 1
            again = queued.lost < _LOSSES
        else:
            queued.broke += 1
            again = queued.broke < limits.get("attempts", ATTEMPTS) and (
                reply.worker == "dead" or isinstance(reply.error, limits.get("again", ()))
            )
        if again:
            waiting.append(queued)
            return None
        attempts = queued.broke + queued.lost
        return Outcome(
            queued.task, reply.value, reply.error, reply.trace, attempts, reply.files, reply.node
        )
