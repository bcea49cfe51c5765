"""Which column of a LeRobot dataset is the front camera, the wrist camera, the state, …."""

from collections.abc import Mapping
from typing import Any

from robomme_interference_data.errors import InvalidOptionError, SourceError, UnknownNameError
from robomme_interference_data.simulators.base import CAMERAS

_USUAL = {
    "front": ("observation.images.front", "image", "observation.images.image"),
    "wrist": ("observation.images.wrist", "wrist_image", "observation.images.wrist_image"),
    "state": ("observation.state", "state"),
    "action": ("action", "actions"),
    "is_demo": ("is_demo",),
    "exec_start_idx": ("exec_start_idx",),
    "subgoal": ("simple_subgoal", "grounded_subgoal"),
}
"""Names by which each is looked for, in this order: LeRobot's and this project's usual ones, then
those of `lerobot/robomme` and `Yinpei/robomme_data_lerobot`."""

_REQUIRED = ("front", "state")


def resolve_columns(
    features: Mapping[str, Mapping[str, Any]], given: Mapping[str, str] | None, place: str
) -> dict[str, str]:
    """Find the columns of a dataset.

    Args:
        features: `features` of the dataset's `info.json`.
        given: Logical name to column, for those that are not named as usual.
        place: The dataset in words, for messages.

    Returns:
        Logical name to column, of those that the dataset has: `front` and `state` at least.
    """
    given = given or {}
    for name in given:
        if name not in _USUAL:
            raise InvalidOptionError.one_of(f"columns {name}={given[name]}: name", name, _USUAL)
    found = {}
    for name, usual in _USUAL.items():
        column = given.get(name) or next((one for one in usual if one in features), None)
        if column is None and name in _REQUIRED:
            raise SourceError(
                f"{place} has no column named {' or '.join(usual)} for {name!r}; its columns are: "
                f"{', '.join(sorted(features))}",
                f"Name it in `columns`: {name}=COLUMN",
            )
        if column is None:
            continue
        if column not in features:
            raise UnknownNameError.among(f"columns {name}: column", column, place, features)
        kind, shape = features[column]["dtype"], tuple(features[column]["shape"])
        expected = _unmet(name, kind, shape)
        if expected:
            raise SourceError(
                f"{place}: column {column!r} holds {kind} of the shape {shape}; {name!r} needs "
                f"{expected}",
                f"Name the right one in `columns`: {name}=COLUMN",
            )
        found[name] = column
    return found


def _unmet(name: str, kind: str, shape: tuple[int, ...]) -> str | None:
    """Return what a column should hold, if it does not."""
    if name in CAMERAS:
        colours = len(shape) == 3 and 3 in (shape[0], shape[2])
        fits, expected = colours and kind in ("video", "image"), "images or video, three channels"
    elif name in ("state", "action"):
        fits, expected = len(shape) == 1 and kind.startswith("float"), "a vector of floats a frame"
    elif name == "subgoal":
        fits, expected = kind == "string", "a text a frame"
    else:
        fits, expected = kind == "bool" or "int" in kind, "booleans or whole numbers"
    return None if fits else expected
