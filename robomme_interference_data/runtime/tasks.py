"""Tasks: the worker that runs one, its outcome, and the scheduler that assigns tasks to workers."""

import multiprocessing
import pickle
import sys
import traceback
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

from robomme_interference_data.errors import InterferenceError, WorkerRetiredError

STARTED_AGAIN = 97
"""Exit code of a worker whose imports reach the call that starts workers."""


def end_if_starting() -> None:
    """End this process silently if it is a worker that is still importing the caller's script.

    Then a script that starts work at module level gets one error, from its own process.
    """
    # Python sets it while a spawned process imports the script that started it.
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        sys.exit(STARTED_AGAIN)


class Worker:
    """The worker that runs a task. This class is the worker in the caller's own process.

    Attributes:
        number: From 0; a worker that replaces one that died has its number.
        folder: Where tasks may keep files while they run; removed when the worker ends. None for
            the system's temporary folder.
    """

    def __init__(self, number: int = 0, folder: str | None = None):
        self.number, self.folder = number, folder
        self._sent: dict[str, bytes] = {}

    def send_file(self, path: str, data: bytes) -> None:
        """Send a file to the caller; a worker may run on another machine, so only callers write.

        Files arrive even if the task fails. A file replaces an earlier one with the same path.
        """
        self._sent[path] = data

    def take_files(self) -> dict[str, bytes]:
        """Return the files that were sent since the last call."""
        files, self._sent = self._sent, {}
        return files

    @contextmanager
    def limit(self, seconds: float | None, what: str) -> Iterator[None]:
        """End the worker if the block takes longer; `what` names the block in the error.

        There is no limit in the caller's own process.
        """
        yield


class TaskFunction(Protocol):
    """What to do with each task: a picklable function, of which each worker gets a copy.

    If it has a method `close`, a worker that is no longer needed calls it. If it has a method
    `describe`, the names and texts that it returns must be the same on all machines.
    """

    def __call__(self, task: Any, worker: Worker) -> Any:
        """Work on a task and return its value, which must be picklable."""
        ...


@dataclass(frozen=True)
class Outcome:
    """The outcome of a task.

    Attributes:
        task: The task.
        value: What the function returned, or None.
        error: Why there is no value, or None. Errors of this package are unchanged; any other
            error, or the worker's death, is a `RuntimeError`; an exceeded limit is a
            `TimeoutError`.
        progress: What the function attached to the error, `error.progress`: plain values by name.
        trace: Traceback of the error, or of the worker that exceeded a limit; None if unknown.
        attempts: How often the task was started.
        first: The outcome of the first attempt if the task was started again; None otherwise.
        files: Files that the task sent (see `Worker.send_file`), by path.
        node: The node of a cluster that ran it; None on this machine.
        worker: `alive` after the task; `dead` because of it; `late` if the task exceeded its own
            limit, which ends the worker too; or `lost` with its node.
    """

    task: Any = None
    value: Any = None
    error: BaseException | None = None
    progress: Mapping[str, Any] = field(default_factory=dict)
    trace: str | None = None
    attempts: int = 1
    first: "Outcome | None" = None
    files: dict[str, bytes] = field(default_factory=dict)
    node: str | None = None
    worker: Literal["alive", "dead", "late", "lost"] = "alive"


def attempt(function: TaskFunction, task: Any, worker: Worker) -> Outcome:
    """Call the function on a task once."""
    try:
        return Outcome(task, function(task, worker))
    except Exception as error:
        # Foreign exceptions may not survive pickling; their text does.
        known = isinstance(error, InterferenceError)
        described = error if known else RuntimeError(f"{type(error).__name__}: {error}")
        progress = getattr(error, "progress", {})
        return Outcome(task, error=described, progress=progress, trace=traceback.format_exc())


def unpickle_outcome(data: bytes, files: dict[str, bytes], node: str | None = None) -> Outcome:
    """Return the outcome that `ProcessWorker.work` pickled; an unreadable one is an error."""
    try:
        outcome = pickle.loads(data)
    except Exception as problem:
        outcome = unreadable(problem)
    return replace(outcome, files=files, node=node)


def unreadable(error: BaseException, trace: str | None = None) -> Outcome:
    """Return the outcome of a task whose own outcome cannot be sent."""
    text = f"the task's outcome cannot be sent: {type(error).__name__}: {error}"
    return Outcome(error=RuntimeError(text), trace=trace)


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
    """A task, how often it failed or killed its worker, and how often its worker was lost.

    `first` is the outcome of its first attempt, after that.
    """

    task: Any
    failures: int = 0
    losses: int = 0
    first: Outcome | None = None

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
                        queued.first = queued.first or replace(outcome, files={})
                        # At the end: it may kill another worker, and the other tasks come first.
                        waiting.append(queued)
                    else:
                        count = queued.failures + queued.losses
                        yield replace(outcome, task=queued.task, attempts=count, first=queued.first)
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
