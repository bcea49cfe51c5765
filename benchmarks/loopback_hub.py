"""A Hub on the loopback interface, and processes of which it counts the requests."""

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from common import in_fresh_process
from support.hub_http import Request
from support.hub_server import HubServer, User


@dataclass(frozen=True)
class Run:
    """What a process of its own did.

    Attributes:
        seconds: How long it says that it took.
        asked: The requests that it made.
    """

    seconds: float
    asked: Sequence[Request]

    @property
    def received(self) -> int:
        """Bytes that it was sent."""
        return sum(one.sent for one in self.asked)

    @property
    def sent(self) -> int:
        """Bytes that it sent."""
        return sum(len(one.body) for one in self.asked)


class Hub:
    """A server, and processes that take it for the Hub."""

    def __init__(self, server: HubServer, folder: Path, latency: float):
        self._server = server
        self._folder = folder
        self._caches = 0
        server.latency = latency
        server.tokens["hf_someone"] = User("someone")
        os.environ |= {
            "HF_ENDPOINT": server.endpoint,
            "HF_HOME": str(folder / "home"),
            "HF_HUB_DISABLE_IMPLICIT_TOKEN": "0",
            "HF_HUB_DISABLE_PROGRESS_BARS": "1",
            "HF_HUB_DISABLE_TELEMETRY": "1",
            "HF_HUB_DISABLE_XET": "1",
            "HF_HUB_OFFLINE": "0",
            "HF_TOKEN": "hf_someone",
        }

    def fresh_cache(self) -> None:
        """Give the next runs an empty cache."""
        self._caches += 1
        os.environ["HF_HUB_CACHE"] = str(self._folder / f"cache-{self._caches}")

    def run(self, way: Callable[..., object], *arguments: object) -> Run:
        """Let a process do something and count its requests."""
        before = len(self._server.asked)
        seconds = in_fresh_process(_timed, way, *arguments)
        return Run(seconds, self._server.asked[before:])


def _timed(way: Callable[..., object], *arguments: object) -> float:
    """Do something, the client imported; return the seconds."""
    for name in ("_commit_api", "_snapshot_download", "file_download", "hf_api"):
        import_module(f"huggingface_hub.{name}")
    began = time.perf_counter()
    way(*arguments)
    return time.perf_counter() - began


@contextmanager
def running(latency: float) -> Iterator[tuple[Hub, Path]]:
    """Run a Hub with a folder for all that its clients keep.

    Args:
        latency: Seconds that every answer takes longer.
    """
    made = tempfile.TemporaryDirectory(prefix="interference-hub-")
    with made as name, HubServer().running() as server:
        yield Hub(server, Path(name), latency), Path(name)
