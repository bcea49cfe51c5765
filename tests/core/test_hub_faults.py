"""Loading from a Hub when something goes wrong: one clear error, and the same call goes on."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from huggingface_hub import constants
from support.hub import SPLIT, push_split, running_hub
from support.hub_server import HubServer, User
from support.splits import GOLDEN

from robomme_interference_data import Buffer, load_buffer, load_split
from robomme_interference_data.errors import HashMismatchError, HubError, InterferenceError

QUERY, VERSION = "MoveCube/test/0", "data-1.0.0"
ROWS, VIDEO = r"/manifests/buffers\.parquet", r"/observation.images.front/.*\.mp4"
STATES = r"/data/.*\.parquet"


@pytest.fixture
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    with running_hub(tmp_path / "cache", monkeypatch) as server:
        push_split(server, GOLDEN, tmp_path / "work")
        yield server


def load() -> Buffer:
    return load_buffer(QUERY, "k3", split=SPLIT, revision=VERSION, verify=True)


def whole() -> bool:
    """Whether the buffer comes as it is on disk."""
    return np.array_equal(load().frames(), load_buffer(QUERY, "k3", split=GOLDEN).frames())


@pytest.mark.parametrize("path", [ROWS, VIDEO, STATES])
def test_wrong_bytes_of_the_right_length(hub: HubServer, path: str) -> None:
    hub.fault("GET", path, wrong=True)
    with pytest.raises(HashMismatchError, match="came damaged") as caught:
        load()
    assert "same command again" in str(caught.value.hint)
    assert whole()


@pytest.mark.parametrize("path", [ROWS, VIDEO])
@pytest.mark.parametrize(
    "what",
    [
        # The client tries again for some seconds.
        pytest.param({"drop": 100, "times": 50}, id="dropped", marks=pytest.mark.slow),
        pytest.param({"cut": 40, "times": 50}, id="truncated"),
        pytest.param({"status": 500, "times": 50}, id="500"),
    ],
)
def test_what_does_not_come_whole(hub: HubServer, path: str, what: dict[str, Any]) -> None:
    fault = hub.fault("GET", path, **what)
    with pytest.raises(InterferenceError) as caught:
        load()
    assert "someone/" in caught.value.message and caught.value.hint
    fault.times = 0
    assert whole()


@pytest.mark.parametrize("status", [429, 503])
def test_a_busy_hub_is_asked_again(hub: HubServer, status: int) -> None:
    hub.fault("GET", VIDEO, status=status, headers={"Retry-After": "0"})
    hub.fault("HEAD", VIDEO, status=status, headers={"Retry-After": "0"})
    try:
        assert whole()
    except HubError as error:  # where the client gives up at once, the same call goes on
        assert error.hint
        assert whole()


def test_a_hub_that_is_down(hub: HubServer) -> None:
    hub.down = True
    with pytest.raises(HubError, match="cannot be reached|503"):
        load()
    hub.down = False
    assert whole()


def test_who_may_not_see_it(hub: HubServer, monkeypatch: pytest.MonkeyPatch) -> None:
    repository = hub.repositories[f"datasets/{SPLIT}"]
    repository.private = True
    with pytest.raises(HubError, match="there is no dataset repository") as caught:
        load()
    assert "hf auth login" in str(caught.value.hint)
    repository.private = False
    hub.gated.add(f"datasets/{SPLIT}")
    with pytest.raises(HubError, match="gated"):
        load()
    hub.tokens["good"] = User("someone")
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_IMPLICIT_TOKEN", False)
    monkeypatch.setenv("HF_TOKEN", "good")
    assert whole()


def test_a_renamed_repository_is_found(hub: HubServer) -> None:
    repository = hub.repositories.pop(f"datasets/{SPLIT}")
    repository.name = "datasets/someone/new"
    hub.repositories[repository.name] = repository
    hub.renamed[f"datasets/{SPLIT}"] = "datasets/someone/new"
    assert whole()


def test_a_cache_that_cannot_be_written(
    hub: HubServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises((OSError, InterferenceError)):
        load()
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    assert whole()


def test_nothing_is_asked_of_a_split_that_is_open(hub: HubServer) -> None:
    split = load_split(SPLIT, revision=VERSION)
    split.load(QUERY, "k3")
    hub.down = True
    split.load(QUERY, "k3", verify=True)
