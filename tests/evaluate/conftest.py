"""Fixtures of evaluations: a simulator without physics over the tiny buffer set, and servers."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from support import boards, worlds
from support.policy_server import PolicyServer


@pytest.fixture
def world(tiny_buffers: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the simulator `support.worlds:World` find the buffer set, in other processes too."""
    monkeypatch.setenv(worlds.BUFFER_SET, str(tiny_buffers))


@pytest.fixture
def trouble(world: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A folder whose files make episodes break; see `World`."""
    folder = tmp_path / "trouble"
    folder.mkdir()
    monkeypatch.setenv(worlds.TROUBLE, str(folder))
    return folder


@pytest.fixture
def server() -> Iterator[PolicyServer]:
    """A policy server in a thread of this process."""
    with PolicyServer().running() as running:
        yield running


@pytest.fixture
def fast_retries(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let clients of models retry without waiting, unless the server sends a delay."""
    import openai

    from robomme_interference_data.evaluate.language import openai as endpoint

    monkeypatch.setattr(openai._base_client, "INITIAL_RETRY_DELAY", 0.001)
    monkeypatch.setattr(endpoint, "_PAUSE_S", 0.001)


@pytest.fixture(scope="session")
def board_runs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Runs of three policies: one to submit, one with another memory, and a control."""
    folder = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as patch:
        boards.use_tiny(patch)
        boards.make_run(folder / "mine", "replay:framesamp", boards.SYSTEM)
        boards.make_run(folder / "other", "replay:full", "other-memory")
        boards.make_run(folder / "window", "replay:window", "replay-window", no_probe=True)
    yield folder


@pytest.fixture(scope="session")
def published_run(board_runs: Path) -> boards.Files:
    """The files of a run that `publish-results` published."""
    return boards.published(board_runs / "mine")
