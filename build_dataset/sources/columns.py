"""Which column of a LeRobot dataset is which camera, the state, the action, …."""

import re
from collections.abc import Mapping
from typing import Any

from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, STATE
from robomme_interference_data.errors import (
    InvalidOptionError,
    SourceError,
    UnknownNameError,
    named,
    nearest,
)
from robomme_interference_data.simulators.episode import CAMERAS
from robomme_interference_data.storage.lerobot import LeRobotFiles

from .base import Robot

_CAMERA = re.compile(r"[A-Za-z0-9][\w-]*", re.ASCII)
_USUAL = {
    "front": ("observation.images.front", "image", "observation.images.image"),
    "wrist": ("observation.images.wrist", "wrist_image", "observation.images.wrist_image"),
    "state": (STATE, "state"),
    "action": (ACTION, "actions"),
    "is_demo": ("is_demo",),
    "exec_start_idx": ("exec_start_idx",),
    "subgoal": ("simple_subgoal", "grounded_subgoal"),
}
"""Columns of each logical name, in order of preference: LeRobot's and this project's usual names,
then those of `lerobot/robomme` and `Yinpei/robomme_data_lerobot`."""


def find_columns(
    features: Mapping[str, Mapping[str, Any]], given: Mapping[str, str], where: str
) -> dict[str, str]:
    """Return logical name to column, of all columns that are used; `given` ones take precedence.

    Every further column of color images is a camera of its own name, unless another column has
    been given that name.
    """
    columns = dict(given)
    for name, usual in _USUAL.items():
        free = [column for column in usual if column in features]
        if name in CAMERAS:
            free = [column for column in free if column not in given.values()]
        if name not in given and free:
            columns[name] = free[0]
    for column, feature in features.items():
        name = column.removeprefix(CAMERA_PREFIX)
        if column in columns.values() or name in given or _unmet("", feature) is not None:
            continue
        if name in columns:
            raise SourceError(
                f"{where}: the columns {columns[name]!r} and {column!r} are both camera {name!r}",
                f"Name one of them differently in {named('columns')}: NAME={column}",
            )
        columns[name] = column
    for name, column in columns.items():
        if column not in features:
            raise UnknownNameError.among(f"columns {name}: column", column, where, features)
        if expected := _unmet(name, features[column]):
            kind, shape = features[column]["dtype"], tuple(features[column]["shape"])
            guess = "" if name in _USUAL else nearest(name, _USUAL, more="")
            raise SourceError(
                f"{where}: column {column!r} holds {kind} of the shape {shape}; {name!r} needs "
                f"{expected}",
                f"Name the right one with {named('columns', f'{name}=COLUMN')}. {guess}",
            )
    cameras = camera_names(columns)
    for name in cameras:
        if not _CAMERA.fullmatch(name):
            raise InvalidOptionError(
                f"{where}: {name!r} is no camera name; expected letters, digits, - and _",
                f"Name the camera with {named('columns', f'NAME={columns[name]}')}.",
            )
    if "state" not in columns or not cameras:
        name, what = ("front", "camera") if not cameras else ("state", "robot state")
        raise SourceError(
            f"{where} has no {what}; its columns are: {', '.join(sorted(features))}",
            f"Name its column with {named('columns', f'{name}=COLUMN')}.",
        )
    return columns


def camera_names(columns: Mapping[str, str]) -> tuple[str, ...]:
    """Return those logical names that are cameras."""
    return tuple(name for name in columns if name in CAMERAS or name not in _USUAL)


def recorded_robot(lerobot: LeRobotFiles, columns: Mapping[str, str]) -> Robot:
    """Return a dataset's robot; `columns` maps `observation.state` and `action` to its columns."""
    kind = lerobot.info.get("robot_type")
    names = {feature: _value_names(lerobot.features[name]) for feature, name in columns.items()}
    return Robot(
        fps=lerobot.fps,
        type=kind if isinstance(kind, str) else None,
        names={feature: found for feature, found in names.items() if found},
    )


def _value_names(feature: Mapping[str, Any]) -> tuple[str, ...] | None:
    """Return the names of a vector's values, if the dataset has one for each."""
    names = feature.get("names")
    if isinstance(names, dict) and len(names) == 1:  # older datasets: {"motors": [...]}
        [names] = names.values()
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return None
    return tuple(names) if len(set(names)) == len(names) == feature["shape"][0] else None


def _unmet(name: str, feature: Mapping[str, Any]) -> str | None:
    """Return what the column of a logical name should hold, if it does not."""
    kind, shape = feature["dtype"], feature["shape"]
    if name in ("state", "action"):
        fits, expected = (
            len(shape) == 1 and ("float" in kind or "int" in kind),
            "a vector of numbers",
        )
    elif name == "subgoal":
        fits, expected = kind == "string", "text"
    elif name == "is_demo":
        fits = kind in ("bool", "string") or "int" in kind or "float" in kind
        expected = "true or false"
    elif name == "exec_start_idx":
        fits, expected = "int" in kind or "float" in kind, "whole numbers"
    else:
        colors = len(shape) == 3 and 3 in (shape[0], shape[2])
        fits, expected = colors and kind in ("video", "image"), "images or video, three channels"
    return None if fits else expected
