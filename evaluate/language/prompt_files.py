"""Prompts: text with placeholders for images and text, of this package or a TOML file."""

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields
from importlib import resources
from pathlib import Path
from typing import Any, ClassVar, Self

from robomme_interference_data.errors import FormatError, UnknownNameError, counted, nearest
from robomme_interference_data.storage.text import decode_text, digest_json

from .models import ChatModel, Part, Video, model_identity

_MAX_BYTES = 1 << 16


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
    for place in re.findall(r"<\w+>|\{\w+\}", text):
        if place not in places and (hint := nearest(place, places, more="")):
            raise ValueError(f"its {name} has the unknown placeholder {place}. {hint}")


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


@dataclass(frozen=True)
class Prompt:
    """A prompt, as its TOML file has it; subclasses have its fields, text and integers.

    Attributes:
        packaged: Names of the prompts of this package.
    """

    packaged: ClassVar[tuple[str, ...]]

    @property
    def sha256(self) -> str:
        """What identifies it: SHA-256 of its content, keys and values, defaults included."""
        return digest_json([asdict(self)])

    @classmethod
    def load(cls, name: str) -> Self:
        """Read a prompt of this package by its name, or a TOML file by its path.

        Raises:
            UnknownNameError: There is neither.
            FormatError: The file is no prompt of this class.
        """
        page = "docs/reference/prompts.md"
        path: Any = Path(name)
        if name in cls.packaged:
            path = resources.files(__package__) / "prompts" / f"{name}.toml"
        elif not path.is_file():
            raise UnknownNameError(
                f"there is no prompt or file {name!r}",
                f"Expected {', '.join(cls.packaged)}, or the path of a TOML file ({page}).",
            )
        data = path.read_bytes()
        text = decode_text(data, name)
        try:
            if len(data) > _MAX_BYTES:
                raise ValueError(f"{len(data)} bytes; expected at most {_MAX_BYTES}")
            return cls._of(tomllib.loads(text))
        except (ValueError, RecursionError) as error:
            raise FormatError(f"{name} is no prompt: {error}", f"See {page}.") from None

    @classmethod
    def _of(cls, values: Mapping[str, Any]) -> Self:
        known = {field.name: field for field in fields(cls)}
        for key, value in values.items():
            if key not in known:
                raise ValueError(f"it has {key!r}; expected {', '.join(known)}")
            if type(value) is not known[key].type:
                raise ValueError(f"{key} is {value!r}")
        required = [key for key, field in known.items() if field.default is MISSING]
        if missing := [key for key in required if key not in values]:
            raise ValueError(f"it lacks {', '.join(missing)}")
        return cls(**values)


def describe_prompted(model: ChatModel, prompt: Prompt) -> dict[str, Any]:
    """Return what identifies a model with a prompt, for `run.json`."""
    return {"model": model.metadata(), "prompt_sha256": prompt.sha256}


def prompted_identity(
    text: str, options: Sequence[str], described: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what of a model with a prompt can change an answer, from `describe_prompted`."""
    identity = model_identity(text, options, described["model"])
    return identity | {"prompt_sha256": described["prompt_sha256"]}
