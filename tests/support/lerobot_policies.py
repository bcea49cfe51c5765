"""Small LeRobot policies with weights at random, saved with their processors, and played."""

import json
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import (
    get_policy_class,
    make_policy_config,
    make_pre_post_processors,
)

from robomme_interference_data.evaluate.policies.base import RolloutInfo
from robomme_interference_data.simulators.base import Observation

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
STATE, ACTION = "observation.state", "action"
SIZE = 256
SEED = 5

SMALL: dict[str, dict[str, Any]] = {
    "act": {
        "chunk_size": 20,
        "n_action_steps": 20,
        "dim_model": 32,
        "n_heads": 2,
        "dim_feedforward": 32,
        "n_encoder_layers": 1,
        "use_vae": False,
    },
    "vqbet": {
        "n_obs_steps": 2,
        "n_action_pred_token": 3,
        "action_chunk_size": 5,
        "crop_shape": (64, 64),
        "vqvae_n_embed": 4,
        "vqvae_embedding_dim": 8,
        "vqvae_enc_hidden_dim": 8,
        "gpt_input_dim": 16,
        "gpt_output_dim": 16,
        "gpt_hidden_dim": 16,
        "gpt_n_layer": 1,
        "gpt_n_head": 2,
    },
    "diffusion": {
        "n_obs_steps": 2,
        "horizon": 16,
        "n_action_steps": 8,
        "down_dims": (16, 32),
        "num_inference_steps": 2,
        "crop_shape": (64, 64),
        "spatial_softmax_num_keypoints": 4,
    },
}


def features(cameras: tuple[str, ...] = (FRONT, WRIST)) -> dict[str, Any]:
    images = {name: PolicyFeature(FeatureType.VISUAL, (3, SIZE, SIZE)) for name in cameras}
    return {
        "input_features": images | {STATE: PolicyFeature(FeatureType.STATE, (8,))},
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (8,))},
    }


def stats(cameras: tuple[str, ...]) -> dict[str, dict[str, torch.Tensor]]:
    """Statistics that make normalization matter."""
    numbers = torch.arange(8, dtype=torch.float32)
    vector = {"mean": numbers / 8, "std": numbers + 1, "min": -numbers - 1, "max": numbers + 2}
    image = {
        "mean": torch.full((3, 1, 1), 0.4),
        "std": torch.full((3, 1, 1), 0.2),
        "min": torch.zeros(3, 1, 1),
        "max": torch.ones(3, 1, 1),
    }
    return {STATE: vector, ACTION: vector, **dict.fromkeys(cameras, image)}


def save_policy(
    folder: Path, kind: str, cameras: tuple[str, ...] = (FRONT, WRIST), **options: Any
) -> Path:
    """Save a policy as LeRobot's training does; what is drawn at random is always the same."""
    given = {"device": "cpu", "push_to_hub": False, "pretrained_backbone_weights": None}
    config = make_policy_config(kind, **(features(cameras) | given | SMALL[kind] | options))
    with torch.random.fork_rng([]):
        torch.manual_seed(1)
        policy = get_policy_class(kind)(config)
    before, after = make_pre_post_processors(config, dataset_stats=stats(cameras))
    for part in (policy, before, after):
        part.save_pretrained(folder)
    return folder


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Models this small are slower on several threads, and much slower on a busy machine."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def act(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_policy(tmp_path_factory.mktemp("act"), "act")


@pytest.fixture(scope="module")
def vqbet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return save_policy(tmp_path_factory.mktemp("vqbet"), "vqbet", (FRONT,))


@cache
def section(start: int, stop: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Made-up frames and states, each number its own."""
    frames = {"front": [], "wrist": []}
    states = []
    for number in range(start, stop):
        draw = np.random.default_rng(number)
        for part in frames.values():
            coarse = draw.integers(0, 256, (8, 8, 3), dtype=np.uint8)
            part.append(coarse.repeat(SIZE // 8, 0).repeat(SIZE // 8, 1))
        states.append(draw.normal(size=8).astype(np.float32))
    return {name: np.stack(part) for name, part in frames.items()}, np.stack(states)


def observation(number: int) -> Observation:
    frames, states = section(number, number + 1)
    return Observation({name: part[0] for name, part in frames.items()}, states[0])


def only(cameras: tuple[str, ...], frames: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: frames[name] for name in cameras}


def play(policy: Any, history: int, live: list[int]) -> list[np.ndarray]:
    """Give history in two chunks, then live frames; return the actions of each time."""
    policy.reset(RolloutInfo("pick the cube", history, SEED))
    if policy.wants_history and history:
        for start, stop in [(0, history // 2), (history // 2, history)]:
            if stop > start:
                frames, states = section(start, stop)
                policy.add_history(only(policy.history_cameras, frames), states, history)
    at, actions = history, []
    for count in live:
        frames, states = section(at, at + count)
        policy.observe(only(policy.cameras, frames), states)
        at += count
        actions.append(policy.act(observation(at - 1), "pick the cube"))
    return actions


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text(encoding="utf-8"))
    change(config)
    path.write_text(json.dumps(config), encoding="utf-8")
