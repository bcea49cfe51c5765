"""Prompts as files: words with places for images and for what is told; pure but for the reading."""

import hashlib
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from importlib import resources
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import FormatError, UnknownNameError, nearest

from .model import Part, Video

_MOST_BYTES = 1 << 16


def fill(
    text: str, words: Mapping[str, str], views: Mapping[str, Sequence[Part]]
) -> tuple[Part, ...]:
    """Return a prompt's text with what stands for its places, words and images in order."""
    parts: list[Part] = []
    rest = 0
    for match in re.finditer("|".join(map(re.escape, (*words, *views))), text):
        found = match.group()
        here = [words[found]] if found in words else views[found] or ["none"]
        for part in (text[rest : match.start()], *here):
            _add(parts, part)
        rest = match.end()
    _add(parts, text[rest:])
    return tuple(parts)


def check_places(name: str, text: str, places: Sequence[str]) -> None:
    """Refuse what looks like a place and is none: it would be shown to the model as it stands.

    Only what is near a place is refused: a model has special words of its own, such as `<think>`.
    """
    for found in re.findall(r"<\w+>|\{\w+\}", text):
        if found not in places and (hint := nearest(found, places, more="")):
            raise ValueError(f"its {name} has {found}, which is no place. {hint}")


def _add(parts: list[Part], part: Part) -> None:
    """Add a part; words go to the words before them."""
    if isinstance(part, str) and parts and isinstance(parts[-1], str):
        parts[-1] += part
    elif not isinstance(part, str) or part:
        parts.append(part)


def told(parts: Sequence[Part]) -> str:
    """Return what a model was asked as records have it: `[image]`, `[video of n frames]`."""
    return "".join(
        f"[video of {len(part.frames)} frames]"
        if isinstance(part, Video)
        else part
        if isinstance(part, str)
        else "[image]"
        for part in parts
    )


def read_prompt[T](
    record: type[T], package: str, names: Sequence[str], name: str, page: str
) -> tuple[T, str]:
    """Read a prompt: one that comes with the package, or a TOML file by its path."""
    path: Any = Path(name)
    if name in names:
        path = resources.files(package) / "prompts" / f"{name}.toml"
    elif not path.is_file():
        raise UnknownNameError(
            f"there is no prompt {name!r}, and no such file",
            f"Give {', '.join(names)}, or the path of a file like those ({page}).",
        )
    data = path.read_bytes()
    known = {one.name: one for one in fields(record)}  # type: ignore[arg-type]
    try:
        if len(data) > _MOST_BYTES:
            raise ValueError(f"{len(data)} bytes; expected at most {_MOST_BYTES}")
        given = tomllib.loads(data.decode())
        for key, value in given.items():
            if key not in known:
                raise ValueError(f"it has {key!r}; expected {', '.join(known)}")
            if type(value) is not known[key].type:
                raise ValueError(f"{key} is {value!r}")
        needed = (key for key, one in known.items() if one.default is MISSING)
        if missing := [key for key in needed if key not in given]:
            raise ValueError(f"it lacks {', '.join(missing)}")
        return record(**given), hashlib.sha256(data).hexdigest()
    except (ValueError, RecursionError) as error:  # what is no TOML, UTF-8 or option is one too
        raise FormatError(f"{name} is no prompt: {error}", f"{page} says what one has.") from None
