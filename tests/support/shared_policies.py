"""Policies that rollouts share, for `python:support.shared_policies:…`; and a fake of a device."""

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from robomme_interference_data.evaluate import BatchPolicy, Frames, Observation, RolloutInfo
from robomme_interference_data.evaluate.policies.policy import Policy

FAULT = "SHARED_FAULT"
"""Environment variable: a folder; a file in it makes the next call of its name go wrong, once."""


class Remembering(BatchPolicy):
    """Repeats the lesson's pose that its simulator asks for, out of its own session's memory.

    `act_batch` calls are counted in the file `batches` of the folder `FAULT`, by their sizes.
    """

    history_cameras = ("front",)

    def __init__(self, fault: str = ""):
        self.fault = fault

    def session(self) -> Policy:
        return Remembering(self.fault)

    def reset(self, info: RolloutInfo) -> None:
        self.goal, self.states = info.goal, list[Any]()
        self.acted = 0

    def add_history(self, frames: Frames, states: Any, exec_start_idx: int) -> None:
        assert frames["front"].flags.writeable and len(frames["front"]) == len(states)
        self.states += list(states)

    def act(self, observation: Observation, goal: str) -> Any:
        assert goal == self.goal
        self.acted += 1
        if self.fault == "die" and take("die"):
            os.kill(os.getpid(), signal.SIGKILL)
        if self.fault == "hang" and take("hang"):
            time.sleep(3600)
        if self.fault == "goal" and "cube" in goal.lower():
            raise Odd("this goal is odd")
        state = (self.states or [observation.state])[min(3, len(self.states))]
        return np.append(state[:7], np.float32(1.0))[None].astype(np.float32)

    def act_batch(
        self, sessions: Sequence[Any], observations: Sequence[Observation], goals: Sequence[str]
    ) -> list[Any]:
        if folder := os.environ.get(FAULT):
            with Path(folder, "batches").open("a") as file:
                file.write(f"{len(sessions)}\n")
        pairs = zip(sessions, observations, goals, strict=True)
        return [session.act(*request) for session, *request in pairs]

    def metadata(self) -> dict[str, Any]:
        return {"policy": "remembering"}


class Odd(Exception):
    """An exception that cannot be pickled."""

    def __init__(self, text: str):
        super().__init__(text)
        self.lock = open(os.devnull)  # noqa: SIM115, PTH123


class Unloadable(Remembering):
    def session(self) -> Policy:
        raise OSError("no weights here")


class Dying(Remembering):
    def session(self) -> Policy:
        os._exit(9)


class Bare(Remembering):
    """Without what batches need."""

    session = None  # type: ignore[assignment]


class Seeing(Remembering):
    privileged = True


def take(name: str) -> bool:
    """Whether the file exists; it exists no longer."""
    path = Path(os.environ[FAULT], name)
    try:
        path.unlink()
    except FileNotFoundError:
        return False
    return True
