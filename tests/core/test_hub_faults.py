"""Loading from a Hub when something goes wrong: one clear error, and the same call resumes."""

import os
import shutil
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from huggingface_hub import constants
from support.buffer_sets import GOLDEN
from support.hub import BASE, BUFFER_SET, push_buffer_set
from support.hub_server import HubServer
from support.machine import full_disk
from support.messages import raises

from robomme_interference_data import Buffer, load_buffer, load_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
from robomme_interference_data.errors import HashMismatchError, InterferenceError

pytestmark = pytest.mark.slow

Run = Callable[..., tuple[int, str, str]]
QUERY, VERSION = "MoveCube/test/0", "data-1.0.0"
ROWS, VIDEO = r"/manifests/buffers\.parquet", r"/observation.images.front/.*\.mp4"
STATES = r"/data/.*\.parquet"


@pytest.fixture
def hub(hub: HubServer, tmp_path: Path) -> HubServer:
    push_buffer_set(hub, GOLDEN, tmp_path / "work")
    return hub


def load() -> Buffer:
    return load_buffer(QUERY, "k3", buffer_set=BUFFER_SET, revision=VERSION, verify=True)


def whole() -> bool:
    """Whether the buffer comes as it is on disk."""
    return np.array_equal(load().frames(), load_buffer(QUERY, "k3", buffer_set=GOLDEN).frames())


@pytest.mark.parametrize("path", [ROWS, VIDEO, STATES])
def test_wrong_bytes_of_the_right_length(hub: HubServer, path: str) -> None:
    hub.fault("GET", path, wrong=True)
    with raises(HashMismatchError) as caught:
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


@pytest.mark.parametrize("status", [500, 503])
@pytest.mark.parametrize(
    ("method", "path"), [("GET", VIDEO), ("HEAD", ROWS), ("GET", "/refs|/tree|/revision")]
)
def test_a_single_fault_of_the_server_is_no_error(
    hub: HubServer, method: str, path: str, status: int
) -> None:
    fault = hub.fault(method, path, status=status)
    assert whole()
    assert fault.times == 0


# --- this machine --------------------------------------------------------------------------------


def leftovers(folder: Path) -> list[Path]:
    return [path for end in ("incomplete", "partial", "tmp") for path in folder.rglob(f"*.{end}")]


def test_a_full_disk(hub: HubServer, tmp_path: Path) -> None:
    with full_disk(12_000), raises(OSError) as caught:
        load()
    assert not isinstance(caught.value, InterferenceError)
    assert caught.value.filename == constants.HF_HUB_CACHE
    assert leftovers(tmp_path) == []
    assert whole()


@pytest.mark.parametrize("where", ["cache", "folder"])
def test_a_full_disk_while_fetching(hub: HubServer, tmp_path: Path, run: Run, where: str) -> None:
    out, command = tmp_path / "out", ["fetch", f"{BUFFER_SET}@{VERSION}", "--to", tmp_path / "out"]
    if where == "folder":
        assert run(*command[:2])[0] == 0
    with full_disk(12_000):
        code, _, err = run(*command)
    place = constants.HF_HUB_CACHE if where == "cache" else f"-> {tmp_path}/.out.building/"
    assert code == 1 and f"{place}" in err and "File too large" in err
    assert "kept; once this is fixed, resume with:\nrobomme-interference fetch" in err
    assert "disk space" in err
    assert leftovers(tmp_path) == [] and not (out / "manifests" / "manifest.json").exists()
    assert run(*command)[0] == 0
    assert [*verify_buffer_set(load_buffer_set(out))] == []


def test_a_cache_that_cannot_be_written(
    hub: HubServer, tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    command = ("fetch", f"{BUFFER_SET}@{VERSION}", "--conditions", "k1")
    (tmp_path / "file").write_bytes(b"")  # a folder's rights would not bind root
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "file" / "cache"))
    code, _, err = run(*command)
    assert code == 1 and f"Error: {tmp_path / 'file'}" in err and "Not a directory" in err
    assert "must be a folder" in err
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    assert run(*command)[0] == 0
    assert whole()


@pytest.mark.parametrize("revision", [VERSION, "main"])
def test_a_cache_that_can_only_be_read(hub: HubServer, tmp_path: Path, revision: str) -> None:
    loaded = load_buffer(QUERY, "k3", buffer_set=BUFFER_SET, revision=revision).frames()
    for folder in (
        "cache/.locks",
        *[f"cache/datasets--{one.replace('/', '--')}/refs" for one in (BUFFER_SET, BASE)],
    ):
        shutil.rmtree(tmp_path / folder, ignore_errors=True)
        (tmp_path / folder).write_bytes(b"")
    before = len(hub.downloads())
    again = load_buffer(QUERY, "k3", buffer_set=BUFFER_SET, revision=revision, verify=True)
    assert np.array_equal(again.frames(), loaded)
    assert len(hub.downloads()) == before


def test_stopped_while_fetching(hub: HubServer, tmp_path: Path, run: Run) -> None:
    command = ("fetch", f"{BUFFER_SET}@{VERSION}", "--to", tmp_path / "out")
    hub.fault("GET", VIDEO, after=3, call=partial(os.kill, os.getpid(), signal.SIGINT))
    code, _, err = run(*command)
    assert code == 130 and "kept; resume with:\nrobomme-interference fetch" in err
    assert leftovers(tmp_path) == [] and not (tmp_path / "out").exists()
    assert run(*command)[0] == 0
    paths = [one.path for one in hub.asked if one.method == "GET" and one.status == 200]
    files = [path for path in paths if not path.startswith("/api/")]
    assert len(files) - len({*files}) <= 8  # unfinished downloads start again
