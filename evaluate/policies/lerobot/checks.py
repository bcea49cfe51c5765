"""Check that a LeRobot policy fits: its memory, its features, and their statistics."""

from collections.abc import Iterable, Sequence
from typing import Any

from lerobot.configs import FeatureType, NormalizationMode

from robomme_interference_data.constants import ACTION, FRONT, STATE, WRIST
from robomme_interference_data.errors import InterferenceError, PolicyError
from robomme_interference_data.schema.memory_features import (
    MEMORY_PADDING,
    MEMORY_POSITION,
    POSITION,
    declares_memory,
    in_memory,
)
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.simulators.episode import ACTION_SIZE

_FULL_SIZE = 256
"""Side of the simulators' images in pixels."""

_INDICES = (POSITION, MEMORY_POSITION, MEMORY_PADDING)
"""Inputs that are indices or flags: whole numbers, which nothing normalizes."""


def declared_memory(path: str, config: Any) -> Memory | None:
    """Return the memory that a policy's configuration declares, or None.

    Raises:
        PolicyError: There is no such memory rule.
    """
    if not declares_memory(config):
        return None
    try:
        return Memory.parse(config.memory)
    except InterferenceError as error:
        raise PolicyError(
            f"the configuration of the policy {path}: {error.message}", error.hint
        ) from None


def feature_names(before: Any, features: Sequence[str]) -> dict[str, str]:
    """Return the name under which each feature reaches the policy after its preprocessor."""
    names = {name: name for name in features}
    for step in before.steps:
        renames = getattr(step, "rename_map", None) or {}
        names = {name: renames.get(known, known) for name, known in names.items()}
    return names


def check_statistics(path: str, steps: Iterable[Any]) -> None:
    """Check that states and actions have the statistics by which they are normalized.

    LeRobot passes values without statistics on unchanged: the robot would carry out the model's own
    numbers.
    """
    for step in steps:
        modes = getattr(step, "norm_map", {})
        for name, feature in getattr(step, "features", {}).items():
            mode = modes.get(feature.type, NormalizationMode.IDENTITY)
            vector = feature.type in (FeatureType.STATE, FeatureType.ACTION)
            normalized = vector and mode is not NormalizationMode.IDENTITY and name not in _INDICES
            if normalized and not step.stats.get(name):
                raise PolicyError(
                    f"the policy {path} normalizes {name} ({mode.value}), but has no statistics "
                    "for it",
                    "Save it with the processors of its training: make_pre_post_processors(config, "
                    "dataset_stats=dataset.meta.stats).",
                )


def check_features(path: str, config: Any, before: Any, memory: Memory | None) -> None:
    """Compare the policy's features with the simulators' observations and actions."""
    provided = _provided(config, memory)
    names = feature_names(before, [*provided])
    shapes = {names[name]: shape for name, shape in provided.items()}
    wrong = []
    for name, feature in (config.input_features or {}).items():
        shape = tuple(feature.shape)
        if name not in shapes:
            wrong.append(f"wants {name} {shape}, which the simulators do not provide")
        elif shape != shapes[name] and name not in _INDICES:
            wrong.append(f"wants {name} of shape {shape}; the simulators provide {shapes[name]}")
    actions = {
        name: tuple(feature.shape)
        for name, feature in (config.output_features or {}).items()
        if feature.type is FeatureType.ACTION
    }
    if actions != {ACTION: (ACTION_SIZE,)}:
        wrong.append(f"gives actions {actions}; the simulators take {ACTION} ({ACTION_SIZE},)")
    if config.use_peft:
        wrong.append("is an adapter (PEFT), which must be merged into its model first")
    if memory is not None and config.n_obs_steps != 1:
        wrong.append(f"has a memory and n_obs_steps={config.n_obs_steps}; expected 1 with a memory")
    if wrong:
        if memory is None:
            how = (
                f"Train it on {FRONT}, {WRIST}, {STATE} and {ACTION} of a buffer set's executions; "
                "see docs/how-to/connect-a-policy.md."
            )
        else:
            how = (
                "Train it with robomme-interference train, which makes all its images squares of "
                "`image_size`; see docs/how-to/train-a-policy.md."
            )
        raise PolicyError(f"the policy {path} does not fit: it {'; it '.join(wrong)}", how)


def _provided(config: Any, memory: Memory | None) -> dict[str, tuple[int, ...]]:
    """Return the shape of each feature that a policy can have as input."""
    size = None if memory is None else config.image_size
    side = size or _FULL_SIZE
    shapes: dict[str, tuple[int, ...]] = {
        FRONT: (3, side, side),
        WRIST: (3, side, side),
        STATE: (ACTION_SIZE,),
    }
    if memory is not None:
        shapes |= {in_memory(name): shape for name, shape in shapes.items()}
        shapes |= dict.fromkeys(_INDICES, ())
    return shapes
