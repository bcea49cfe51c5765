"""Calls of a rollout, with frames and states that tell their number."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from support.policy_server import PolicyServer

from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.evaluate.policies.websocket import WebsocketPolicy
from robomme_interference_data.simulators.episode import Observation

SIZE = 8
RESET = {"call": "reset"}
INFER = {"call": "infer", "prompt": "pick"}


def added(frames: int, exec_start_idx: int) -> dict[str, Any]:
    return {"call": "add_buffer", "frames": frames, "exec_start_idx": exec_start_idx}


@contextmanager
def client(server: PolicyServer, **options: Any) -> Iterator[WebsocketPolicy]:
    policy = WebsocketPolicy("127.0.0.1", server.port, **options)
    try:
        yield policy
    finally:
        policy.close()


def section(start: int, stop: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Frames and states that tell their number."""
    numbers = np.arange(start, stop)
    front = np.zeros((len(numbers), SIZE, SIZE, 3), np.uint8)
    front[:, 0, 0, :] = np.stack([numbers % 256, numbers // 256, 0 * numbers], 1)
    states = np.repeat(numbers[:, None], 8, 1).astype(np.float32)
    return {"front": front, "wrist": front[::-1]}, states


def observation(number: int) -> Observation:
    frames, states = section(number, number + 1)
    return Observation({name: image[0] for name, image in frames.items()}, states[0])


def info(history: int) -> RolloutInfo:
    return RolloutInfo(goal="pick", history_frames=history, seed=3)


def rollout(policy: WebsocketPolicy, history: int, chunks: list[int], live: list[int]) -> None:
    """Play a rollout: history in chunks, the first live observation, then live ones."""
    policy.reset(info(history))
    at = 0
    for chunk in chunks:
        policy.add_history(*section(at, at + chunk), history)
        at += chunk
    for frames in [1, *live]:
        policy.observe(*section(at, at + frames))
        at += frames
        policy.act(observation(at - 1), "pick")
