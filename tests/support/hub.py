"""A buffer set on a Hub on the loopback interface, laid out like a published one."""

import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from huggingface_hub import constants
from support.hub_server import HubServer

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    MANIFEST_PATH,
    QUESTIONS_PATH,
)
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.manifest import ManifestHeader
from robomme_interference_data.storage.files import write_json
from robomme_interference_data.storage.text import read_header

BUFFER_SET, BASE = "someone/units", "someone/demonstrations"


@contextmanager
def running_hub(cache: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[HubServer]:
    """Run a Hub, and let the client of this process use it, with a cache of its own."""
    with HubServer().running() as server:
        template = server.endpoint + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "ENDPOINT", server.endpoint)
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
        monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache))
        yield server


def elsewhere(hub: HubServer, *arguments: str) -> subprocess.Popen[str]:
    """Run Python in a process that takes the server for the Hub from its beginning.

    The cache is that of this process.
    """
    own = {"HF_ENDPOINT": hub.endpoint, "HF_HUB_OFFLINE": "0", "HF_HUB_DISABLE_IMPLICIT_TOKEN": "0"}
    own |= {"HF_HUB_CACHE": constants.HF_HUB_CACHE, "PYTHONPATH": str(Path(__file__).parents[1])}
    command = [sys.executable, "-c", *arguments]
    return subprocess.Popen(command, env=os.environ | own, stdout=subprocess.PIPE, text=True)


def kill_at(hub: HubServer, method: str, path: str, after: int, *arguments: str) -> None:
    """Run Python elsewhere, and kill it when it asks for such a path after so many others."""
    reached, killed = threading.Event(), threading.Event()

    def hold() -> None:
        reached.set()
        killed.wait(60)

    hub.fault(method, path, after=after, call=hold)
    with elsewhere(hub, *arguments) as process:
        came = reached.wait(120)
        process.kill()
    killed.set()
    assert came


def push_buffer_set(
    hub: HubServer, root: Path, work: Path, name: str = BUFFER_SET
) -> tuple[str, str]:
    """Push a buffer set to two repositories; return the commits of it and its demonstrations."""
    base = hub.push(f"datasets/{BASE}", root / DEMONSTRATIONS)
    shutil.copytree(root / DISTRACTORS, work)
    shutil.copytree(root / "manifests", work / "manifests")
    header = read_header(root / MANIFEST_PATH, ManifestHeader)
    if header.questions is not None:
        shutil.copyfile(root / QUESTIONS_PATH, work / QUESTIONS_PATH)
    places = {DEMONSTRATIONS: f"{BASE}@{base}", DISTRACTORS: "."}
    datasets = {name: replace(one, location=places[name]) for name, one in header.datasets.items()}
    write_json(work / MANIFEST_PATH, to_dict(replace(header, datasets=datasets)))
    commit = hub.push(f"datasets/{name}", work, "data-1.0.0")
    hub.push(f"datasets/{name}", work)
    return commit, base
