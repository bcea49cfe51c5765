"""Which columns of a LeRobot dataset are which camera, the state, the action, …. Pure rules."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.constants import ACTION, FRAME_COLUMNS, STATE
from robomme_interference_data.errors import (
    InvalidOptionError,
    SourceError,
    UnknownNameError,
    named,
    nearest,
)
from robomme_interference_data.storage.lerobot.dataset import LeRobotFiles
from robomme_interference_data.storage.lerobot.info import picture_info

from ..base import CAMERA_NAMES, Robot, is_camera_name

Features = Mapping[str, Mapping[str, Any]]
"""The columns of a dataset, as in `info.json`: each with its `dtype` and `shape`."""

NONE = "none"
"""What is written for a column to do without it."""

_CAMERA_PREFIXES = ("observation.images.", "observation.image.", "observation.")
_VECTORS = ("state", "action")
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

_CAMERAS = ("front", "wrist")
_NOT_CAMERAS = tuple(name for name in _USUAL if name not in _CAMERAS)
_COUNTERS = (*FRAME_COLUMNS, "subtask_index")
"""Columns of numbers that LeRobot writes into every dataset, or for annotations."""


@dataclass(frozen=True)
class RecordedColumns:
    """The columns that are used.

    Attributes:
        cameras: Camera name to column.
        state: Columns whose values, one after the other, are the state; empty for no states.
        action: The same for the action.
        is_demo: Column that is true in the demonstration, or None; likewise the others.
        exec_start_idx: Column with the number of demonstration frames.
        subgoal: Column with the subgoal of each frame.
    """

    cameras: Mapping[str, str]
    state: tuple[str, ...] = ()
    action: tuple[str, ...] = ()
    is_demo: str | None = None
    exec_start_idx: str | None = None
    subgoal: str | None = None

    @property
    def vectors(self) -> dict[str, tuple[str, ...]]:
        """The columns of `observation.state` and `action`, as far as there are any."""
        vectors = {STATE: self.state, ACTION: self.action}
        return {feature: columns for feature, columns in vectors.items() if columns}


def find_columns(features: Features, given: Mapping[str, str], where: str) -> RecordedColumns:
    """Return the columns that are used; `given` ones take precedence over usual names.

    A given value is a column, several joined with `+` for `state` and `action`, or `none`. Every
    further column of color images is a camera of its own name.

    Raises:
        UnknownNameError: A given column does not exist.
        SourceError: A column does not fit, or it is not clear which one is meant.
        InvalidOptionError: A given value or camera name is invalid.
    """
    chosen = {name: _parse(name, text, features) for name, text in given.items()}
    taken = {column for columns in chosen.values() for column in columns}
    for name, usual in _USUAL.items():
        free = [column for column in usual if column in features]
        if name in _CAMERAS:
            free = [column for column in free if column not in taken]
        if name not in chosen and free:
            chosen[name] = (free[0],)
    _add_cameras(chosen, features, given, where)
    for name, columns in chosen.items():
        for column in columns:
            _check(name, column, features, where)
    cameras = {
        name: columns[0] for name, columns in chosen.items() if name not in _NOT_CAMERAS and columns
    }
    for name, column in cameras.items():
        if not is_camera_name(name):
            raise InvalidOptionError(
                f"{where}: {name!r} is no camera name; expected {CAMERA_NAMES}",
                f"Name the camera with {named('columns', f'NAME={column}')}.",
                option="columns",
            )
    if not cameras:
        raise SourceError(
            f"{where} has no camera; its columns are: {_listed(features, features)}",
            f"Name its column with {named('columns', 'front=COLUMN')}.",
        )
    for name in _VECTORS:
        if name not in chosen:
            _check_absent(name, features, chosen, where)
    single = {
        name: chosen[name][0] for name in _NOT_CAMERAS if chosen.get(name) and name not in _VECTORS
    }
    return RecordedColumns(cameras, chosen.get("state", ()), chosen.get("action", ()), **single)


def recorded_robot(lerobot: LeRobotFiles, vectors: Mapping[str, Sequence[str]]) -> Robot:
    """Return a dataset's robot; `vectors` maps `observation.state` and `action` to columns."""
    kind = lerobot.info.get("robot_type")
    names = {
        feature: value_names(lerobot.features, columns) for feature, columns in vectors.items()
    }
    return Robot(
        fps=lerobot.fps,
        type=kind if isinstance(kind, str) else None,
        names={feature: found for feature, found in names.items() if found},
    )


def value_names(features: Features, columns: Sequence[str]) -> tuple[str, ...] | None:
    """Return the names of the values of joined columns; None if some are unknown.

    Names that occur twice are written with their columns, such as `arm.end.x`.
    """
    found = {column: _names(features[column]) for column in columns}
    known = {column: names for column, names in found.items() if names is not None}
    if len(known) < len(columns):
        return None
    plain = [name for names in known.values() for name in names]
    if len({*plain}) == len(plain):
        return tuple(plain)
    return tuple(f"{column}.{name}" for column, names in known.items() for name in names)


def _names(feature: Mapping[str, Any]) -> tuple[str, ...] | None:
    """Return the names of a vector's values, if the dataset has a different one for each."""
    names: Any = feature.get("names")
    size = feature["shape"][0]
    if isinstance(names, list) and len(names) == 1 and _size(names[0]) == size:  # [["x", "y"]]
        [names] = names
    if isinstance(names, dict):
        if sorted(map(str, names.values())) == sorted(map(str, range(size))):  # {"x": 0, "y": 1}
            names = sorted(names, key=lambda name: int(names[name]))
        else:  # {"motors": [...]}, perhaps with the groups that they belong to
            lists = [value for value in names.values() if _size(value) == size]
            names = lists[0] if len(lists) == 1 else None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return None
    return tuple(names) if len({*names}) == len(names) == size else None


def _size(value: object) -> int | None:
    return len(value) if isinstance(value, list) else None


def _parse(name: str, text: str, features: Features) -> tuple[str, ...]:
    """Return the columns that a given text names; none of them for `none`."""
    if text == NONE and NONE not in features:
        return ()
    columns = (text,) if text in features else tuple(text.split("+"))
    if len(columns) > 1 and name not in _VECTORS:
        raise InvalidOptionError(
            f"{named('columns')} joins several columns for {name!r}: {text}",
            f"Only {' and '.join(_VECTORS)} can be joined: give one column.",
            option="columns",
        )
    if len({*columns}) < len(columns):
        raise InvalidOptionError(
            f"{named('columns')} names a column twice for {name!r}: {text}",
            "Give each once.",
            option="columns",
        )
    return columns


def _add_cameras(
    chosen: dict[str, tuple[str, ...]], features: Features, given: Mapping[str, str], where: str
) -> None:
    """Add every column of color images that is not used yet, as a camera of its own name."""
    for column, feature in features.items():
        name = _camera_name(column)
        used = any(column in columns for columns in chosen.values())
        if used or name in given or _unmet("", feature) is not None:
            continue
        if name in chosen:
            [other] = chosen[name]
            raise SourceError(
                f"{where}: the columns {other!r} and {column!r} are both camera {name!r}",
                f"Name one of them differently with {named('columns', f'NAME={column}')}.",
            )
        chosen[name] = (column,)


def _camera_name(column: str) -> str:
    """Return the name of the camera of a column: its last part, other characters replaced."""
    for prefix in _CAMERA_PREFIXES:
        if column.startswith(prefix):
            column = column.removeprefix(prefix)
            break
    return re.sub(r"[^A-Za-z0-9_-]+", "_", column).lstrip("_-")


def _check(name: str, column: str, features: Features, where: str) -> None:
    """Check that a column exists and holds what its logical name needs."""
    if column not in features:
        raise UnknownNameError.among(f"columns {name}: column", column, where, features)
    expected = _unmet(name, features[column])
    if expected is None:
        return
    guess = "" if name in _USUAL else nearest(name, _USUAL, more="")
    raise SourceError(
        f"{where}: column {_listed([column], features)} does not fit {name!r}, which needs "
        f"{expected}",
        f"Name the right one with {named('columns', f'{name}=COLUMN')}. {guess}".rstrip(),
    )


def _check_absent(
    name: str, features: Features, chosen: Mapping[str, tuple[str, ...]], where: str
) -> None:
    """Check that a dataset has no vectors that may be the state, or the action, by other names.

    It is read without those only if it has none.
    """
    used = {column for columns in chosen.values() for column in columns}
    candidates = [
        column
        for column, feature in features.items()
        if column not in used and _may_be(name, column, feature)
    ]
    if candidates:
        raise SourceError(
            f"{where} has no {name} by a usual name ({' or '.join(_USUAL[name])}). It may be: "
            f"{_listed(candidates, features)}",
            "Name its columns, joined with +, such as "
            f"{named('columns', f'{name}={"+".join(candidates)}')}; or do without, with "
            f"{named('columns', f'{name}={NONE}')}.",
        )


def _may_be(name: str, column: str, feature: Mapping[str, Any]) -> bool:
    if _unmet(name, feature) is not None or column in _COUNTERS or column.startswith("next."):
        return False
    if name == "action":
        return "action" in column
    return "state" in column or (feature["shape"][0] > 1 and "action" not in column)


def _listed(columns: Iterable[str], features: Features) -> str:
    """Return columns with their types and shapes, such as `arm (float32, 7)`."""
    return ", ".join(
        f"{column} ({', '.join([features[column]['dtype'], _sides(features[column])])})"
        for column in columns
    )


def _sides(feature: Mapping[str, Any]) -> str:
    return "×".join(map(str, feature["shape"]))


def _unmet(name: str, feature: Mapping[str, Any]) -> str | None:
    """Return what the column of a logical name should hold, if it does not."""
    kind, shape = feature["dtype"], feature["shape"]
    if name in _VECTORS:
        fits = len(shape) == 1 and kind.startswith(("float", "int", "uint"))
        expected = "a vector of numbers"
    elif name == "subgoal":
        fits = kind in ("string", "language") or "int" in kind
        expected = "text, the number of a subtask, or LeRobot's language annotations"
    elif name == "is_demo":
        fits = kind in ("bool", "string") or "int" in kind or "float" in kind
        expected = "true or false"
    elif name == "exec_start_idx":
        fits, expected = "int" in kind or "float" in kind, "whole numbers"
    else:
        expected = "color images or video, with three channels, no depth maps"
        colors = len(shape) == 3 and 3 in (shape[0], shape[2])
        fits = colors and kind in ("video", "image") and not _is_depth(feature)
    return None if fits else expected


def _is_depth(feature: Mapping[str, Any]) -> bool:
    """Return whether a column holds depth maps; some datasets write the flag as text."""
    described = picture_info(feature)
    flags = (described.get(key) for key in ("is_depth_map", "video.is_depth_map"))
    return any(str(flag).lower() == "true" for flag in flags)
