"""Where LeRobot datasets keep what, v3.0 and v2.1: their `info.json` and path templates, pure."""

import math
import re
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.errors import FormatError

VERSIONS = ("v3.0", "v2.1")

_MAX_VALUES = 1 << 26
"""Values in one frame of a feature, at most: nothing is allocated for a shape beyond. An image of
3840 × 2160 pixels has less than half as many."""

_MAX_SIDES = 8
"""Numbers in a shape, at most: else to multiply them takes minutes."""

_MAX_EPISODES = 10_000_000
_MAX_FEATURES = 10_000
_MAX_TEMPLATE = 1000
_MAX_NAME = 200
"""Characters of a path template and of a feature's name, which may stand in it many times."""

_MAX_FRAME = 1 << 40
"""Number of a frame in its file, at most: a timestamp of the container has 64 bits."""

_FPS = (1e-3, 1e6)
"""Frames per second, at least and at most: an hour between two frames is no video."""

_FIELD = re.compile(r"\{(\w+)(?::0(\d)d)?\}")


@dataclass(frozen=True)
class EpisodeLocation:
    """Where an episode lies in its dataset.

    Attributes:
        length: Frames.
        data: Relative path of the parquet file with its rows.
        videos: Column to `(relative path, number of the first frame in that file)`.
    """

    length: int
    data: str
    videos: dict[str, tuple[str, int]]


def check_info(info: dict[str, Any], path: object) -> None:
    """Check what is read of `info.json`: types and sizes, before anything is allocated."""

    def check(holds: bool, name: str) -> None:
        if not holds:
            raise FormatError.damaged(path, f"{name} is {repr(info.get(name))[:200]}")

    fps, total, chunk = info.get("fps"), info.get("total_episodes"), info.get("chunks_size", 1000)
    check(isinstance(fps, int | float) and _FPS[0] <= fps <= _FPS[1], "fps")
    check(isinstance(total, int) and 0 <= total <= _MAX_EPISODES, "total_episodes")
    check(isinstance(chunk, int) and 0 < chunk <= _MAX_EPISODES, "chunks_size")
    check(_is_template(info.get("data_path")), "data_path")
    features = info.get("features")
    check(isinstance(features, dict) and 0 < len(features) <= _MAX_FEATURES, "features")
    for name, feature in features.items() if isinstance(features, dict) else ():
        check(len(name) <= _MAX_NAME, "features")
        check(isinstance(feature, dict) and isinstance(feature.get("dtype"), str), "features")
        shape = feature.get("shape")
        sized = isinstance(shape, list) and len(shape) <= _MAX_SIDES
        sized = sized and all(isinstance(n, int) and 0 < n <= _MAX_VALUES for n in shape)
        check(sized and math.prod(shape) <= _MAX_VALUES, "features")
        described = (feature.get("info", {}), feature.get("video_info", {}))
        check(all(one is None or isinstance(one, dict) for one in described), "features")
        if feature["dtype"] == "video":
            check(_is_template(info.get("video_path")), "video_path")


def _is_template(value: Any) -> bool:
    return isinstance(value, str) and len(value) <= _MAX_TEMPLATE


def fill_template(template: str, where: object, **values: str | int) -> str:
    """Fill in a path template of `info.json`: `{name}` and `{name:03d}`, nothing else."""
    refused = FormatError.damaged(where, f"the path template {template!r} cannot be filled in")

    def value(match: re.Match[str]) -> str:
        found = values.get(match[1])
        if found is None or (match[2] and not isinstance(found, int)):
            raise refused
        return f"{found:0{match[2]}d}" if match[2] else str(found)

    filled = _FIELD.sub(value, template)
    if "{" in filled or "}" in filled:
        raise refused
    return filled


def place_episode(
    info: dict[str, Any], index: int, row: dict[str, Any], where: str
) -> EpisodeLocation:
    """Return where an episode lies.

    Args:
        info: The dataset's `info.json`, checked.
        index: Number of the episode.
        row: Its per-episode columns.
        where: The dataset in words, for messages.
    """

    def whole(name: str) -> int:
        value = row.get(name)
        if not isinstance(value, int) or not 0 <= value <= _MAX_FRAME:
            raise FormatError.damaged(where, f"{name} of episode {index} is {value!r}")
        return value

    def path(template: str, key: str, **more: str) -> str:
        if info["codebase_version"] == "v2.1":
            chunk = index // info.get("chunks_size", 1000)
            return fill_template(template, where, episode_chunk=chunk, episode_index=index, **more)
        chunk, file = whole(f"{key}/chunk_index"), whole(f"{key}/file_index")
        return fill_template(template, where, chunk_index=chunk, file_index=file, **more)

    videos = {}
    for name, feature in info["features"].items():
        if feature["dtype"] != "video":
            continue
        key = f"videos/{name}"
        start: Any = 0.0
        if info["codebase_version"] != "v2.1":
            start = row.get(f"{key}/from_timestamp")
            if not isinstance(start, int | float) or not 0 <= start < 1e9:
                raise FormatError.damaged(where, f"{key}/from_timestamp is {start!r}")
        first = round(start * info["fps"])
        if first > _MAX_FRAME:
            raise FormatError.damaged(where, f"{key}/from_timestamp is {start!r}")
        if abs(first - start * info["fps"]) > 0.1:
            what = f"{key}/from_timestamp {start!r} lies between two frames"
            raise FormatError.damaged(where, what)
        videos[name] = (path(info["video_path"], key, video_key=name), first)
    return EpisodeLocation(whole("length"), path(info["data_path"], "data"), videos)
