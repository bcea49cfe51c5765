"""Prompts as files: text with placeholders for images and text."""

import hashlib
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from importlib import resources
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import FormatError, UnknownNameError, counted, nearest

from .model import Part, Video

_MOST_BYTES = 1 << 16


def fill(
    text: str,
    words: Mapping[str, str],
    views: Mapping[str, Sequence[Part]],
    *,
    separator: str = "",
    no_images: str = "none",
) -> tuple[Part, ...]:
    """Return the parts of a text whose placeholders, `{goal}` or `<history>`, are replaced.

    Images of one placeholder have the separator between them; one without images becomes
    `no_images`.
    """
    parts: list[Part] = []
    rest = 0
    for match in re.finditer("|".join(map(re.escape, (*words, *views))), text):
        name = match.group()
        _add(parts, text[rest : match.start()])
        values = [words[name]] if name in words else views[name] or [no_images]
        for place, value in enumerate(values):
            _add(parts, separator if place else "")
            _add(parts, value)
        rest = match.end()
    _add(parts, text[rest:])
    return tuple(parts)


def check_places(name: str, text: str, places: Sequence[str]) -> None:
    """Reject misspelled placeholders; others are special tokens of models, such as `<think>`."""
    for found in re.findall(r"<\w+>|\{\w+\}", text):
        if found not in places and (hint := nearest(found, places, more="")):
            raise ValueError(f"its {name} has the unknown placeholder {found}. {hint}")


def _add(parts: list[Part], part: Part) -> None:
    """Add a part; text is appended to text before it."""
    if isinstance(part, str) and parts and isinstance(parts[-1], str):
        parts[-1] += part
    elif not isinstance(part, str) or part:
        parts.append(part)


def as_text(parts: Sequence[Part]) -> str:
    """Return a prompt for transcripts, with `[image]` and `[video of n frames]`."""
    texts = []
    for part in parts:
        image = "[image]"
        if isinstance(part, Video):
            image = f"[video of {counted(len(part.frames), 'frame')}]"
        texts.append(part if isinstance(part, str) else image)
    return "".join(texts)


def read_prompt[T](record: type[T], names: Sequence[str], name: str, page: str) -> tuple[T, str]:
    """Read a prompt of the package by name, or a TOML file; return it with its SHA-256.

    `record` is its dataclass, of text and integers, `page` the documentation for messages.
    """
    path: Any = Path(name)
    if name in names:
        path = resources.files(__package__) / "prompts" / f"{name}.toml"
    elif not path.is_file():
        raise UnknownNameError(
            f"there is no prompt or file {name!r}",
            f"Expected {', '.join(names)}, or the path of a TOML file ({page}).",
        )
    data = path.read_bytes()
    known = {one.name: one for one in fields(record)}  # type: ignore[arg-type]
    try:
        if len(data) > _MOST_BYTES:
            raise ValueError(f"{len(data)} bytes; expected at most {_MOST_BYTES}")
        values = tomllib.loads(data.decode())
        for key, value in values.items():
            if key not in known:
                raise ValueError(f"it has {key!r}; expected {', '.join(known)}")
            if type(value) is not known[key].type:
                raise ValueError(f"{key} is {value!r}")
        required = (key for key, one in known.items() if one.default is MISSING)
        if missing := [key for key in required if key not in values]:
            raise ValueError(f"it lacks {', '.join(missing)}")
        return record(**values), hashlib.sha256(data).hexdigest()
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{name} is no prompt: {error}", f"See {page}.") from None
