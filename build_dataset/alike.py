"""Whether episodes can be in one dataset, and datasets in one buffer. Pure rules."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, STATE, UNITS

MISSING = "missing"
_UNKNOWN = "unknown"


@dataclass(frozen=True)
class Look:
    """What must be alike in episodes that are stored, or played, one after another.

    Attributes:
        features: Cameras, state and, where they matter, actions, to the shapes of their values.
        fps: Frames per second.
        robot_type: Name of the robot; None if unknown.
        names: Names of the values of the state and the action, where known.
    """

    features: Mapping[str, tuple[int, ...]]
    fps: float
    robot_type: str | None = None
    names: Mapping[str, tuple[str, ...]] = field(default_factory=dict)


def in_buffers(kind: str, features: Mapping[str, tuple[int, ...]], fps: float) -> Look:
    """Return what must be alike in the demonstrations and another dataset of a buffer set.

    Buffers have no actions, and units may be of another robot: their states are stored with their
    own number of values.

    Args:
        kind: Name of the other dataset.
        features: Features of one of the two.
        fps: Its frames per second.
    """
    without = {ACTION, STATE} if kind in UNITS else {ACTION}
    return Look({name: shape for name, shape in features.items() if name not in without}, fps)


def in_dataset(left: Look, right: Look) -> tuple[Look, Look]:
    """Return what must be alike in two episodes of one dataset: one may lack actions."""
    looks = left, right
    if all(ACTION in look.features for look in looks):
        return looks
    features = [
        {name: shape for name, shape in look.features.items() if name != ACTION} for look in looks
    ]
    return replace(left, features=features[0]), replace(right, features=features[1])


def differences(left: tuple[str, Look], right: tuple[str, Look]) -> list[str]:
    """Return how two looks differ, a clause each; every look comes with the name of its owner."""
    (first, a), (second, b) = left, right
    facts: dict[str, tuple[str | None, str | None]] = {}
    for feature in sorted(a.features.keys() | b.features.keys()):
        title = _title(feature)
        facts[title] = _size(a.features.get(feature)), _size(b.features.get(feature))
        facts[f"values of {title}"] = _list(a.names.get(feature)), _list(b.names.get(feature))
    same = same_rate(a.fps, b.fps)
    facts["frames per second"] = f"{a.fps:g}", f"{a.fps if same else b.fps:g}"
    facts["robot"] = a.robot_type, b.robot_type
    here = {what: values[0] for what, values in facts.items()}
    return unequal((first, here), (second, {what: values[1] for what, values in facts.items()}))


def describe(look: Look) -> str:
    """Return a look in words: `camera front 64×48 pixels, state 8 values, 10 frames per second`."""
    parts = [f"{_title(name)} {_size(shape)}" for name, shape in sorted(look.features.items())]
    parts.append(f"{look.fps:g} frames per second")
    if look.robot_type is not None:
        parts.append(f"robot {look.robot_type}")
    return ", ".join(parts)


def differ_in_cameras(left: Look, right: Look) -> bool:
    """Return whether two looks differ in cameras alone, so that a choice of cameras mends it."""

    def without_others(look: Look) -> Look:
        shared = {
            name: shape
            for name, shape in look.features.items()
            if not name.startswith(CAMERA_PREFIX)
            or left.features.get(name) == right.features.get(name)
        }
        return replace(look, features=shared)

    return not differences(("", without_others(left)), ("", without_others(right)))


def differ_in_image_sizes(left: Look, right: Look) -> bool:
    """Return whether two looks with the same cameras differ in sizes of images alone."""

    def without_sizes(look: Look) -> Look:
        features = {
            name: () if name.startswith(CAMERA_PREFIX) else shape
            for name, shape in look.features.items()
        }
        return replace(look, features=features)

    return without_sizes(left) == without_sizes(right)


def unequal(left: tuple[str, Mapping[str, Any]], right: tuple[str, Mapping[str, Any]]) -> list[str]:
    """Return which facts differ, a clause each; every map of facts comes with its owner's name."""
    (first, here), (second, there) = left, right
    return [
        f"{what}: {_shown(here, what)} in {first}, {_shown(there, what)} in {second}"
        for what in {**here, **there}
        if here.get(what) != there.get(what)
    ]


def _shown(facts: Mapping[str, Any], what: str) -> object:
    value = facts.get(what, MISSING)
    return _UNKNOWN if value is None else value


def same_rate(left: float, right: float) -> bool:
    """Return whether two frame rates are the same, such as 29.97 and 30000 / 1001."""
    return math.isclose(left, right, rel_tol=1e-5)


def _title(feature: str) -> str:
    if feature.startswith(CAMERA_PREFIX):
        return f"camera {feature.removeprefix(CAMERA_PREFIX)}"
    return "action" if feature == ACTION else "state"


def _size(shape: tuple[int, ...] | None) -> str:
    if shape is None:
        return MISSING
    return f"{shape[0]} values" if len(shape) == 1 else f"{shape[1]}×{shape[0]} pixels"


def _list(names: tuple[str, ...] | None) -> str | None:
    return None if names is None else ", ".join(names)
