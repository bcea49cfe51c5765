"""Policies as users write them, for `python:own_policies:…`."""

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy


class Still:
    """Holds every joint at zero."""

    cameras: Any = ("front",)
    history_cameras: Any = ()
    wants_history = False
    privileged = False
    every_frame = False

    def __init__(self, gripper: float = 1.0, worker: int = 0):
        self.action = np.array([[0.0] * 7 + [gripper]], np.float32)
        self.worker = worker

    def reset(self, info: Any) -> None: ...

    def add_history(self, frames: Any, states: Any, exec_start_idx: int) -> None: ...

    def observe(self, frames: Any, states: Any) -> None: ...

    def act(self, observation: Any, goal: str) -> Any:
        return self.action

    def metadata(self) -> dict[str, Any]:
        return {"policy": "still"}

    def close(self) -> None: ...


def still(gripper: float) -> Still:
    return Still(gripper)


def nothing() -> object:
    return object()


def all_cameras() -> Still:
    policy = Still()
    policy.cameras = ("front", "top")
    return policy


def one_camera() -> Still:
    policy = Still()
    policy.cameras = "front"
    return policy


def lacking(name: str) -> object:
    """Return a policy without one of its attributes or methods."""
    members = {key: value for key, value in vars(Still).items() if key != name}
    return type("Lacking", (), members)()


def changed(name: str, value: Any) -> Still:
    """Return a policy with another attribute or method."""
    policy = Still()
    setattr(policy, name, value)
    return policy


NUMBER = 3


def with_array() -> Still:
    return changed("metadata", lambda: {"policy": "still", "sizes": np.arange(3), 4: np.float32(5)})


def with_text() -> Still:
    return changed("metadata", lambda: "still")


class Talker(Still):
    """Writes to stdout wherever it can, and a line to the file of CLOSED when it is closed."""

    def reset(self, info: Any) -> None:
        sys.stdout.write("reset\n")

    def close(self) -> None:
        sys.stdout.write("closed\n")
        with Path(os.environ["CLOSED"]).open("a") as file:
            file.write(f"{os.getpid()}\n")


def talker() -> Talker:
    sys.stdout.write("made\n")
    return Talker()


def insider() -> Still:
    return changed("privileged", True)


class Served(WebsocketPolicy):
    """Says nothing of where its server listens, which is no part of what it is."""

    def metadata(self) -> dict[str, Any]:
        return {name: value for name, value in super().metadata().items() if name != "server"}


def served(worker: int = 0) -> Served:
    """One of the servers of SERVERS, host:port with commas between; asked once, not six times."""
    host, port = os.environ["SERVERS"].split(",")[worker].split(":")
    return Served(host, int(port), attempts=1)


CHECKPOINT = "OWN_POLICIES_CHECKPOINT"


def from_checkpoint() -> Still:
    """Return a policy that says which checkpoint an environment variable names."""
    said = {"policy": "still", "checkpoint": os.environ[CHECKPOINT]}
    return changed("metadata", lambda: said)
