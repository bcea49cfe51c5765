"""What every executor does, shown by the one in this process."""

import threading
from typing import Any

import pytest

from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    SimulatorCrashError,
    WorkerRetiredError,
)
from robomme_interference_data.execution import Processes, Serial, Worker
from robomme_interference_data.ids import EpisodeId


class Noted:
    """A function that notes what it was called with, and fails as often as it is told."""

    def __init__(self, error: Exception | None = None, times: int = 0):
        self.error, self.left = error, times
        self.calls: list[Any] = []

    def __call__(self, task: Any, worker: Worker) -> Any:
        self.calls.append((task, worker.number))
        with worker.limit(1e-9, "a part"):  # without effect in this process
            if self.error is not None and self.left > 0:
                self.left -= 1
                raise self.error
        return task * 2

    def close(self) -> None:
        self.calls.append("closed")


def test_outcomes_are_values_in_order() -> None:
    function = Noted()
    outcomes = list(Serial().run(function, [1, "a"]))
    assert [(o.task, o.value, o.error, o.trace, o.attempts) for o in outcomes] == [
        (1, 2, None, None, 1),
        ("a", "aa", None, None, 1),
    ]
    assert function.calls == [(1, 0), ("a", 0), "closed"]


def test_a_value_need_not_be_picklable_here() -> None:
    (outcome,) = Serial().run(lambda task, worker: threading.Lock(), [0])
    assert outcome.value.acquire()


def test_errors_of_this_package_are_themselves_others_are_told_in_words() -> None:
    (outcome,) = Serial().run(lambda task, worker: EpisodeId.parse(task), ["VideoRepick"])
    assert isinstance(outcome.error, InvalidIdError)
    assert outcome.error.hint is not None
    assert outcome.trace is not None and "EpisodeId.parse" in outcome.trace
    (outcome,) = Serial().run(lambda task, worker: int(task), ["x"])
    assert type(outcome.error) is RuntimeError
    assert str(outcome.error).startswith("ValueError: invalid literal")


@pytest.mark.parametrize(
    ("error", "times", "attempts", "found"),
    [
        (SimulatorCrashError("died"), 1, 2, (2, False)),
        (SimulatorCrashError("died"), 2, 2, (2, True)),
        (SimulatorCrashError("died"), 2, 3, (3, False)),
        (SimulatorCrashError("died"), 1, 1, (1, True)),
        (InvalidOptionError("no"), 1, 2, (1, True)),  # which is final
    ],
)
def test_a_task_is_started_again_after_some_errors(
    error: Exception, times: int, attempts: int, found: tuple[int, bool]
) -> None:
    run = Serial().run(Noted(error, times), [1], attempts=attempts, again=(SimulatorCrashError,))
    (outcome,) = run
    assert (outcome.attempts, outcome.error is not None) == found


def test_the_last_worker_may_not_retire() -> None:
    function = Noted(WorkerRetiredError("gone"), 1)
    with pytest.raises(WorkerRetiredError, match="gone"):
        list(Serial().run(function, [1]))
    assert function.calls[-1] == "closed"


def test_work_that_is_given_up_closes_what_it_holds() -> None:
    function = Noted()
    outcomes = Serial().run(function, [1, 2, 3])
    next(outcomes)
    outcomes.close()
    assert function.calls == [(1, 0), "closed"]


@pytest.mark.parametrize("workers", [0, -1])
def test_workers_must_be_positive(workers: int) -> None:
    with pytest.raises(InvalidOptionError, match=f"workers {workers}"):
        Processes(workers)
