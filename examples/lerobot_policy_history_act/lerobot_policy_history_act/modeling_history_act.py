"""`history_act`: ACT, in whose transformer encoder memory tokens stand beside the current ones."""

from typing import Any

import torch
from lerobot.policies.act.modeling_act import ACT, ACTEncoder, ACTPolicy
from lerobot.utils.constants import OBS_STATE
from torch import Tensor, nn

from robomme_interference_data.schema.memory_features import (
    MEMORY_PADDING,
    MEMORY_POSITION,
    POSITION,
    in_memory,
)
from robomme_interference_data.training import Memory

from .configuration_history_act import HistoryACTConfig


class HistoryACTPolicy(ACTPolicy):
    """ACT with a memory.

    A batch has ACT's entries and, for M frames in memory, `observation.memory.images.<camera>`
    `(B, M, 3, S, S)`, `observation.memory.state` `(B, M, D)`, `observation.memory.position`
    `(B, M) int64`, `observation.memory.padding` `(B, M) bool` and `observation.position`
    `(B,) int64`. If `select_action` gets no such entries, as in `lerobot-eval`, the policy keeps by
    itself what it has seen since its reset, by the same rule.
    """

    config_class = HistoryACTConfig
    name = "history_act"

    def __init__(self, config: HistoryACTConfig, **kwargs: Any):
        super().__init__(config, **kwargs)
        self.model = HistoryACT(config)
        self._rule = Memory.parse(config.memory)

    def reset(self) -> None:
        """Forget what was seen, and the actions that were not executed."""
        super().reset()
        self._seen: list[dict[str, Tensor]] = []

    @torch.no_grad()
    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the next action, `(B, A)`."""
        if MEMORY_POSITION not in batch:
            self._seen.append({name: batch[name] for name in self.config.remembered})
        return super().select_action(batch, **kwargs)

    @torch.no_grad()
    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the next actions, `(B, chunk_size, A)`."""
        if MEMORY_POSITION not in batch:
            batch = batch | self._own_memory(self._seen or [batch])
        return super().predict_action_chunk(batch, **kwargs)

    def _own_memory(self, seen: list[dict[str, Tensor]]) -> dict[str, Tensor]:
        """Return the entries of the memory; the last observation is the current one."""
        live = len(seen) - 1
        kept = [*self._rule.earlier(live)]
        size, device = len(seen[live][OBS_STATE]), seen[live][OBS_STATE].device
        memory = {
            in_memory(name): torch.stack([seen[at][name] for at in (*kept, live)], 1)[:, :-1]
            for name in self.config.remembered
        }
        return memory | {
            MEMORY_POSITION: torch.tensor(kept, dtype=torch.int64, device=device).expand(size, -1),
            MEMORY_PADDING: torch.zeros(size, len(kept), dtype=torch.bool, device=device),
            POSITION: torch.full((size,), live, device=device),
        }


class HistoryACT(ACT):
    """The network: ACT, a token for each frame in memory, and an encoder that reads both."""

    def __init__(self, config: HistoryACTConfig):
        super().__init__(config)
        self.memory = MemoryTokens(config)
        self.encoder = EncoderWithMemory(config)
        self._reset_parameters()

    def forward(self, batch: dict[str, Tensor]) -> Any:
        """Return ACT's outputs for a batch with a memory."""
        self.encoder.memory = self.memory(batch)
        try:
            return super().forward(batch)
        finally:
            self.encoder.memory = None


class MemoryTokens(nn.Module):
    """A token for each frame in memory: its views, the robot's state, and how old it is."""

    def __init__(self, config: HistoryACTConfig):
        super().__init__()
        width = config.dim_model
        self.names = [in_memory(name) for name in config.image_features]
        self.views = nn.ModuleList(_view_encoder(width) for _ in self.names)
        self.state = nn.Linear(config.robot_state_feature.shape[0], width)

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return tokens and embedded ages, `(M, B, width)`, and padding, `(B, M) bool`."""
        tokens = self.state(batch[in_memory(OBS_STATE)])
        for name, encoder in zip(self.names, self.views, strict=True):
            images = batch[name]
            tokens = tokens + encoder(images.flatten(0, 1)).unflatten(0, images.shape[:2])
        age = batch[POSITION][:, None] - batch[MEMORY_POSITION]
        time = embed_time(age, tokens.shape[-1])
        return tokens.transpose(0, 1), time.transpose(0, 1), batch[MEMORY_PADDING]


class EncoderWithMemory(ACTEncoder):
    """ACT's encoder; the current tokens that it returns have read those of the memory."""

    memory: tuple[Tensor, Tensor, Tensor] | None = None  # given by HistoryACT for one call

    def forward(
        self, x: Tensor, pos_embed: Tensor, key_padding_mask: Tensor | None = None
    ) -> Tensor:
        """Return `(S, B, width)` for S current tokens."""
        tokens, time, padding = self.memory
        current = len(x)
        mask = torch.cat([padding.new_zeros(len(padding), current), padding], 1)
        positions = torch.cat([pos_embed.expand(-1, time.shape[1], -1), time])
        return super().forward(torch.cat([x, tokens]), positions, mask)[:current]


def embed_time(age: Tensor, width: int) -> Tensor:
    """Return sines and cosines of ages in frames, `(..., width)`."""
    places = torch.arange(0, width, 2, device=age.device)
    angles = age[..., None] * 10_000.0 ** (-places / width)
    return torch.cat([angles.sin(), angles.cos()], -1)


def _view_encoder(width: int) -> nn.Module:
    """Return a small network from images `(N, 3, S, S)` to vectors `(N, width)`."""
    return nn.Sequential(
        nn.Conv2d(3, 32, 8, stride=4),
        nn.GELU(),
        nn.Conv2d(32, 64, 3, stride=2, padding=1),
        nn.GELU(),
        nn.AdaptiveAvgPool2d(4),
        nn.Flatten(),
        nn.Linear(16 * 64, width),
    )
