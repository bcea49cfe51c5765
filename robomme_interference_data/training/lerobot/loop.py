"""Train a LeRobot policy on a buffer set, in LeRobot's own training loop.

The loop builds a `LeRobotDataset` and offers no other. So this module, which is tested with one
version of LeRobot, replaces two names of its module: the function that makes datasets, and the
sampler, which also sets the epoch that all draws depend on. Everything else is the loop's own:
options, processors, optimizers, checkpoints, resuming, several processes, evaluation on items that
are held out, and pushing to the Hub.
"""

import errno
import io
import json
import math
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, field
from typing import Any

import torch
from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import EpisodeAwareSampler
from lerobot.scripts import lerobot_train
from lerobot.transforms import ImageTransforms
from lerobot.utils.constants import IMAGENET_STATS
from lerobot.utils.import_utils import register_third_party_plugins
from safetensors import SafetensorError
from torch.utils.data import Subset

from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.errors import HashMismatchError, InvalidOptionError, first_line
from robomme_interference_data.ids import format_numbers, parse_numbers
from robomme_interference_data.schema.memory_features import declares_memory
from robomme_interference_data.schema.sampling import spread
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.training.draws import number_from
from robomme_interference_data.training.history_dataset import HistoryDataset


@dataclass
class TrainingData(DatasetConfig):  # type: ignore[misc]
    """The data of a training, which LeRobot saves in each checkpoint's `train_config.json`.

    Of LeRobot's own settings, `repo_id`, `root`, `revision`, `episodes`, `image_transforms`,
    `use_imagenet_stats` and `eval_split` have an effect.

    Attributes:
        repo_id: Name of the buffer set, `namespace/name` on the Hub.
        root: Its folder; None if it is on the Hub.
        revision: Its commit, if it is on the Hub.
        content: Identity of its content, `BufferSet.revision`, of which a training can be resumed.
        conditions: Conditions with their weights; empty for all that are planned.
        episodes: Indices of query episodes; None for all.

    The others are arguments of `HistoryDataset`.
    """

    repo_id: str = ""
    content: str = ""
    conditions: dict[str, float] = field(default_factory=dict)
    split: str = "train"
    families: list[str] = field(default_factory=list)
    cameras: list[str] | None = None
    redraw: bool = False
    unit_episodes: str | None = None
    other_states: str = "refuse"
    video_backend: str = "pyav"  # unused; LeRobot's default prints a traceback without FFmpeg


@dataclass
class TrainingConfig(TrainPipelineConfig):  # type: ignore[misc]
    """LeRobot's settings of a training, with a buffer set as dataset."""

    dataset: TrainingData

    def validate(self) -> None:
        """Check the settings.

        Raises:
            InvalidOptionError: LeRobot does not accept them, the policy declares no memory, or they
                need a dataset of LeRobot's.
        """
        try:
            super().validate()
        except (ValueError, FileExistsError, FileNotFoundError) as error:
            raise InvalidOptionError(f"lerobot-train: {first_line(error)}") from error
        if self.job.is_remote or self.dataset.streaming:
            raise InvalidOptionError(
                "--job.target and --dataset.streaming need a dataset of LeRobot's",
                "Leave them out; on another machine, run this command there.",
            )
        memory_of_policy(self.policy)
        chunk_of_policy(self.policy)


def memory_of_policy(config: Any) -> tuple[str, int | None]:
    """Return memory rule and image size that the configuration of a memory policy declares.

    Raises:
        InvalidOptionError: It declares none.
    """
    if not declares_memory(config):
        name = config.type if isinstance(config, PreTrainedConfig) else "of a reward model"
        raise InvalidOptionError(
            f"the policy type {name} has no memory: its configuration lacks the fields `memory` "
            "(such as framesamp:32) and `image_size`",
            "Set --policy.type=history_act, see docs/how-to/train-a-policy.md, or write such a "
            "policy. Policies without a memory train on a buffer set's executions with "
            "lerobot-train itself.",
        )
    return config.memory, config.image_size


def chunk_of_policy(config: Any) -> int:
    """Return the number of actions that a policy predicts from the current frame on.

    Raises:
        InvalidOptionError: It needs other actions, or other observations than the current one.
    """
    actions, observations = config.action_delta_indices, config.observation_delta_indices
    if not actions or list(actions) != list(range(len(actions))):
        expected = "0, 1, 2, …: the next actions from the current frame on"
        raise InvalidOptionError.expected("action_delta_indices", actions, expected)
    if observations not in (None, [0]):
        expected = "None or [0]: earlier observations are in the memory"
        raise InvalidOptionError.expected("observation_delta_indices", observations, expected)
    return len(actions)


def make_datasets(config: TrainingConfig) -> tuple[HistoryDataset, Any]:
    """Return the data to train on, and those to evaluate on or None; what LeRobot calls.

    With `eval_split`, the last query episodes of all families are held out.

    Raises:
        HashMismatchError: The training is resumed, but the buffer set has changed.
        InvalidOptionError: No episodes are left to train on.
    """
    data = config.dataset
    buffer_set = load_buffer_set(data.root or f"{data.repo_id}@{data.revision}")
    if data.content not in ("", buffer_set.revision):
        raise HashMismatchError(
            f"{buffer_set.location} has other content than the buffer set with which the training "
            "began",
            "Start a new training, or give or restore that buffer set.",
        )
    data.content = buffer_set.revision
    data.conditions = data.conditions or dict.fromkeys(buffer_set.conditions, 1.0)
    memory, size = memory_of_policy(config.policy)

    def make(episodes: Sequence[int] | None, transforms: Any) -> HistoryDataset:
        made = HistoryDataset(
            buffer_set,
            data.conditions,
            memory=memory,
            cameras=data.cameras,
            image_size=size,
            chunk=chunk_of_policy(config.policy),
            split=data.split,
            families=data.families,
            episodes=None if episodes is None else format_numbers(episodes),
            redraw=data.redraw,
            unit_episodes=data.unit_episodes,
            other_states=data.other_states,
            seed=config.seed or 0,
            layout="lerobot",
            image_transforms=transforms,
        )
        if data.use_imagenet_stats:
            for camera in made.meta.camera_keys:
                made.meta.stats[camera] |= IMAGENET_STATS
        return made

    enabled = data.image_transforms.enable
    transforms = ImageTransforms(data.image_transforms) if enabled else None
    if not data.eval_split:
        return make(data.episodes, transforms), None
    used = data.episodes or _indices(buffer_set, data.split)
    held_out = math.ceil(len(used) * data.eval_split)
    if held_out == len(used):
        expected = f"less: of {len(used)} episodes, none is left to train on"
        raise InvalidOptionError.expected("--dataset.eval_split", data.eval_split, expected)
    evaluation: Any = make(used[-held_out:], None)
    # LeRobot chooses them from its own table of items.
    chosen = spread(0, len(evaluation), config.max_eval_samples or len(evaluation))
    return make(used[:-held_out], transforms), _HeldOut(evaluation, chosen)


def _indices(buffer_set: BufferSet, split: str) -> list[int]:
    """Return the indices of all query episodes of a split."""
    return sorted({one.index for one in buffer_set.episode_ids if one.split == split})


class _HeldOut(Subset[Any]):
    """Items to evaluate on, the same ones under the same conditions each time.

    accelerate sets the epoch of a dataset that has one; this has none.
    """

    dataset: Any  # a HistoryDataset

    def __getitems__(self, indices: list[int]) -> Any:
        """Return the items of a batch."""
        items = super().__getitems__(indices)
        self.dataset.set_epoch(0)  # that they are taken again is no mistake
        return items


class _Sampler(EpisodeAwareSampler):  # type: ignore[misc]
    """LeRobot's sampler, which sets the epoch of the data when it begins one, also on resume.

    It sets the state of PyTorch's generator, too: loaders draw from it when they begin, how often
    depends on their workers, and dropout would differ from that of an uninterrupted training.
    """

    data: HistoryDataset

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Let the next iteration begin inside an epoch, with the random state of a checkpoint."""
        super().load_state_dict(state)
        self._random = torch.get_rng_state()

    def __iter__(self) -> Iterator[int]:
        self.data.set_epoch(self._epoch)
        if self._start_index:
            torch.set_rng_state(self._random)
        else:
            seed = number_from("epoch", self.seed, self._epoch) >> 1
            torch.default_generator.manual_seed(seed)
        return super().__iter__()


def arguments(buffer_set: str, given: Mapping[str, Any], others: Sequence[str]) -> list[str]:
    """Return the options of `lerobot-train` for a buffer set.

    Args:
        buffer_set: Folder of the buffer set, or `namespace/name` on the Hub.
        given: Settings of `TrainingData`; those that are None are left out, so that those of a
            resumed training stay. Episodes are given as text, such as `0-79`.
        others: Further options.
    """
    files = load_buffer_set(buffer_set).files
    settings = {name: value for name, value in given.items() if value is not None}
    if isinstance(files, LocalFiles):
        settings |= {"repo_id": files.root.resolve().name, "root": str(files.root.resolve())}
    else:
        settings["repo_id"], _, settings["revision"] = files.location.partition("@")
    if "episodes" in settings:
        settings["episodes"] = sorted(parse_numbers(settings["episodes"]))
    made = [
        f"--dataset.{name}={value if isinstance(value, str) else json.dumps(value)}"
        for name, value in settings.items()
    ]
    begun = any(option.startswith(("--policy.type", "--policy.path")) for option in others)
    if begun and not any(option.startswith(_PUSHING) for option in others):
        made.append("--policy.push_to_hub=false")  # LeRobot's default needs a repository
    return [*made, *others]


_PUSHING = ("--policy.repo_id", "--policy.push_to_hub")


def train(arguments: Sequence[str]) -> None:
    """Run LeRobot's training with the options of `lerobot-train`, `--dataset.…` for a buffer set.

    Raises:
        InvalidOptionError: LeRobot does not accept them, or the policy declares no memory.
        HashMismatchError: The training is resumed, but the buffer set has changed.
        OSError: A checkpoint cannot be written. The one before is complete.
    """

    def datasets(config: TrainingConfig) -> tuple[HistoryDataset, Any]:
        made = make_datasets(config)
        lerobot_train.EpisodeAwareSampler = type("Sampler", (_Sampler,), {"data": made[0]})
        return made

    replaced = lerobot_train.make_train_eval_datasets, lerobot_train.EpisodeAwareSampler, sys.argv
    lerobot_train.make_train_eval_datasets = datasets
    # LeRobot also reads some options here after it has parsed all.
    sys.argv = ["lerobot-train", *arguments]
    try:
        register_third_party_plugins()
        settings = _settings()
        try:
            # Without the parser of LeRobot's own settings around it.
            lerobot_train.train.__wrapped__(settings)
        except SafetensorError as error:  # such as on a full disk
            raise OSError(errno.EIO, f"a checkpoint cannot be written: {error}") from error
    finally:
        (lerobot_train.make_train_eval_datasets, lerobot_train.EpisodeAwareSampler, sys.argv) = (
            replaced
        )


def _settings() -> TrainingConfig:
    """Return the settings that the options in `sys.argv` give.

    Raises:
        InvalidOptionError: There is no such option, or it has no such value.
    """

    @parser.wrap()  # type: ignore[untyped-decorator]
    def settings(config: TrainingConfig) -> TrainingConfig:
        return config

    printed = io.StringIO()
    try:
        with redirect_stderr(printed):
            made: TrainingConfig = settings()
    except SystemExit as end:
        if not end.code:  # after --help
            raise
        # The parser prints its usage, hundreds of lines, in front of the error.
        what = printed.getvalue().rpartition("error: ")[2].strip()
        raise InvalidOptionError(
            f"lerobot-train: {what}", "Its options are listed by: lerobot-train --help"
        ) from None
    return made
