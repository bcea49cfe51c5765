"""Shared policies without processes: the rule of batches, how workers find a host, its answers."""

import os
import pickle
import shutil
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import AuthenticationError
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data.errors import PolicyError, ServerDiedError
from robomme_interference_data.evaluate.policies.batching import Batcher
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.evaluate.policies.process import (
    ServePolicy,
    SocketAddress,
    choose_gpu,
)
from robomme_interference_data.evaluate.policies.shared import PolicyHost, SharedPolicy
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.runtime.tasks import Worker
from robomme_interference_data.simulators.episode import Observation

Calls = list[tuple[int, str, int]]


class Adding:
    """Sessions keep a list; `act` returns it with the goal. The goal "bad" raises."""

    def __init__(self) -> None:
        self.memory: list[Any] = []
        self.batches: list[list[str]] = []
        self.closed = 0

    def session(self) -> "Adding":
        return Adding()

    def add(self, number: int) -> None:
        self.memory.append(number)

    def act(self, observation: Any, goal: str) -> Any:
        if goal == "bad":
            raise ValueError("a bad goal")
        self.memory.append((observation, goal))
        return [*self.memory]

    def act_batch(self, sessions: Any, observations: Any, goals: Any) -> Any:
        self.batches.append([*goals])
        if "bad" in goals:
            raise ValueError("a bad goal in a batch")
        pairs = zip(sessions, observations, goals, strict=True)
        return [session.act(*request) for session, *request in pairs]

    def close(self) -> None:
        self.closed += 1


def batcher(policy: Any, size: int = 3, timeout_s: float = 1.0) -> Batcher[int]:
    return Batcher(lambda: policy, size, timeout_s)


def ask(batches: Batcher[int], key: int, goal: str = "go") -> Future[Any]:
    answer = Future[Any]()
    batches.call(key, "act", (0, goal), answer)
    assert not answer.done()
    return answer


def test_a_batch_is_due_when_it_is_full_when_no_more_can_come_or_in_time() -> None:
    policy = Adding()
    batches = batcher(policy, size=3, timeout_s=1.0)
    assert batches.until_batch_s(0.0) is None
    for key in range(5):
        batches.open(key)
    answers = [ask(batches, 0, "a")]
    assert batches.until_batch_s(10.0) == 1.0
    answers.append(ask(batches, 1, "b"))
    assert batches.until_batch_s(10.5) == 0.5  # from the oldest request
    assert batches.until_batch_s(11.5) == 0.0
    answers += [ask(batches, 2, "c"), ask(batches, 3, "d")]
    assert batches.until_batch_s(10.75) == 0.0  # full
    batches.act()
    assert [answer.done() for answer in answers] == [True, True, True, False]
    assert batches.until_batch_s(12.0) == 1.0  # from the end of the batch
    assert batches.until_batch_s(12.25) == 0.75
    for key in (0, 1, 2, 4):
        batches.drop(key)
    assert batches.until_batch_s(12.25) == 0.0  # no other session is open
    batches.act()
    assert answers[3].result(0) == [(0, "d")]
    lost = ask(batches, 3)
    batches.drop(3)  # its worker is gone, and its request with it
    assert lost.cancelled()
    assert batches.until_batch_s(12.25) is None
    assert policy.batches == [["a", "b", "c"]]  # alone, it is no batch
    batches.close()
    assert policy.closed == 1


def test_one_bad_request_fails_alone(caplog: pytest.LogCaptureFixture) -> None:
    policy = Adding()
    batches = batcher(policy)
    for _ in range(2):
        answers = []
        for key, goal in enumerate(["go", "bad", "stay"]):
            batches.open(key)
            answers.append(ask(batches, key, goal))
        batches.act()
        assert answers[0].result(0) == [(0, "go")] and answers[2].result(0) == [(0, "stay")]
        assert str(answers[1].exception(0)) == "a bad goal"
    assert caplog.text.count("repeated one by one") == 1


def test_a_batch_with_missing_results_is_repeated_one_by_one() -> None:
    policy = Adding()
    policy.act_batch = lambda *_: [["wrong"]]  # type: ignore[method-assign]
    batches = batcher(policy)
    for key in (0, 1):
        batches.open(key)
    answers = [ask(batches, key) for key in (0, 1)]
    batches.act()
    assert [answer.result(0) for answer in answers] == [[(0, "go")], [(0, "go")]]


def test_a_policy_that_cannot_be_made_is_made_again_for_the_next_session() -> None:
    made: list[Any] = [Adding(), OSError("busy")]

    def make() -> Any:
        if isinstance(one := made.pop(), Exception):
            raise one
        return one

    batches: Batcher[int] = Batcher(make, 2, 0.0)
    with raises(OSError):
        batches.open(0)
    assert isinstance(batches.open(0), Adding)


@st.composite
def interleavings(draw: st.DrawFn) -> tuple[list[list[str]], list[int]]:
    """The calls of each session, and whose turn it is."""
    calls = st.lists(st.sampled_from(["add", "act", "bad"]), max_size=6)
    sessions = draw(st.lists(calls, min_size=1, max_size=5))
    turns = [number for number, own in enumerate(sessions) for _ in own]
    return sessions, draw(st.permutations(turns))


@given(interleavings(), st.integers(1, 6), st.floats(0, 3))
def test_sessions_never_mix(
    drawn: tuple[list[list[str]], list[int]], size: int, timeout_s: float
) -> None:
    sessions, turns = drawn
    policy = Adding()
    batches = batcher(policy, size, timeout_s)
    answers: dict[int, list[Any]] = {number: [] for number in range(len(sessions))}
    lefts = [[*own] for own in sessions]
    waiting: dict[int, Future[Any]] = {}

    def answer() -> None:
        batches.act()
        for key in [key for key, request in waiting.items() if request.done()]:
            request = waiting.pop(key)
            error = request.exception()
            answers[key].append(request.result() if error is None else str(error))

    for key in answers:
        batches.open(key)
    for now, turn in enumerate(turns):
        while turn in waiting:  # a worker waits for its answer
            answer()
        call = lefts[turn].pop(0)
        if call == "add":
            added = Future[Any]()
            batches.call(turn, "add", (now,), added)
            assert added.result(0) is None
        else:
            waiting[turn] = ask(batches, turn, "bad" if call == "bad" else f"goal {turn}")
        if batches.until_batch_s(now) == 0:
            answer()
    while waiting:
        answer()
    # The same calls, one session after the other, each alone.
    times = {
        number: [now for now, turn in enumerate(turns) if turn == number] for number in answers
    }
    for number, own in enumerate(sessions):
        alone, expected = Adding(), []
        for now, call in zip(times[number], own, strict=True):
            if call == "add":
                alone.add(now)
            else:
                expected.append("a bad goal" if call == "bad" else alone.act(0, f"goal {number}"))
        assert answers[number] == expected
    assert all(2 <= len(one) <= size for one in policy.batches)


def config(policy: str, **changes: Any) -> RunConfig:
    text = f"python:support.shared_policies:{policy}"
    return RunConfig(policy=text, buffer_set="none", out=Path(), policies=1, **changes)


@pytest.fixture
def address() -> Iterator[SocketAddress]:
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        yield SocketAddress(Path(folder, "3"), b"secret", 3)


@contextmanager
def serving(address: SocketAddress, policy: str = "Remembering") -> Iterator[None]:
    """A process that serves, as a thread."""
    thread = threading.Thread(target=ServePolicy(config(policy)), args=(address, Worker()))
    thread.start()
    yield
    address.path.unlink()
    thread.join()


@pytest.mark.timeout(60)
def test_a_worker_waits_for_the_process_and_for_the_one_that_replaces_it(
    address: SocketAddress, caplog: pytest.LogCaptureFixture
) -> None:
    opened: list[SharedPolicy] = []

    def work() -> None:
        opened.append(SharedPolicy.open(address, 0))

    waiting = threading.Thread(target=work, daemon=True)
    waiting.start()
    waiting.join(0.3)
    assert waiting.is_alive()
    with serving(address):
        waiting.join()
        assert opened[0].metadata() == {"policy": "remembering"} and not caplog.messages
        opened[0].close()
    address.path.touch()  # as a process leaves it that is killed
    with serving(address):
        work()
        opened[1].close()
    assert caplog.messages == ["The policy's process 3 was started again"]


@pytest.mark.timeout(60)
def test_who_does_not_know_the_key_gets_nothing(address: SocketAddress) -> None:
    with serving(address):
        first = SharedPolicy.open(address, 0)  # it listens
        with pytest.raises(AuthenticationError):
            replace(address, key=b"guessed").connect(1)
        assert first.metadata() == {"policy": "remembering"}
        first.close()
    assert "key" not in repr(address)


@pytest.mark.timeout(60)
def test_the_end_of_the_run_reaches_everybody(address: SocketAddress) -> None:
    process = ServePolicy(config("Remembering"))
    serve = threading.Thread(target=process, args=(address, Worker()))
    serve.start()
    SharedPolicy.open(address, 0).close()
    shutil.rmtree(address.path.parent)
    serve.join()
    with pytest.raises(ServerDiedError):
        address.connect(0)
    process(address, Worker())  # one that is started again ends at once


# --- the host ------------------------------------------------------------------------------------


@contextmanager
def hosted(policy: str, **settings: Any) -> Iterator[PolicyHost]:
    host, done = PolicyHost(config(policy, **settings), 0), threading.Event()
    thread = threading.Thread(target=host.run, args=(done.is_set,))
    thread.start()
    yield host
    done.set()
    thread.join()


def test_a_worker_that_opens_again_gets_a_new_session() -> None:
    view = Observation({}, np.arange(8, dtype=np.float32))
    with hosted("Remembering") as host:
        first, other = SharedPolicy(partial(host.answer, 0)), SharedPolicy(partial(host.answer, 1))
        for policy in (first, other):
            policy.reset(RolloutInfo("a goal", 0, 0))
        SharedPolicy(partial(host.answer, 0)).reset(RolloutInfo("another goal", 0, 0))
        with pytest.raises(AssertionError):
            first.act(view, "a goal")  # its session is the new one
        assert other.act(view, "a goal").shape == (1, 8)
        other.close()
        with pytest.raises(ServerDiedError):  # as after an actor was started again
            other.metadata()


def test_errors_arrive_with_their_traceback() -> None:
    with hosted("Unloadable") as host, pytest.raises(PolicyError) as raised:
        SharedPolicy(partial(host.answer, 0))
    assert "no weights here" in str(raised.value)
    with hosted("Remembering", policy_options=("fault=goal",)) as host:
        policy = SharedPolicy(partial(host.answer, 0))
        policy.reset(RolloutInfo("a cube", 0, 0))
        with pytest.raises(RuntimeError) as odd:  # it cannot be pickled
            policy.act(Observation({}, np.zeros(8, np.float32)), "a cube")
        assert "Odd" in str(odd.value) and "shared_policies.py" in odd.value.__notes__[0]
        answer = host.answer(0, pickle.dumps(("metadata", ())))
        assert pickle.loads(answer) == ({"policy": "remembering"}, None)


# --- GPUs ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("visible", "number", "expected"),
    [("0,1,7", 4, "1"), ("0,1,7", 2, "7"), ("5", 3, "5"), ("", 1, ""), ("GPU-a,GPU-b", 1, "GPU-b")],
)
def test_processes_share_the_gpus_evenly(
    monkeypatch: pytest.MonkeyPatch, visible: str, number: int, expected: str
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    choose_gpu(number)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == expected


def test_gpus_are_those_of_the_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "glob", lambda self, pattern: iter([self / "b", self / "a"]))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")  # so that it is removed in the end
    del os.environ["CUDA_VISIBLE_DEVICES"]
    choose_gpu(3)
    assert os.environ["CUDA_VISIBLE_DEVICES"] == "1"
