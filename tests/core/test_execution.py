"""What every executor does, shown by the one in this process."""

import os
import sys
from typing import Any

import pytest
from support.messages import raises

from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    MissingExtraError,
    SimulatorCrashError,
    WorkerError,
    WorkerRetiredError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import (
    Resources,
    Serial,
    Worker,
    WorkersConfig,
    describe,
    make_executor,
)
from robomme_interference_data.runtime.process import Processes


class Noted:
    """A function that records its calls and fails a given number of times."""

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
    assert [(one.task, one.value, one.attempts) for one in outcomes] == [(1, 2, 1), ("a", "aa", 1)]
    assert not any(one.error or one.trace for one in outcomes)
    assert function.calls == [(1, 0), ("a", 0), "closed"]


def test_errors_of_this_package_keep_their_class_and_others_become_text() -> None:
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
        (InvalidOptionError("no"), 1, 2, (1, True)),  # which is final
    ],
)
def test_a_task_is_started_again_after_some_errors(
    error: Exception, times: int, attempts: int, found: tuple[int, bool]
) -> None:
    run = Serial().run(Noted(error, times), [1], attempts=attempts, again=(SimulatorCrashError,))
    (outcome,) = run
    assert (outcome.attempts, outcome.error is not None) == found
    assert (outcome.first is None) == (outcome.attempts == 1)
    if outcome.first is not None:
        assert (outcome.first.error, outcome.first.first) == (error, None)


def test_the_last_worker_may_not_retire() -> None:
    function = Noted(WorkerRetiredError("gone"), 1)
    with raises(WorkerRetiredError):
        list(Serial().run(function, [1]))
    assert function.calls[-1] == "closed"


def test_abandoned_work_closes_its_function() -> None:
    function = Noted()
    outcomes = Serial().run(function, [1, 2, 3])
    next(outcomes)
    outcomes.close()
    assert function.calls == [(1, 0), "closed"]


def test_sent_files_come_with_the_outcome_even_after_an_error() -> None:
    def write(task: str, worker: Worker) -> None:
        worker.send_file("a.txt", b"first")
        worker.send_file("a.txt", task.encode())
        if task == "bad":
            raise ValueError("no")

    good, bad = Serial().run(write, ["good", "bad"])
    assert (good.files, bad.files) == ({"a.txt": b"good"}, {"a.txt": b"bad"})


def test_only_files_of_the_last_attempt_count() -> None:
    left = [1]

    def write(task: str, worker: Worker) -> None:
        if left:
            worker.send_file("early.txt", b"")
            raise SimulatorCrashError(str(left.pop()))

    (outcome,) = Serial().run(write, ["x"], again=(SimulatorCrashError,))
    assert (outcome.error, outcome.attempts, outcome.files) == (None, 2, {})


# --- who does the work ---------------------------------------------------------------------------


def test_executors_by_name() -> None:
    assert make_executor(WorkersConfig(workers=3)) == Processes(3)
    settings = WorkersConfig(workers=8, executor="ray:head:6379", resources=("gpus=0.25",))
    expected = {"workers": 8, "address": "head:6379", "resources": Resources(cpus=1, gpus=0.25)}
    assert vars(make_executor(settings)) == expected
    assert vars(make_executor(WorkersConfig(executor="ray")))["address"] == "auto"


@pytest.mark.parametrize(
    "settings",
    [
        {"executor": "rey"},
        {"workers": 0},
        {"resources": ("gpus=0.5",)},
        {"executor": "ray", "resources": ("cpus=NaN",)},
        {"executor": "ray", "resources": ("gpus=1.5",)},
        {"executor": "ray", "resources": ("tpus=1",)},
        {"executor": "ray://a:1x"},
        {"executor": "ray:"},
    ],
)
def test_settings_of_workers_are_checked(settings: dict[str, Any]) -> None:
    with raises(InvalidOptionError):
        make_executor(WorkersConfig(**settings))


def test_without_ray_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "robomme_interference_data.runtime.ray_cluster", raising=False)
    with pytest.raises(MissingExtraError) as raised:
        make_executor(WorkersConfig(executor="ray"))
    assert "[cluster]" in str(raised.value.hint)


def test_a_function_describes_what_must_be_equal_on_all_nodes() -> None:
    class Described(Noted):
        def describe(self) -> dict[str, str]:
            return {"the buffer set's revision": "abc"}

    assert {"python", "robomme-interference-data"} == describe(Noted()).keys()
    assert describe(Described())["the buffer set's revision"] == "abc"


def test_worker_processes_on_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "setpgid")
    with pytest.raises(WorkerError) as caught:
        make_executor(WorkersConfig())
    assert caught.value.hint
