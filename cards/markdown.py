"""Escape untrusted text for Markdown, as the Hub renders it."""

import re
import unicodedata
from typing import Any

from robomme_interference_data.viz.tables import Table

_MAX, _MAX_IN_BLOCK = 400, 20_000
"""Maximum length of a text, in characters."""

_ENTITIES = {"&": "&amp;", "<": "&lt;", ">": "&gt;", "|": "&#124;", "$": "&#36;"}
_SPECIAL = re.compile(r"[\\`*_\[\]~]")
_BEGINS = re.compile(r"^(?:[#+=-]|\d{1,9}(?=[.)]))")  # a heading, a list, a line under a heading
_LINK = re.compile(r"(?i)(?<=\w):(?=//)|(?<=www)\.|@")


class Raw(str):
    """Markdown that is not escaped."""

    __slots__ = ()


def escape(value: Any) -> Raw:
    """Return a value as literal text for Markdown, in one line; every value but `Raw` needs it."""
    if isinstance(value, Raw):
        return value
    text = _shortened(_one_line(str(value)))
    text = "".join(_ENTITIES.get(letter, letter) for letter in text)
    text = _SPECIAL.sub(r"\\\g<0>", text)
    text = _LINK.sub(lambda match: f"&#{ord(match[0])};", text)
    begin = _BEGINS.match(text)
    if begin is None:
        return Raw(text)
    first = begin[0]
    return Raw(f"&#{ord(first[0])};{text[1:]}")


def code(value: Any) -> Raw:
    """Return a value as inline code."""
    text = _shortened(_one_line(str(value)))
    if text.strip() == text and text and not re.search(r"[`|]", text):
        return Raw(f"`{text}`")
    # Escape what would end the code or the cell of a table.
    shown = "".join(_ENTITIES.get(letter, letter) for letter in text)
    return Raw(f"<code>{re.sub(_SPECIAL, lambda match: f'&#{ord(match[0])};', shown)}</code>")


def quoted(value: Any) -> Raw:
    """Return a text as a Python literal, for a block of code."""
    text = str(value)
    if re.fullmatch(r"[\w./-]*", text, re.ASCII):
        return Raw(f'"{text}"')
    return Raw(ascii(text).replace("`", "\\x60"))


def block(value: Any, language: str = "") -> Raw:
    """Return a text as a block of code."""
    kept = (letter if letter == "\n" or _shown(letter) else " " for letter in str(value))
    text = _shortened("".join(kept), _MAX_IN_BLOCK)
    fence = "`" * max(3, 1 + max(map(len, re.findall("`+", text)), default=0))
    return Raw(f"{fence}{language}\n{text.rstrip()}\n{fence}")


def table(value: Table) -> Raw:
    """Return a table without its title; its texts are already escaped."""
    return Raw(value.grid())


def _one_line(text: str) -> str:
    return " ".join("".join(letter if _shown(letter) else " " for letter in text).split())


def _shown(letter: str) -> bool:
    """Return whether a character is visible: no control, direction mark or surrogate."""
    return unicodedata.category(letter)[0] != "C"


def _shortened(text: str, most: int = _MAX) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"
