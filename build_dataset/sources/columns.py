"""Which column of a LeRobot dataset is the front camera, the wrist camera, the state, …."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.errors import (
    InvalidOptionError,
    SourceError,
    UnknownNameError,
)

__all__ = ["ColumnMap", "resolve_columns"]

_USUAL = {
    "front": ("observation.images.front", "image", "observation.images.image"),
    "wrist": ("observation.images.wrist", "wrist_image", "observation.images.wrist_image"),
    "state": ("observation.state", "state"),
    "action": ("action", "actions"),
    "is_demo": ("is_demo",),
    "exec_start_idx": ("exec_start_idx",),
}
"""Names by which each is looked for, in this order: LeRobot's and this project's usual ones, then
those of `lerobot/robomme` and `Yinpei/robomme_data_lerobot`."""

_REQUIRED = ("front", "state")
_CAMERAS = ("front", "wrist")
_EXPECTED = {
    "front": ("video", "image"),
    "wrist": ("video", "image"),
    "state": ("float32", "float64"),
    "action": ("float32", "float64"),
    "is_demo": ("bool", "int8", "uint8", "int32", "int64"),
    "exec_start_idx": ("int8", "int16", "int32", "int64"),
}


@dataclass(frozen=True)
class ColumnMap:
    """The dataset's column for each logical name; None where it has none."""

    front: str
    wrist: str | None
    state: str
    action: str | None
    is_demo: str | None
    exec_start_idx: str | None

    @property
    def cameras(self) -> dict[str, str]:
        """Camera name to column."""
        return {"front": self.front} | ({"wrist": self.wrist} if self.wrist else {})


def resolve_columns(
    features: Mapping[str, Mapping[str, Any]], given: Mapping[str, str] | None, place: str
) -> ColumnMap:
    """Find the columns of a dataset.

    Args:
        features: `features` of the dataset's `info.json`.
        given: Logical name to column, for those that are not named as usual.
        place: The dataset in words, for messages.

    Raises:
        InvalidOptionError: A logical name is unknown.
        UnknownNameError: A given column is not in the dataset.
        SourceError: The front camera or the state is not found, or a column is not of a fitting
            type.
    """
    given = given or {}
    for name in given:
        if name not in _USUAL:
            raise InvalidOptionError.one_of(f"--columns {name}={given[name]}: name", name, _USUAL)
    found: dict[str, str | None] = {}
    for name, usual in _USUAL.items():
        column = given.get(name)
        if column is not None and column not in features:
            raise UnknownNameError.among(f"--columns {name}: column", column, place, features)
        if column is None:
            column = next((known for known in usual if known in features), None)
        if column is None and name in _REQUIRED:
            raise SourceError(
                f"{place} has no column named {' or '.join(usual)} for {name!r}; its columns are: "
                f"{', '.join(sorted(features))}",
                f"Say which one it is: --columns {name}=COLUMN",
            )
        if column is not None:
            _check_type(name, column, features[column], place)
        found[name] = column
    return ColumnMap(**found)  # type: ignore[arg-type]  # the required ones are not None


def _check_type(name: str, column: str, feature: Mapping[str, Any], place: str) -> None:
    kind = feature.get("dtype")
    if kind not in _EXPECTED[name]:
        raise SourceError(
            f"{place}: column {column!r} holds {kind}; {name!r} needs one of "
            f"{', '.join(_EXPECTED[name])}",
            f"Say which column it is: --columns {name}=COLUMN",
        )
    shape: tuple[Any, ...] = tuple(feature.get("shape") or ())
    if name in _CAMERAS and not (len(shape) == 3 and 3 in (shape[0], shape[2])):
        raise SourceError(
            f"{place}: column {column!r} has the shape {shape}; expected three colour channels",
            f"Choose another one: --columns {name}=COLUMN",
        )
    if name in ("state", "action") and len(shape) != 1:
        raise SourceError(
            f"{place}: column {column!r} has the shape {shape}; {name!r} needs one vector a frame",
            f"Say which column it is: --columns {name}=COLUMN",
        )
