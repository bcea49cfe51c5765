"""Find and read the files of a LeRobot policy: configuration, processors, and its training."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.utils.constants import TRAINING_STATE_DIR, TRAINING_STEP
from lerobot.utils.import_utils import register_third_party_plugins

from robomme_interference_data.errors import MissingExtraError, MissingFileError, PolicyError
from robomme_interference_data.storage.hub import locate
from robomme_interference_data.storage.text import read_json

POLICY_FILES = ("*.json", "*.safetensors", "*.model")
"""What a policy is loaded from: configuration, weights, tokenizers."""

_NEEDED = (
    "config.json",
    "model.safetensors",
    "policy_preprocessor.json",
    "policy_postprocessor.json",
)


def find_policy(path: str) -> tuple[Path, str]:
    """Return the folder with a policy's files, and its source, on the Hub with the commit."""
    files = locate(path, "model")
    folder, name = files.snapshot(*POLICY_FILES), files.location
    missing = [name for name in _NEEDED if not (folder / name).is_file()]
    if missing:
        raise MissingFileError(
            f"{', '.join(missing)} missing in {name}",
            "Expected a folder of LeRobot 0.6, such as …/checkpoints/last/pretrained_model.",
        )
    return folder, name


def read_config(path: str, folder: Path, device: str) -> Any:
    """Return a policy's configuration; `path` is what the user gave, for errors.

    Raises:
        PolicyError: No installed package knows its type, or LeRobot cannot read it.
    """
    with explained(path):
        register_third_party_plugins()
        kind = read_json(folder / "config.json").get("type")
        if kind is None or kind in PreTrainedConfig.get_known_choices():
            config = PreTrainedConfig.from_pretrained(folder)
            config.device, config.pretrained_path = device, folder
            return config
    raise PolicyError(
        f"the policy {path} has the type {kind!r}, which neither LeRobot nor an installed package "
        "defines",
        f"Install the package that defines it, by LeRobot's rule: pip install lerobot_policy_{kind}"
        " (or pip install FOLDER, if it is not published).",
    )


def read_training(folder: Path) -> dict[str, int]:
    """Return what `lerobot-train` saved about the training, as far as it is there.

    The seed, the length of the whole training in steps, and, beside a checkpoint of it, the step at
    which that was saved: `training_seed`, `training_steps`, `training_step`.
    """
    saved = (
        ("training_seed", folder / "train_config.json", "seed"),
        ("training_steps", folder / "train_config.json", "steps"),
        ("training_step", folder.parent / TRAINING_STATE_DIR / TRAINING_STEP, "step"),
    )
    found = {}
    for name, path, key in saved:
        value = read_json(path).get(key) if path.is_file() else None
        if value is not None:
            found[name] = int(value)
    return found


def make_processors(config: Any, folder: Path, device: str) -> tuple[Any, Any]:
    """Return the saved preprocessor and postprocessor."""
    pair: tuple[Any, Any] = make_pre_post_processors(
        config,
        pretrained_path=str(folder),
        preprocessor_overrides={"device_processor": {"device": device}},
    )
    return pair


@contextmanager
def explained(path: str) -> Iterator[None]:
    """Convert exceptions of LeRobot while loading into errors of this package."""
    try:
        with redirect_stdout(sys.stderr):  # it prints
            yield
    except ImportError as error:
        raise MissingExtraError(
            f"the policy {path} needs more of LeRobot: {error}", "Install what it names."
        ) from error
    except Exception as error:
        raise PolicyError(
            f"LeRobot cannot load the policy {path}: {type(error).__name__}: {error}",
            "Was it saved by lerobot 0.6? Older ones are migrated with "
            "python -m lerobot.processor.migrate_policy_normalization.",
        ) from error
