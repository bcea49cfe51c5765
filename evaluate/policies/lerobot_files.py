"""Where a LeRobot policy's files are, and whether it fits the simulators."""

import hashlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from typing import Any

import torch
from lerobot.configs import FeatureType

from robomme_interference_data.constants import ACTION, FRONT, STATE, WRIST
from robomme_interference_data.errors import (
    HubError,
    InvalidOptionError,
    MissingExtraError,
    MissingFileError,
    PolicyError,
)
from robomme_interference_data.evaluate.policies.checks import ACTION_SIZE
from robomme_interference_data.files import sha256_file
from robomme_interference_data.hub import is_repo_id

__all__ = [
    "check_features",
    "choose_device",
    "digest_files",
    "explained",
    "feature_names",
    "find_policy",
    "pin_model",
]

IMAGE_SHAPE = (3, 256, 256)
"""Shape of an image of the simulators, channels first."""

_FILES = ("*.json", "*.safetensors", "*.model")
"""What a policy is loaded from: configuration, weights, tokenizers."""

_CONFIG = "config.json"
_WEIGHTS = "model.safetensors"
_PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")


def choose_device(device: str | None) -> str:
    """Return the device, or for None the first GPU, if there is one, else `cpu`.

    Raises:
        InvalidOptionError: It is not there.
    """
    if device is None:
        return "cuda" if torch.cuda.is_available() else "cpu"
    kind, _, index = device.partition(":")
    there = kind == "cpu" and not index
    if kind == "cuda" and (not index or index.isdecimal()):
        there = int(index or 0) < torch.cuda.device_count()
    if not there:
        count = torch.cuda.device_count()
        raise InvalidOptionError(
            f"there is no device {device!r}",
            "Expected cpu"
            + (f", or cuda:0 to cuda:{count - 1}." if count else "; no GPU is here."),
        )
    return device


def find_policy(path: str) -> tuple[Path, str]:
    """Return the folder with the policy's files, and what names it in the record of a run.

    Args:
        path: A folder, or a model on the Hub: `namespace/name` or `namespace/name@revision`.

    Raises:
        MissingFileError: There is no such folder, or a file is missing in it.
        HubError: The Hub does not know the model, or cannot be reached.
    """
    folder, source = Path(path), path
    if not folder.is_dir():
        repo_id, _, revision = path.partition("@")
        if not is_repo_id(repo_id) or path.endswith("@"):
            raise MissingFileError(
                f"there is no folder {path!r}, and a model on the Hub has another kind of name",
                "Expected a folder that LeRobot saved a policy in, namespace/name, or "
                "namespace/name@revision.",
            )
        folder = _download(repo_id, revision or None)
        source = f"{repo_id}@{folder.name}"
    missing = [name for name in (_CONFIG, _WEIGHTS, *_PROCESSORS) if not (folder / name).is_file()]
    if missing:
        raise MissingFileError(
            f"{', '.join(missing)} missing in {source}",
            "Expected what LeRobot 0.6 saves, such as …/checkpoints/last/pretrained_model.",
        )
    return folder, source


def pin_model(path: str) -> str:
    """Return a model on the Hub with its commit, `namespace/name@commit`; a folder as it is.

    Raises:
        MissingFileError, HubError: As `find_policy`.
    """
    return find_policy(path)[1]


def digest_files(folder: Path) -> str:
    """Return the SHA-256 over the names and bytes of a policy's weights and configuration."""
    found = hashlib.sha256()
    files = {
        path.relative_to(folder).as_posix(): path
        for pattern in _FILES
        for path in folder.rglob(pattern)
        if path.is_file()
    }
    for name in sorted(files):
        found.update(f"{name}\0{sha256_file(files[name])}\n".encode())
    return found.hexdigest()


def _download(repo_id: str, revision: str | None) -> Path:
    """Fetch a model's files into the Hub's cache; the folder's name is the commit."""
    from huggingface_hub import snapshot_download

    try:
        return Path(snapshot_download(repo_id, revision=revision, allow_patterns=[*_FILES]))
    except (OSError, ValueError) as error:  # the client's errors are all one of them
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise HubError(
            f"the model {repo_id!r} is not in the cache, and the Hub does not give it: {reason}",
            "Check the name; if a folder on this machine was meant, it does not exist. For a "
            "private model, type: hf auth login",
        ) from error


@contextmanager
def explained(path: str) -> Iterator[None]:
    """Turn what LeRobot raises while loading into errors of this package.

    Raises:
        MissingExtraError: A library is missing.
        PolicyError: Anything else went wrong.
    """
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


def feature_names(before: Any) -> dict[str, str]:
    """Return under which name each observation reaches the policy."""
    names = {name: name for name in (FRONT, WRIST, STATE)}
    for step in before.steps:
        renames = getattr(step, "rename_map", None) or {}
        names = {name: renames.get(known, known) for name, known in names.items()}
    return names


def check_features(path: str, config: Any, names: dict[str, str]) -> None:
    """Compare the policy's features with what the simulators give and take.

    Raises:
        PolicyError: The policy wants something else, or gives other actions.
    """
    given = {names[FRONT]: IMAGE_SHAPE, names[WRIST]: IMAGE_SHAPE, names[STATE]: (ACTION_SIZE,)}
    wrong = []
    for name, feature in (config.input_features or {}).items():
        shape = tuple(feature.shape)
        if name not in given:
            wrong.append(f"wants {name} {shape}, which the simulators do not give")
        elif shape != given[name]:
            wrong.append(f"wants {name} of shape {shape}; the simulators give {given[name]}")
    actions = {
        name: tuple(feature.shape)
        for name, feature in (config.output_features or {}).items()
        if feature.type is FeatureType.ACTION
    }
    if actions != {ACTION: (ACTION_SIZE,)}:
        wrong.append(f"gives actions {actions}; the simulators take {ACTION} ({ACTION_SIZE},)")
    if config.use_peft:
        wrong.append("is an adapter (PEFT), which must be merged into its model first")
    if wrong:
        raise PolicyError(
            f"the policy {path} does not fit: it {'; it '.join(wrong)}",
            f"Train it on {FRONT}, {WRIST}, {STATE} and {ACTION} of a split's demonstrations; "
            "docs/systems.md says how.",
        )
