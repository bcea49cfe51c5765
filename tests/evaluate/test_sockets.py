"""How workers find a shared policy's process: before it listens, after it died, after the run."""

import os
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from multiprocessing import AuthenticationError
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from robomme_interference_data.evaluate.policies.process import choose_gpu
from robomme_interference_data.evaluate.policies.sockets import Address, Directory, accept


@pytest.fixture
def address() -> Iterator[Address]:
    with closing(Directory("127.0.0.1")) as directory:
        yield directory.address(3)


def serve(address: Address, word: str) -> threading.Thread:
    """Listen as a process that greets one client with a word, and dies."""

    def work() -> None:
        with address.listen() as (listener, _):
            client = None
            while client is None:
                client = accept(listener, address.key)
            client.send(word)
            client.close()

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


@pytest.mark.timeout(60)
def test_a_client_waits_for_the_process_and_for_the_one_that_replaces_it(
    address: Address, caplog: pytest.LogCaptureFixture
) -> None:
    found: list[Connection] = []
    waiting = threading.Thread(target=lambda: found.append(address.connect()), daemon=True)
    waiting.start()
    waiting.join(0.3)
    assert waiting.is_alive()
    first = serve(address, "first")
    waiting.join()
    first.join()
    assert found[0].recv() == "first" and not caplog.messages
    second = serve(address, "second")
    with address.connect() as connection:  # at first, it may find the place of the dead one
        assert connection.recv() == "second"
    second.join()
    assert caplog.messages == ["The policy's process 3 was started again"]


@pytest.mark.timeout(60)
def test_who_does_not_know_the_key_gets_nothing(address: Address) -> None:
    with pytest.raises(AuthenticationError):
        replace(address, key=b"guessed").connect()
    serving = serve(address, "hello")
    with address.connect() as connection:
        assert connection.recv() == "hello"
    serving.join()
    assert "key" not in repr(address)


@pytest.mark.timeout(60)
def test_the_end_of_the_run_reaches_everybody() -> None:
    directory = Directory("127.0.0.1")
    with directory.address(0).listen() as (_, end):
        assert not end.poll()
        directory.close()
        assert end.poll(10)
    with pytest.raises(OSError):
        directory.address(0).connect()


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
