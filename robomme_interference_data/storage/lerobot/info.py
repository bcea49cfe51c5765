"""Check `info.json` of a LeRobot dataset before it is used. Pure rules."""

import math
from collections.abc import Mapping
from typing import Any

from robomme_interference_data.errors import FormatError

from ..limits import MAX_FRAME_VALUES, MAX_NAME, MAX_RATE, MIN_RATE

# Upper bounds, checked before anything is allocated.
_MAX_SIDES = 8  # numbers in a shape
_MAX_EPISODES = 10_000_000
_MAX_FEATURES = 10_000
_MAX_TEMPLATE = 1000  # characters of a path template


def check_info(info: dict[str, Any], path: object) -> None:
    """Check types and sizes of what is read from `info.json`; `path` is its path for messages.

    Raises:
        FormatError: A value has another type, or is too large.
    """

    def check(valid: bool, name: str, expected: str) -> None:
        if not valid:
            raise _invalid(path, name, info.get(name), expected)

    fps, features = info.get("fps"), info.get("features")
    rates = f"{MIN_RATE:g} to {MAX_RATE:,.0f} frames per second"
    valid = isinstance(fps, int | float) and MIN_RATE <= fps <= MAX_RATE
    check(valid, "fps", f"a number, {rates}")
    counts = f"a whole number up to {_MAX_EPISODES:,}"
    check(_is_count(info.get("total_episodes"), 0, _MAX_EPISODES), "total_episodes", counts)
    check(_is_count(info.get("chunks_size", 1000), 1, _MAX_EPISODES), "chunks_size", counts)
    templates = f"text with at most {_MAX_TEMPLATE} characters"
    check(_is_template(info.get("data_path")), "data_path", templates)
    valid = isinstance(features, dict) and 0 < len(features) <= _MAX_FEATURES
    check(valid, "features", f"1 to {_MAX_FEATURES:,} of them, by name")
    for name, feature in features.items() if isinstance(features, dict) else ():
        _check_feature(name, feature, path)
        if feature["dtype"] == "video":
            check(_is_template(info.get("video_path")), "video_path", templates)


def _check_feature(name: str, feature: Any, path: object) -> None:
    where = f"the feature {name[:MAX_NAME]!r}"
    if len(name) > MAX_NAME:
        raise _invalid(path, "the name of a feature", name, f"at most {MAX_NAME} characters")
    if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
        raise _invalid(path, where, feature, "a map with a dtype and a shape")
    shape: Any = feature.get("shape")
    valid = isinstance(shape, list) and len(shape) <= _MAX_SIDES
    # Some datasets declare features of no values, which are not stored.
    valid = valid and all(_is_count(side, 0, MAX_FRAME_VALUES) for side in shape)
    if not valid or math.prod(shape) > MAX_FRAME_VALUES:
        expected = f"a list of up to {_MAX_SIDES} whole numbers, of at most "
        expected += f"{MAX_FRAME_VALUES:,} values in all"
        raise _invalid(path, f"the shape of {where}", shape, expected)
    if feature["dtype"] in ("video", "image"):
        for key in ("info", "video_info"):  # LeRobot's newer and older name
            if not isinstance(feature.get(key), dict | None):
                raise _invalid(path, f"{key} of {where}", feature[key], "a map")


def picture_info(feature: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a dataset states about the pictures of a feature; empty if it states nothing."""
    # LeRobot's older and newer name.
    return (feature.get("video_info") or {}) | (feature.get("info") or {})


def _is_count(value: Any, least: int, most: int) -> bool:
    whole = isinstance(value, int) and not isinstance(value, bool)
    return whole and least <= value <= most


def _is_template(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _MAX_TEMPLATE


def _invalid(path: object, name: str, value: Any, expected: str) -> FormatError:
    return FormatError(
        f"{path}: {name} is {repr(value)[:200]}; expected {expected}",
        f"Correct it in {path}, or write the dataset again.",
    )
