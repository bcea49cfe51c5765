"""Objects that workers on a Ray cluster share, each in an actor; it imports Ray (`cluster`).

Ray starts an actor that dies again, with a new object.
"""

import logging
import os
import pickle
import secrets
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import ray
from ray import cloudpickle
from ray.exceptions import RayError, RayTaskError

from robomme_interference_data.errors import ServerDiedError, WorkerError, first_line

from .executor import Resources, own_versions
from .ray_cluster import check_node, connected

logger = logging.getLogger(__name__)

_WAIT_S = 30.0
"""Seconds after which a warning reports that an actor could not start yet."""


@ray.remote
class SharedActor:
    """An object on the node where Ray starts it, with the methods `start` and `answer`."""

    def __init__(self, make: bytes, folder: str):
        with suppress(OSError):  # so that relative paths keep their meaning
            os.chdir(folder)
        self._shared = pickle.loads(make)()
        self._shared.start()

    def describe(self) -> tuple[str, dict[str, str]]:
        """Return the node's id, and what must be equal on all machines."""
        return ray.get_runtime_context().get_node_id(), own_versions()

    def answer(self, worker: int, request: bytes) -> bytes:
        """Return the object's answer to a worker."""
        answer: bytes = self._shared.answer(worker, request)
        return answer


@dataclass(frozen=True)
class ActorAddress:
    """The name of an actor, which stays the same when it is started again."""

    name: str

    def connect(self, worker: int) -> Callable[[bytes], bytes]:
        """Return what sends the requests of a worker, by its number.

        Raises:
            ServerDiedError: The actor was ended. What is returned raises it if the actor dies.
        """
        try:
            actor: Any = ray.get_actor(self.name)
        except ValueError as error:  # it is not started again
            raise ServerDiedError(f"no actor of a shared policy: {first_line(error)}") from error
        return partial(_ask, actor, worker)


def _ask(actor: Any, worker: int, request: bytes) -> bytes:
    """Return an actor's answer to a request."""
    try:
        answer: bytes = ray.get(actor.answer.remote(worker, request))
    except RayTaskError:
        raise
    except RayError as error:
        raise ServerDiedError(
            f"the actor of a shared policy died: {first_line(error)}",
            "Ray's log on its node has its output.",
        ) from error
    return answer


@contextmanager
def actors(
    makers: Sequence[Callable[[], Any]], address: str, resources: Resources, workers: int
) -> Iterator[tuple[ActorAddress, ...]]:
    """Keep an actor for each object in the block.

    Args:
        makers: Make the objects, each on the actor's node.
        address: Of the cluster, see `RayWorkers`.
        resources: What Ray reserves for each actor.
        workers: Number of workers, each of which has at most one request.

    Raises:
        WorkerError: The cluster cannot be reached, an actor cannot start, or its node differs.
    """
    with connected(address):
        name, folder = secrets.token_hex(8), str(Path.cwd())
        addresses = tuple(ActorAddress(f"{name}-{number}") for number, _ in enumerate(makers))
        actor: Any = SharedActor
        dumps: Any = cloudpickle.dumps
        started = [
            actor.options(
                name=address.name,
                num_cpus=resources.cpus,
                num_gpus=resources.gpus,
                max_restarts=-1,
                # Each worker may wait in `answer`; one place more is for `describe`.
                max_concurrency=workers + 1,
            ).remote(dumps(make), folder)
            for address, make in zip(addresses, makers, strict=True)
        ]
        try:
            _check_start(started, resources)
            yield addresses
        finally:
            for handle in started:
                ray.kill(handle)


def _check_start(started: Sequence[Any], resources: Resources) -> None:
    """Wait until all actors have begun, and compare their nodes with this process."""
    calls = [handle.describe.remote() for handle in started]
    waiting = calls
    while waiting:
        _, waiting = ray.wait(waiting, num_returns=len(waiting), timeout=_WAIT_S)
        if waiting:
            needs = f"{resources.cpus:g} CPUs and {resources.gpus:g} GPUs"
            logger.warning("Waiting for a node of the cluster with %s free", needs)
    try:
        answers = ray.get(calls)
    except RayError as error:
        raise WorkerError(f"a shared policy cannot start: {first_line(error)}") from error
    for node, versions in answers:
        check_node(node, versions, own_versions())
