"""Small LeRobot policies with weights at random, saved with their processors, and played."""

import json
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors
from lerobot.utils.import_utils import register_third_party_plugins

from robomme_interference_data.constants import ACTION, FRONT, STATE, WRIST
from robomme_interference_data.evaluate.policies.policy import RolloutInfo
from robomme_interference_data.schema.memory_features import in_memory
from robomme_interference_data.simulators.episode import Observation

SIZE = 256
SEED = 5

SMALL: dict[str, dict[str, Any]] = {
    "act": {
        **{"chunk_size": 20, "n_action_steps": 20, "dim_model": 32, "n_heads": 2},
        **{"dim_feedforward": 32, "n_encoder_layers": 1, "use_vae": False},
    },
    "vqbet": {
        **{"n_obs_steps": 2, "n_action_pred_token": 3, "action_chunk_size": 5},
        **{"crop_shape": (64, 64), "vqvae_n_embed": 4, "vqvae_embedding_dim": 8},
        **{"vqvae_enc_hidden_dim": 8, "gpt_input_dim": 16, "gpt_output_dim": 16},
        **{"gpt_hidden_dim": 16, "gpt_n_layer": 1, "gpt_n_head": 2},
    },
    "diffusion": {
        **{"n_obs_steps": 2, "horizon": 16, "n_action_steps": 8, "down_dims": (16, 32)},
        **{"num_inference_steps": 2, "crop_shape": (64, 64), "spatial_softmax_num_keypoints": 4},
    },
    "history_act": {
        **{"memory": "framesamp:4", "image_size": 24, "dim_model": 32, "n_heads": 2},
        **{"dim_feedforward": 32, "n_encoder_layers": 1, "use_vae": False},
    },
}


def features(cameras: tuple[str, ...] = (FRONT, WRIST), size: int = SIZE) -> dict[str, Any]:
    images = {name: PolicyFeature(FeatureType.VISUAL, (3, size, size)) for name in cameras}
    return {
        "input_features": images | {STATE: PolicyFeature(FeatureType.STATE, (8,))},
        "output_features": {ACTION: PolicyFeature(FeatureType.ACTION, (8,))},
    }


def features_with_memory(cameras: tuple[str, ...], size: int) -> dict[str, Any]:
    """Features as a policy gets them from a dataset with a memory."""
    made = features(cameras, size)
    now = made["input_features"]
    return made | {"input_features": now | {in_memory(name): now[name] for name in now}}


def stats(cameras: tuple[str, ...]) -> dict[str, dict[str, torch.Tensor]]:
    """Statistics that make normalization matter."""
    numbers = torch.arange(8, dtype=torch.float32)
    vector = {"mean": numbers / 8, "std": numbers + 1, "min": -numbers - 1, "max": numbers + 2}
    values = {"mean": 0.4, "std": 0.2, "min": 0.0, "max": 1.0}
    image = {name: torch.full((3, 1, 1), value) for name, value in values.items()}
    now = {STATE: vector, **dict.fromkeys(cameras, image)}
    return now | {in_memory(name): values for name, values in now.items()} | {ACTION: vector}


def save_policy(
    folder: Path, kind: str, cameras: tuple[str, ...] = (FRONT, WRIST), **options: Any
) -> Path:
    """Save a policy as LeRobot's training does; what is drawn at random is always the same."""
    given = {"device": "cpu", "push_to_hub": False, "pretrained_backbone_weights": None}
    own = SMALL[kind] | options
    if "memory" in own:
        register_third_party_plugins()
        fits = features_with_memory(cameras, own["image_size"])
    else:
        fits = features(cameras)
    config = make_policy_config(kind, **(fits | given | own))
    with torch.random.fork_rng([]):
        torch.manual_seed(1)
        policy = get_policy_class(kind)(config)
    policy.save_pretrained(folder)
    save_processors(folder, config, stats(cameras))
    return folder


def save_processors(folder: Path, config: Any, statistics: dict[str, Any]) -> None:
    for part in make_pre_post_processors(config, dataset_stats=statistics):
        part.save_pretrained(folder)


def loaded(folder: Path) -> tuple[Any, Any, Any]:
    """Load policy and processors as LeRobot's own evaluation does."""
    config = PreTrainedConfig.from_pretrained(folder)
    model = get_policy_class(config.type).from_pretrained(folder, config=config)
    return model, *make_pre_post_processors(config, pretrained_path=str(folder))


@cache
def section(start: int, stop: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Made-up frames and states, each number its own."""
    frames: dict[str, list[np.ndarray]] = {"front": [], "wrist": []}
    states = []
    for number in range(start, stop):
        draw = np.random.default_rng(number)
        for part in frames.values():
            coarse = draw.integers(0, 256, (8, 8, 3), dtype=np.uint8)
            part.append(coarse.repeat(SIZE // 8, 0).repeat(SIZE // 8, 1))
        states.append(draw.normal(size=8).astype(np.float32))
    return {name: np.stack(part) for name, part in frames.items()}, np.stack(states)


def observation(number: int) -> Observation:
    """The observation of one of them."""
    frames, states = section(number, number + 1)
    return Observation({name: part[0] for name, part in frames.items()}, states[0])


def prepared(number: int) -> dict[str, Any]:
    """An observation as LeRobot's processors take it."""
    frames, states = section(number, number + 1)
    batch: dict[str, Any] = {STATE: torch.from_numpy(states), "task": ["pick the cube"]}
    for name, part in frames.items():
        image = torch.from_numpy(part).permute(0, 3, 1, 2).float() / 255
        batch[f"observation.images.{name}"] = image
    return batch


def play(policy: Any, history: int, live: list[int]) -> list[np.ndarray]:
    """Give history in two chunks, then live frames; return the actions of each time."""
    policy.reset(RolloutInfo("pick the cube", history, SEED))
    if policy.wants_history:
        for start, stop in [(0, history // 2), (history // 2, history)]:
            if stop > start:
                policy.add_history(*section(start, stop), history)
    at, actions = history, []
    for count in live:
        policy.observe(*section(at, at + count))
        at += count
        actions.append(policy.act(observation(at - 1), "pick the cube"))
    return actions


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text(encoding="utf-8"))
    change(config)
    path.write_text(json.dumps(config), encoding="utf-8")
