"""Small LeRobot policies with weights at random, saved with their processors."""

from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.factory import (
    get_policy_class,
    make_policy_config,
    make_pre_post_processors,
)

FRONT, WRIST = "observation.images.front", "observation.images.wrist"
STATE, ACTION = "observation.state", "action"
SIZE = 256

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
