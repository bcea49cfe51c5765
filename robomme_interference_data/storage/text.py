"""Read text and JSON within bounds; write values as JSON text."""

import codecs
import hashlib
import json
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NoReturn

from robomme_interference_data.constants import FORMAT_VERSION
from robomme_interference_data.errors import FormatError, MissingFileError

_MAX_JSON_BYTES = 16 << 20
"""Our files have some thousand bytes, and Python takes forty times as many for some values."""

_MAX_TEXT_BYTES = 64 << 20
"""A CSV file with a line for each of half a million episodes."""

_POINTER = b"version https://git-lfs.github.com/spec/"
"""First bytes of the text that stands for a file which Git LFS has not downloaded."""

_MAX_DEPTH = 64
"""Nesting of JSON: Python can read more than it can always print, compare or write."""


_CORRECT = "Correct it, restore it from a copy, or download or build it again."
"""What to do about text that may have been edited."""


def check_not_pointer(path: Path) -> None:
    """Check that a file holds its content: a clone without Git LFS has short texts instead.

    Raises:
        MissingFileError: The file is a pointer of Git LFS.
    """
    with path.open("rb") as file:
        _check_start(path, file.read(len(_POINTER)))


def _check_start(path: Path, data: bytes) -> None:
    if data.startswith(_POINTER):
        clones = (folder for folder in path.resolve().parents if (folder / ".git").exists())
        raise MissingFileError(
            f"{path} is a Git LFS pointer, not the file",
            f"Install Git LFS, then run `git lfs pull` in {next(clones, path.parent)}",
        )


def read_text(path: Path, most: int = _MAX_TEXT_BYTES) -> str:
    """Read text that people or their programs wrote, of at most `most` bytes: see `decode_text`."""
    return decode_text(read_bytes(path, most), path)


def decode_text(data: bytes, where: object) -> str:
    """Decode text in UTF-8, or in UTF-16 or UTF-8 with the mark that programs of Windows write.

    Raises:
        FormatError: It has another encoding; nothing in the data tells which, so none is guessed.
    """
    first = [byte != 0 for byte in data[:2]]
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding, shown = "utf-16", "UTF-16"
    elif first in ([True, False], [False, True]):  # of two bytes for a letter, one is zero
        name = "UTF-16LE" if first[0] else "UTF-16BE"
        raise FormatError(
            f"{where} is not text in UTF-8, but in {name} without its mark",
            f"Save it as UTF-8, such as with iconv -f {name} -t UTF-8 OLD > NEW.",
        )
    else:
        encoding, shown = "utf-8-sig", "UTF-8"
    try:
        return data.decode(encoding)
    except UnicodeDecodeError as error:
        before = data[: error.start].decode(encoding).rpartition("\n")[2][-40:]
        place = f"after {before!r}" if before else "at the beginning of a line"
        raise FormatError(
            f"{where} is not text in {shown}: byte 0x{data[error.start]:02x} {place}",
            "Save it as UTF-8. Text in Latin-1 or Windows-1252 is converted by iconv "
            "-f WINDOWS-1252 -t UTF-8 OLD > NEW; a downloaded file may be damaged.",
        ) from None


def read_bytes(path: Path, most: int) -> bytes:
    """Return the bytes of a file that has at most `most`."""
    with path.open("rb") as file:
        # Of the open file: by now, another one may have the path.
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise FormatError(f"{path}: {size:,} bytes; expected at most {most:,}", _CORRECT)
        data = file.read()
    _check_start(path, data)  # not by opening it again: it may be a pipe
    return data


# --- JSON ----------------------------------------------------------------------------------------


def canonical_json(value: Any) -> str:
    """Return the one JSON text of a value: sorted keys, no spaces, UTF-8, no NaN."""
    # Any program can make the same text: no escapes but those that JSON requires.
    return json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )


def digest_json(values: Iterable[Any], end: str = "") -> str:
    """Return the SHA-256 over the canonical JSON of values in turn, `end` after each."""
    digest = hashlib.sha256()
    for value in values:
        # Half a surrogate pair, which a JSON file may hold, has no UTF-8.
        digest.update((canonical_json(value) + end).encode(errors="backslashreplace"))
    return digest.hexdigest()


def indented_json(value: Any) -> str:
    """Return the JSON text of a value for files: indented, with sorted keys, no NaN."""
    text = json.dumps(value, sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False)
    return text + "\n"


def read_json(path: Path, *, nan_as_none: bool = False) -> dict[str, Any]:
    """Read a JSON file that holds an object; see `parse_json`."""
    return parse_json(read_bytes(path, _MAX_JSON_BYTES), path, nan_as_none=nan_as_none)


def parse_json(data: bytes, where: object, *, nan_as_none: bool = False) -> dict[str, Any]:
    """Parse a JSON object, in which keys are unique and numbers are finite; see `decode_text`.

    With `nan_as_none`, for files of other programs, NaN and infinities are read as None: Python and
    pandas write NaN for values that are missing.
    """
    text = decode_text(data, where)
    decoder = _JSON_WITH_NAN if nan_as_none else _JSON
    try:
        value = decoder.decode(text)
        # The number of brackets bounds the depth, and is quickly counted.
        if data.count(b"[") + data.count(b"{") > _MAX_DEPTH and _is_deep(value):
            raise ValueError(f"over {_MAX_DEPTH} nested arrays and objects")
    except (ValueError, RecursionError) as error:
        raise FormatError(f"{where}: not valid JSON: {error}", _CORRECT) from None
    if not isinstance(value, dict):
        raise FormatError(f"{where}: not a JSON object", _CORRECT)
    return value


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _not_finite(text)


def _not_finite(text: str) -> NoReturn:
    raise ValueError(f"{text[:80]} is not a finite number")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value = dict(pairs)
    # Of two equal keys, readers take different ones: what one checks, another does not use.
    if len(value) < len(pairs):
        names = [name for name, _ in pairs]
        duplicate = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"the key {duplicate[:80]!r} occurs twice")
    return value


_JSON = json.JSONDecoder(object_pairs_hook=_unique, parse_float=_finite, parse_constant=_not_finite)
_JSON_WITH_NAN = json.JSONDecoder(
    object_pairs_hook=_unique, parse_float=_finite, parse_constant=lambda text: None
)


def _is_deep(value: Any) -> bool:
    level = [value]
    for _ in range(_MAX_DEPTH):
        level = [
            inner
            for outer in level
            for inner in (outer.values() if isinstance(outer, dict) else outer)
            if isinstance(inner, dict | list)
        ]
    return bool(level)


def read_header[T](path: Path, record: type[T]) -> T:
    """Read the JSON header of a folder as a record with the current `format_version`, if any."""
    from robomme_interference_data.schema.codec import descriptions, from_dict

    value = read_json(path)
    if "format_version" in descriptions(record):
        version = value.get("format_version")
        if version != FORMAT_VERSION:
            raise FormatError(
                f"{path} has format version {version!r}; this package reads {FORMAT_VERSION}",
                "Install the version of robomme-interference-data that wrote it, or build it "
                "again.",
            )
    return from_dict(record, value, path, strict=True)
