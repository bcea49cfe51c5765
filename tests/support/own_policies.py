"""Policies as users write them, for `python:own_policies:…`."""

import hashlib
import os
import resource
import sys
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from robomme_interference_data.evaluate import Policy
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy


class Still:
    """Holds every joint at zero."""

    cameras: Any = ("front",)
    history_cameras: Any = ()
    wants_history = False
    privileged = False
    every_frame = False
    other_states = "refuse"
    memory = None

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


class Watcher(Still):
    """Reads the camera of its option, live and in the history."""

    def __init__(self, camera: str = "top"):
        super().__init__()
        self.cameras = self.history_cameras = (camera,)
        self.wants_history = True


class OfTwoRobots(Watcher):
    """Declares by an option what it gets of the states of units of another robot."""

    def __init__(self, other_states: str = "refuse"):
        super().__init__("front")
        self.other_states: Any = other_states


class Told(Still):
    """Keeps the subgoals that it was told."""

    def __init__(self, single: bool = False):
        super().__init__()
        self.action = np.repeat(self.action, 1 if single else 16, 0)
        self.told: list[Any] = []

    def reset(self, info: Any) -> None:
        self.told = []

    def act(self, observation: Any, goal: str) -> Any:
        self.told.append(observation.subgoal)
        return self.action


class Hashing(Still):
    """Keeps a digest of the whole history and the goal of every rollout that gets that far."""

    history_cameras = ("front", "wrist")
    wants_history = True
    digests: ClassVar[set[str]] = set()

    def reset(self, info: Any) -> None:
        self.digest = hashlib.sha256(repr((info.goal, info.history_frames)).encode())

    def add_history(self, frames: Any, states: Any, exec_start_idx: int) -> None:
        for array in (*frames.values(), states):
            self.digest.update(array.tobytes())

    def act(self, observation: Any, goal: str) -> Any:
        self.digests.add(self.digest.hexdigest())
        return self.action


def still(gripper: float) -> Still:
    return Still(gripper)


def lacking(name: str) -> object:
    """Return a policy without one of its attributes or methods."""
    members = {key: value for key, value in vars(Still).items() if key != name}
    return type("Lacking", (), members)()


def changed(name: str, value: Any) -> Still:
    """Return a policy with another attribute or method."""
    policy = Still()
    setattr(policy, name, value)
    return policy


def raising() -> float:
    return 1 / 0


NUMBER = 3


SAID: dict[str, Any] = {
    "array": {"policy": "still", "sizes": np.arange(3), 4: np.float32(5)},
    "text": "still",
    "nan": {"policy": "still", "scales": [1.0, np.float32("nan")]},
}


def says(what: str) -> Still:
    """Return a policy that says one of these of itself."""
    return changed("metadata", lambda: SAID[what])


class Broken(Still):
    """Breaks with words that no file can hold."""

    def act(self, observation: Any, goal: str) -> Any:
        raise ValueError("no such file: caf\udce9\nin two lines")


class Choosy(Still):
    """Raises in every scene but one."""

    wants_history = True

    def act(self, observation: Any, goal: str) -> Any:
        if "Drawer" not in goal:
            raise RuntimeError("it broke")
        return self.action


class Filler(Still):
    """Lets no file of this process grow any more, as on a full disk."""

    def reset(self, info: Any) -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, resource.getrlimit(resource.RLIMIT_FSIZE)[1]))


class Talker(Still):
    """Writes to stdout wherever it can, and a line to the file of CLOSED when it is closed."""

    def __init__(self) -> None:
        super().__init__()
        sys.stdout.write("made\n")

    def reset(self, info: Any) -> None:
        sys.stdout.write("reset\n")

    def close(self) -> None:
        sys.stdout.write("closed\n")
        with Path(os.environ["CLOSED"]).open("a") as file:
            file.write(f"{os.getpid()}\n")


class Misspelled(Policy):
    """Declares two things in words that nobody reads."""

    camera = ("front",)
    memroy = "full"
    size = 3

    def act(self, observation: Any, goal: str) -> Any:
        return np.zeros((1, 8), np.float32)

    def metadata(self) -> dict[str, Any]:
        return {"policy": "misspelled"}


class Remembering(Hashing):
    """Declares a memory, by an option."""

    def __init__(self, memory: str = "window"):
        super().__init__()
        self.memory: Any = memory


def with_object(name: str = "x", value: Any = sys) -> Still:
    return Still()


class Served(WebsocketPolicy):
    """One of the servers of SERVERS, host:port with commas between; waited for a second.

    It says nothing of where it listens, which is no part of what it is.
    """

    def __init__(self, worker: int = 0):
        host, port = os.environ["SERVERS"].split(",")[worker].split(":")
        super().__init__(host, int(port), connect_s=1.0)

    def metadata(self) -> dict[str, Any]:
        return {name: value for name, value in super().metadata().items() if name != "server"}
