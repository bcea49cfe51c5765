"""A split on a Hub on the loopback interface, as `publish` lays it out."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from huggingface_hub import constants
from support.hub_server import HubServer

from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, MANIFEST_PATH
from robomme_interference_data.files import write_json
from robomme_interference_data.records import ManifestHeader
from robomme_interference_data.rows import read_header, to_dict

SPLIT, BASE = "someone/units", "someone/demonstrations"


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


def push_split(hub: HubServer, root: Path, work: Path, name: str = SPLIT) -> tuple[str, str]:
    """Put a split into two repositories; return the commits of split and demonstrations."""
    base = hub.push(f"datasets/{BASE}", root / DEMONSTRATIONS)
    shutil.copytree(root / DISTRACTORS, work)
    shutil.copytree(root / "manifests", work / "manifests")
    header = read_header(root / MANIFEST_PATH, ManifestHeader)
    places = {DEMONSTRATIONS: f"{BASE}@{base}", DISTRACTORS: "."}
    datasets = {name: replace(one, place=places[name]) for name, one in header.datasets.items()}
    write_json(work / MANIFEST_PATH, to_dict(replace(header, datasets=datasets)))
    commit = hub.push(f"datasets/{name}", work, "data-1.0.0")
    hub.push(f"datasets/{name}", work)
    return commit, base
