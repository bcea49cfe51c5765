"""Shared policies without their processes: how workers find a host, and what it answers."""

import os
import pickle
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import AuthenticationError
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from robomme_interference_data.errors import PolicyError, ServerDiedError
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.evaluate.policies.process import (
    ServePolicy,
    SocketAddress,
    choose_gpu,
)
from robomme_interference_data.evaluate.policies.shared import PolicyHost, SharedPolicy
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.runtime.worker import Worker
from robomme_interference_data.simulators.episode import Observation


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


class Direct:
    """A channel to a host in this process."""

    def __init__(self, host: PolicyHost, worker: int):
        self.host, self.worker = host, worker

    def ask(self, request: bytes) -> bytes:
        return self.host.answer(self.worker, request)

    def close(self) -> None:
        pass


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
        first, other = SharedPolicy(Direct(host, 0)), SharedPolicy(Direct(host, 1))
        for policy in (first, other):
            policy.reset(RolloutInfo("a goal", 0, 0))
        SharedPolicy(Direct(host, 0)).reset(RolloutInfo("another goal", 0, 0))
        with pytest.raises(AssertionError):
            first.act(view, "a goal")  # its session is the new one
        assert other.act(view, "a goal").shape == (1, 8)
        other.close()
        with pytest.raises(ServerDiedError):  # as after an actor was started again
            other.metadata()


def test_errors_arrive_with_their_traceback() -> None:
    with hosted("Unloadable") as host, pytest.raises(PolicyError) as raised:
        SharedPolicy(Direct(host, 0))
    assert "no weights here" in str(raised.value)
    with hosted("Remembering", policy_options=("fault=goal",)) as host:
        policy = SharedPolicy(Direct(host, 0))
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
