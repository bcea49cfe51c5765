"""The command `train`: LeRobot's own loop on a buffer set, resumed, and what does not fit."""

import json
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.buffer_sets import build, copy_buffer_set, plan_again
from support.lazy import lazy
from support.machine import full_disk
from support.messages import raises

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.sources.sample import SampleSource
from robomme_interference_data.errors import (
    HashMismatchError,
    InvalidOptionError,
    MissingExtraError,
)
from robomme_interference_data.training.lerobot.version import TESTED, check_lerobot

pytest.importorskip("lerobot")
training = lazy("robomme_interference_data.training.lerobot.loop")
small = lazy("support.memory_policies")
Train = Callable[..., Path]

MEMORY = "observation.memory.images.front"
TINY = ("--policy.type=tiny_memory", "--policy.device=cpu", "--num_workers=0", "--seed=3")


@pytest.fixture(autouse=True)
def logging_as_before() -> Iterator[None]:
    """LeRobot configures Python's logging."""
    import logging

    root = logging.getLogger()
    before = root.handlers[:], root.level
    yield
    root.handlers[:] = before[0]
    root.setLevel(before[1])


@pytest.fixture
def train(executed_buffers: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Train:
    """Train the smallest policy, and return its run; `LOG` is beside it."""
    _ = small.TinyMemoryConfig  # the import registers it
    monkeypatch.setenv(small.LOG, str(tmp_path / "log"))

    def call(
        *others: str, out: str = "run", buffers: Path = executed_buffers, **given: Any
    ) -> Path:
        settings = {"conditions": {"k0": 1, "k7": 2}, "split": "test"} | given
        options = [*others, f"--output_dir={tmp_path / out}"]
        training.train(training.arguments(str(buffers), settings, options))
        return tmp_path / out

    return call


def lines(run: Path) -> list[dict[str, Any]]:
    """What the policy saw since this was called before."""
    log = run.parent / "log"
    text = log.read_text()
    log.unlink()
    return [json.loads(line) for line in text.splitlines()]


def resumed(run: Path, *others: str) -> tuple[str, ...]:
    config = run / "checkpoints" / "last" / "pretrained_model" / "train_config.json"
    return "--resume=true", f"--config_path={config}", *others


def test_a_training_is_described_and_resumed(train: Train, executed_buffers: Path) -> None:
    run = train(*TINY, "--steps=2", "--batch_size=8", episodes="0")
    first = lines(run)
    folder = run / "checkpoints" / "000002" / "pretrained_model"
    saved = json.loads((folder / "train_config.json").read_text())
    facts = ("root", "content", "conditions", "split", "episodes", "revision")
    assert [saved["dataset"][name] for name in facts] == [
        str(executed_buffers),
        load_buffer_set(executed_buffers).revision,
        {"k0": 1, "k7": 2},
        *("test", [0], None),
    ]
    # The rest is as before: the arguments name the buffer set only.
    options = resumed(run, "--steps=4")
    train(*options, conditions=None, split=None)
    steps = [*first, *lines(run)]
    items = [index for step in steps for index in step["index"]]
    assert len(steps) == 4 and len({*items}) == 32
    model = small.TinyMemoryPolicy.from_pretrained(run / "checkpoints/last/pretrained_model")
    assert (model.config.memory, model.config.image_size) == ("framesamp:4", 16)
    assert {*model.config.input_features} == {
        *("observation.images.front", "observation.memory.images.front"),
        *("observation.state", "observation.memory.state"),
    }


def test_the_memory_is_normalized_like_the_current_frame(
    executed_buffers: Path, tmp_path: Path
) -> None:
    from lerobot.policies.factory import make_policy, make_pre_post_processors

    data = training.HistoryDataset(
        executed_buffers, ["k0"], memory="window:2", image_size=16, chunk=5, split="test",
        layout="lerobot", cache=tmp_path, quiet=True,
    )  # fmt: skip
    config = small.TinyMemoryConfig(memory="window:2", device="cpu")
    make_policy(config, ds_meta=data.meta)
    before, _ = make_pre_post_processors(config, dataset_stats=data.meta.stats)
    # In memory at the next moment is what was there before.
    batch = before(data[[10, 11]])
    for name in ("state", "images.front"):
        now, then = batch[f"observation.{name}"], batch[f"observation.memory.{name}"]
        assert torch.equal(then[1, 0], now[0])
    states = data[[10]]["observation.state"].numpy()
    mean, std = (data.meta.stats["observation.state"][name] for name in ("mean", "std"))
    np.testing.assert_allclose(
        batch["observation.state"][:1], (states - mean) / (std + 1e-8), rtol=1e-4, atol=1e-5
    )


def test_what_does_not_fit(train: Train, tmp_path: Path) -> None:
    for options in (
        (*TINY, "--stepz=2"),
        (*TINY, "--steps=two"),
        ("--policy.type=act", "--policy.device=cpu"),
        (*TINY, "--dataset.streaming=true"),
        (*TINY, "--dataset.eval_split=0.5"),
        (*TINY, "--policy.push_to_hub=true"),
    ):
        with raises(InvalidOptionError):
            train(*options)
    (tmp_path / "run").mkdir()
    with raises(InvalidOptionError):
        train(*TINY)
    config = small.TinyMemoryConfig(device="cpu")
    for name, value in (("action_delta_indices", [-1, 0]), ("observation_delta_indices", [-1, 0])):
        changed = type("Changed", (small.TinyMemoryConfig,), {name: value})
        config.__class__ = changed
        with raises(InvalidOptionError) as error:
            training.chunk_of_policy(config)
        assert error.value.option == name


def test_a_changed_buffer_set_does_not_resume(
    train: Train, executed_buffers: Path, tmp_path: Path
) -> None:
    buffers = copy_buffer_set(tmp_path / "buffers", executed_buffers)
    run = train(*TINY, "--steps=1", "--batch_size=2", buffers=buffers)
    plan_again(buffers, ("k0", "k7"))
    with raises(HashMismatchError):
        train(*resumed(run, "--steps=2"), buffers=buffers)


def test_held_out_items_are_the_same_each_time(train: Train, tmp_path: Path) -> None:
    """The last episode of three, under the same conditions, in the epochs of the others."""
    buffers, source = copy_buffer_set(tmp_path / "buffers"), SampleSource(size=32)
    for kind in ("demonstrations", "executions"):
        build(buffers, kind, source, families=["MoveCube"], split="train")
    plan_again(buffers, ("k0", "k1"))
    options = ("--steps=3", "--batch_size=500", "--eval_steps=1", "--dataset.eval_split=0.3")
    run = train(*TINY, *options, conditions={"k0": 1, "k1": 1}, split="train", buffers=buffers)
    seen = lines(run)
    trained, evaluated = seen[::2], seen[1::2]
    assert len(evaluated[0]["index"]) == 260 - 48
    assert evaluated == [evaluated[0]] * 3 and trained[0] != trained[1]


def test_a_full_disk(train: Train) -> None:
    """The checkpoint that could not be written is an error; the one before resumes."""
    run = train(*TINY, "--policy.chunk_size=5000", "--steps=1", "--batch_size=2")
    with full_disk(1_000_000), pytest.raises(OSError, match="cannot be written") as error:
        train(*resumed(run, "--steps=2"))
    assert error.value.errno  # an error of the system, for which the command has a hint
    train(*resumed(run, "--steps=2"))
    assert (run / "checkpoints" / "last").resolve().name == "000002"


def test_another_version_of_lerobot(monkeypatch: pytest.MonkeyPatch) -> None:
    check_lerobot()
    monkeypatch.setattr(metadata, "version", lambda name: "0.7.0")
    with raises(MissingExtraError) as error:
        check_lerobot()
    assert TESTED in error.value.message and "0.7.0" in error.value.message


@pytest.mark.slow
def test_a_resumed_training_is_the_same(train: Train) -> None:
    """Across the end of an epoch, with other workers, image transforms, and dropout."""
    options = (*TINY, "--batch_size=100", "--dataset.image_transforms.enable=true")
    whole = train(*options, "--steps=9")
    expected = lines(whole)
    stopped = train(*options, "--steps=5", out="stopped")
    found = lines(stopped)
    train(*resumed(stopped, "--steps=9", "--num_workers=1"), out="stopped")
    assert [*found, *lines(stopped)] == expected
    weights = [run / "checkpoints/000009/pretrained_model" for run in (whole, stopped)]
    first, second = (small.TinyMemoryPolicy.from_pretrained(folder) for folder in weights)
    assert torch.equal(first.head.weight, second.head.weight)


@pytest.mark.slow
def test_smolvla_reads_a_memory(train: Train, executed_buffers: Path, tmp_path: Path) -> None:
    smolvla = pytest.importorskip("support.smolvla_memory")
    model = smolvla.save_vision_language(tmp_path / "vlm")
    small_sizes = {
        "vlm_model_name": model,
        "memory": "framesamp:4",
        "image_size": 32,
        "num_vlm_layers": 2,
        "resize_imgs_with_padding": "[32,32]",
        "chunk_size": 5,
        "n_action_steps": 5,
        "device": "cpu",
    }
    run = train(
        "--policy.type=smolvla_memory",
        *(f"--policy.{name}={value}" for name, value in small_sizes.items()),
        *("--dataset.image_transforms.enable=true", "--num_workers=0", "--batch_size=4"),
        "--steps=2",
    )
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import make_pre_post_processors

    folder = run / "checkpoints" / "last" / "pretrained_model"
    config = PreTrainedConfig.from_pretrained(folder)
    policy = smolvla.SmolVLAMemoryPolicy.from_pretrained(folder, config=config)
    before, _ = make_pre_post_processors(config, pretrained_path=str(folder))
    data = training.HistoryDataset(
        executed_buffers, ["k7"], memory="framesamp:4", image_size=32, chunk=5, split="test",
        layout="lerobot", cache=tmp_path, quiet=True,
    )  # fmt: skip
    batch = data[[3]]
    for name in data.meta.camera_keys:
        batch[name] = batch[name] / 255
    seen = before(dict(batch))
    assert seen["observation.language.tokens"].shape[0] == 1
    fixed = {"noise": torch.zeros(1, 5, config.max_action_dim), "time": torch.full((1,), 0.5)}
    losses = []
    # It reads the memory, but not what is padding.
    black = seen | {MEMORY: torch.zeros_like(seen[MEMORY])}
    hidden = {"observation.memory.padding": torch.ones(1, 3, dtype=torch.bool)}
    for changed in (seen, black, seen | hidden, black | hidden):
        losses.append(policy.forward(dict(changed), **fixed)[0].item())
    assert len({*losses}) == 3 and losses[2] == losses[3]
