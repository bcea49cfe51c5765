"""The smallest LeRobot policy with a memory, which writes down what it was trained on."""

import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import make_default_policy_processor_steps, make_policy_processor_pipelines

LOG = "MEMORY_POLICY_LOG"
"""Environment variable with the file to which each batch adds a line of JSON."""


def _by_mean_and_std() -> dict[str, NormalizationMode]:
    return dict.fromkeys(("VISUAL", "STATE", "ACTION"), NormalizationMode.MEAN_STD)


@PreTrainedConfig.register_subclass("tiny_memory")
@dataclass
class TinyMemoryConfig(PreTrainedConfig):
    memory: str = "framesamp:4"
    image_size: int | None = 16
    chunk_size: int = 5
    observation_delta_indices = None
    reward_delta_indices = None
    normalization_mapping: dict[str, NormalizationMode] = field(default_factory=_by_mean_and_std)

    @property
    def action_delta_indices(self) -> list[int]:
        return list(range(self.chunk_size))

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig(lr=1e-3)

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        pass


class TinyMemoryPolicy(PreTrainedPolicy):
    """A linear function, with dropout, of states, mean colors, and their means over the memory."""

    config_class = TinyMemoryConfig
    name = "tiny_memory"

    def __init__(self, config: TinyMemoryConfig, **_: Any):
        super().__init__(config)
        state, action = config.robot_state_feature.shape[0], config.action_feature.shape[0]
        self.dropout = torch.nn.Dropout(0.1)
        self.head = torch.nn.Linear(2 * (state + 3), config.chunk_size * action)

    def get_optim_params(self) -> Any:
        return self.parameters()

    def reset(self) -> None:
        pass

    def predict_action_chunk(self, batch: dict[str, Any], **_: Any) -> torch.Tensor:
        kept = ~batch["observation.memory.padding"]
        share = (kept / kept.sum(1, keepdim=True).clamp_min(1))[..., None]
        seen = [
            batch["observation.state"],
            batch["observation.images.front"].mean((2, 3)),
            (batch["observation.memory.state"] * share).sum(1),
            (batch["observation.memory.images.front"].mean((3, 4)) * share).sum(1),
        ]
        return self.head(self.dropout(torch.cat(seen, -1))).unflatten(
            -1, (self.config.chunk_size, -1)
        )

    def select_action(self, batch: dict[str, Any], **_: Any) -> torch.Tensor:
        return self.predict_action_chunk(batch)[:, 0]

    def forward(self, batch: dict[str, Any]) -> tuple[torch.Tensor, dict[str, float]]:
        if LOG in os.environ:
            sums = {name: values for name, values in batch.items() if "observation" in name}
            line = {name: values.double().sum().item() for name, values in sums.items()}
            with Path(os.environ[LOG]).open("a") as log:
                log.write(json.dumps(line | {"index": batch["index"].tolist()}) + "\n")
        error = (self.predict_action_chunk(batch) - batch["action"]).abs()
        loss = (error * ~batch["action_is_pad"][..., None]).mean()
        return loss, {"l1": loss.item()}


def make_tiny_memory_pre_post_processors(config: Any, dataset_stats: Any = None) -> Any:
    steps = make_default_policy_processor_steps(config, dataset_stats)
    return make_policy_processor_pipelines(
        input_steps=[
            steps.rename_observations,
            steps.add_batch_dim,
            steps.to_device,
            steps.normalize,
        ],
        output_steps=[steps.unnormalize, steps.to_cpu],
    )
