"""A small memory policy in plain PyTorch: it answers questions about the past, or acts.

Each frame in memory becomes a token: what the picture shows as a whole and at the points of an
option, the robot's state, and how long ago it was. A transformer (or a recurrent network) reads
the tokens and ends in a score for each option, or in a chunk of actions.
"""

import zlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save
from torch import Tensor, nn
from torch.nn import functional

from robomme_interference_data.errors import FormatError, MissingFileError
from robomme_interference_data.storage.files import atomic_path, write_json
from robomme_interference_data.storage.text import read_json

WORDS = 1024  # buckets for hashed words
CHANNELS = 16  # of a frame's feature map
FARTHEST = 10  # power of 2 of the most frames by which `shifted` moves a memory, plus one

POSITIONS = {
    "both": "from the beginning and back from now",
    "absolute": "from the beginning, for memory alone, so that no delay shows",
    "relative": "back from now",
    "shifted": "both, moved at random in training by 0 to 1,023 frames each",
}
"""From where a model counts the frames to each frame in memory."""


@dataclass(frozen=True)
class Config:
    """What a checkpoint depends on; `data` is the revision of the buffer set it was trained on."""

    task: str  # "answer" or "act"
    data: str
    memory: str
    cameras: tuple[str, ...]
    image_size: int
    points: int = 1  # most points of an option
    state: int = 8
    action: int = 8
    chunk: int = 16
    width: int = 96
    layers: int = 2
    trunk: str = "transformer"
    attention_dropout: bool = True  # False: attention over a long memory is several times as fast
    pictures: bool = True  # False: the control, with its memory's positions and lengths only
    positions: str = "both"  # a key of POSITIONS
    seed: int = 0
    training_step: int = 0
    training_steps: int = 0

    @property
    def targets_are_states(self) -> bool:
        """Whether an action is a state to reach, but for its last value, the gripper's."""
        return self.action == self.state


class FrameEncoder(nn.Module):
    """A patch encoder: patches of 4 × 4 pixels, then a convolution over neighbors."""

    def __init__(self, width: int):
        super().__init__()
        self.patches = nn.Sequential(
            nn.Conv2d(3, CHANNELS, 4, stride=4),
            nn.GELU(),
            nn.Conv2d(CHANNELS, CHANNELS, 3, padding=1),
        )
        self.whole = nn.Sequential(
            nn.GELU(), nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(16 * CHANNELS, width)
        )

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return maps `(N, CHANNELS, h, w)` and vectors `(N, width)` of `(N, 3, S, S) uint8`."""
        maps = self.patches(images.float().div_(127.5).sub_(1))
        return maps, self.whole(maps)


class MemoryModel(nn.Module):
    """See the module; its input is a batch of `HistoryDataset` items."""

    def __init__(self, config: Config):
        super().__init__()
        self.config, width = config, config.width
        self.encoders = nn.ModuleList(FrameEncoder(width) for _ in config.cameras)
        self.state: nn.Module = nn.Linear(config.state, width)
        # At each point of an option: what the first camera shows there, and where it is.
        self.at_points = nn.Linear((CHANNELS + 2) * config.points, width)
        self.mix = nn.Sequential(nn.GELU(), nn.Linear(width, width), nn.GELU())
        self.mixed = nn.Linear(width, width)
        self.words = nn.EmbeddingBag(WORDS, width, mode="mean", padding_idx=0)
        self.time = nn.Linear(18, width)
        if config.trunk == "gru":
            self.trunk: nn.Module = nn.GRU(width, width, config.layers, batch_first=True)
        else:
            dropout = 0.1 if config.task == "answer" else 0.0  # actions need precision
            layer = nn.TransformerEncoderLayer(
                width, 4, 2 * width, dropout, "gelu", batch_first=True, norm_first=True
            )
            layer.self_attn.dropout *= config.attention_dropout
            self.trunk = nn.TransformerEncoder(layer, config.layers, enable_nested_tensor=False)
        outputs = 1 if config.task == "answer" else config.chunk * config.action
        self.head = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, outputs))
        if config.task == "act":
            self.state = nn.Sequential(
                nn.Linear(9 * config.state, width), nn.GELU(), nn.Linear(width, width)
            )
            # `fit_scales` sets these.
            self.register_buffer("state_mean", torch.zeros(config.state))
            self.register_buffer("state_std", torch.ones(config.state))
            self.register_buffer("action_std", torch.ones(config.action))
            if not config.targets_are_states:
                self.register_buffer("action_mean", torch.zeros(config.action))

    def fit_scales(self, batch: dict[str, Any]) -> None:
        """Set the scales of states and of what is added to the first guess, from a batch."""
        state, valid = batch["observation.state"], ~batch["action_is_pad"]
        if not self.config.targets_are_states:
            self.action_mean = batch["action"][valid].mean(0)
        change = (batch["action"] - self._first_guess(batch))[valid]
        self.state_mean = state.mean(0)
        self.state_std, self.action_std = _std(state), _std(change)

    def _first_guess(self, batch: dict[str, Any]) -> Tensor:
        """Return the action that keeps the joints where they are, `(B, 1, D)`.

        Of a robot whose actions are no states, it is the mean action, `(D,)`.
        """
        if not self.config.targets_are_states:
            return self.action_mean  # type: ignore[return-value]
        return functional.pad(batch["observation.state"][:, None, :-1], (0, 1))

    def forward(self, batch: dict[str, Any]) -> Tensor:
        """Return scores of the options, `(B, O)`, or actions, `(B, chunk, D)`."""
        batch = _trimmed(batch)
        tokens, maps = self._frames(batch)
        is_pad = functional.pad(batch["memory.is_pad"], (0, 1))  # the current frame is the last
        time = self._time(batch) + self._text(batch["task"])[:, None]
        if self.config.task == "act":
            read = self._read(self.mixed(self.mix(tokens)) + time, is_pad)
            change = self.head(read).unflatten(1, (self.config.chunk, -1)) * self.action_std
            return self._first_guess(batch) + change
        is_option = ~batch["question.option_is_pad"]
        # A batch has O lists of B texts.
        words = [text for texts in zip(*batch["question.options"], strict=True) for text in texts]
        text = self._text(words).unflatten(0, is_option.shape)[:, :, None]
        seen = tokens[:, None] + self._at_points(batch, maps) + text
        read = self._read(
            (self.mixed(self.mix(seen)) + time[:, None] + text)[is_option],
            is_pad.repeat_interleave(is_option.sum(1), 0),
        )
        scores = read.new_full(is_option.shape, -torch.inf)
        scores[is_option] = self.head(read)[:, 0]
        return scores

    def _frames(self, batch: dict[str, Any]) -> tuple[Tensor, Tensor]:
        """Return a token per frame, `(B, M + 1, width)`, and maps of the first camera."""
        states, acts = _with_current(batch, "state"), self.config.task == "act"
        if acts:
            states = _with_waves((states - self.state_mean) / self.state_std)
        tokens: Tensor = self.state(states)
        size = self.config.image_size // 4
        maps = tokens.new_zeros(len(tokens), tokens.shape[1], CHANNELS, size, size)
        for number, (encoder, camera) in enumerate(
            zip(self.encoders, self.config.cameras, strict=True)
        ):
            images = _with_current(batch, f"images.{camera}")
            seen, whole = encoder(images.flatten(0, 1))
            tokens = tokens + whole.view_as(tokens)
            if number == 0:
                maps = seen.unflatten(0, images.shape[:2])
        if self.config.pictures:
            return tokens, maps
        hidden = torch.zeros_like(tokens)
        if acts:  # it must still see where the arm is now
            hidden[:, -1] = tokens[:, -1]
        return hidden, torch.zeros_like(maps)

    def _at_points(self, batch: dict[str, Any], maps: Tensor) -> Tensor:
        """Return what each frame shows at the points of each option, `(B, O, M + 1, width)`."""
        points, is_pad = batch["question.points"], batch["question.point_is_pad"]
        # Another buffer set may pad to more or fewer points; those beyond the model's are cut.
        lacking = self.config.points - points.shape[2]
        points = functional.pad(points, (0, 0, 0, lacking))
        is_pad = functional.pad(is_pad, (0, lacking), value=True)
        (count, frames), (options, places) = maps.shape[:2], points.shape[1:3]
        grid = (2 * points.flip(-1) - 1).view(count, 1, 1, options * places, 2)
        grid = grid.expand(-1, frames, -1, -1, -1).flatten(0, 1)
        sampled = functional.grid_sample(maps.flatten(0, 1), grid, align_corners=False)
        sampled = sampled.view(count, frames, CHANNELS, options, places).permute(0, 3, 1, 4, 2)
        where = points[:, :, None].expand(-1, -1, frames, -1, -1)
        seen = torch.cat([sampled, where], -1).masked_fill(is_pad[:, :, None, :, None], 0)
        at_points: Tensor = self.at_points(seen.flatten(3))
        return at_points

    def _time(self, batch: dict[str, Any]) -> Tensor:
        """Return how old each frame is and how far from the beginning, `(B, M + 1, width)`."""
        live, kind = batch["position"][:, None], self.config.positions
        positions = torch.cat([batch["memory.position"], live], 1)
        frames = torch.stack([live - positions, positions], -1).float()
        if kind == "shifted" and self.training:
            # As if something were before the memory, and something between it and now. Short
            # moves are as frequent as long ones, as k = 0, 1, 3, 7, … in a mixture.
            moved = torch.exp2(FARTHEST * torch.rand(len(frames), 1, 2, device=frames.device)) - 1
            frames[:, :-1] += moved
            frames[:, -1:, 1:] += moved.sum(-1, keepdim=True)
        if kind == "relative":
            frames[..., 1] = 0
        elif kind == "absolute":
            frames[..., 0] = frames[:, -1, 1] = 0
        far = torch.log1p(frames)
        time: Tensor = self.time(_with_waves(far))
        return time

    def _text(self, texts: list[str]) -> Tensor:
        """Return the mean of the embeddings of hashed words, `(N, width)`."""
        hashed = [[1 + zlib.crc32(w.encode()) % (WORDS - 1) for w in t.split()] for t in texts]
        longest = max(1, *map(len, hashed))
        padded = [numbers + [0] * (longest - len(numbers)) for numbers in hashed]
        text: Tensor = self.words(torch.tensor(padded, device=self.words.weight.device))
        return text

    def _read(self, tokens: Tensor, is_pad: Tensor) -> Tensor:
        """Return what the trunk has read at the current frame, `(N, width)`."""
        if self.config.trunk == "transformer":
            return self.trunk(tokens, src_key_padding_mask=is_pad)[:, -1]  # type: ignore[no-any-return]
        # A recurrent network needs the padding at the beginning.
        order = torch.arange(tokens.shape[1], device=tokens.device) - is_pad.sum(1, keepdim=True)
        order[:, -1] = tokens.shape[1] - 1
        moved = tokens.gather(1, order.clamp(0)[..., None].expand_as(tokens))
        return self.trunk(moved * (order >= 0)[..., None])[0][:, -1]  # type: ignore[no-any-return]


def _std(values: Tensor) -> Tensor:
    """Return the standard deviations of `(N, D)` values, 1 for those that are always the same."""
    std = values.std(0)
    return torch.where(std > 1e-3, std, 1.0)


def _with_waves(values: Tensor) -> Tensor:
    """Return values, then their sines and cosines at four frequencies, `(…, 9 * D)`."""
    waves = [wave(values * 2.0**power) for wave in (torch.sin, torch.cos) for power in range(4)]
    return torch.cat([values, *waves], -1)


def _trimmed(batch: dict[str, Any]) -> dict[str, Any]:
    """Return a batch without the places in memory that none of its items uses."""
    used = int((~batch["memory.is_pad"]).sum(1).max())
    return {
        name: value[:, :used] if name.startswith("memory.") else value
        for name, value in batch.items()
    }


def _with_current(batch: dict[str, Any], name: str) -> Tensor:
    """Return a feature of the frames in memory and of the current one, `(B, M + 1, …)`."""
    return torch.cat([batch[f"memory.{name}"], batch[f"observation.{name}"][:, None]], 1)


def on_device(batch: dict[str, Any], device: str) -> dict[str, Any]:
    """Return a batch with its tensors on a device."""
    return {
        name: value.to(device) if isinstance(value, Tensor) else value
        for name, value in batch.items()
    }


def save_checkpoint(model: MemoryModel, folder: Path, step: int) -> None:
    """Write `config.json` and `model.safetensors`, each whole or not at all."""
    write_json(folder / "config.json", asdict(replace(model.config, training_step=step)))
    with atomic_path(folder / "model.safetensors") as partial:
        partial.write_bytes(save(model.state_dict()))


def load_checkpoint(folder: Path, device: str = "cpu") -> MemoryModel:
    """Read what `save_checkpoint` wrote."""
    try:
        values = read_json(folder / "config.json")
        model = MemoryModel(Config(**values | {"cameras": tuple(values["cameras"])}))
        model.load_state_dict(load_file(folder / "model.safetensors"))
    except FileNotFoundError as error:
        raise MissingFileError(
            f"{folder} is not a checkpoint: {error.filename} is missing.",
            "Give the folder of a run of train.py that has saved its weights.",
        ) from None
    except (ValueError, KeyError, TypeError, RuntimeError, SafetensorError) as error:
        reason = str(error).splitlines()[0]
        raise FormatError(
            f"{folder}: config.json or model.safetensors is damaged ({reason}).",
            "Run train.py once more as before: it restores both from state.pt.",
        ) from None
    return model.to(device).eval()
