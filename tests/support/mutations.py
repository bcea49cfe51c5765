"""Change one value of one file of a buffer set, and recompute the checksums that cover it."""

import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from support.buffer_sets import renew_sums
from support.damage import HEADER, ROWS

from robomme_interference_data.constants import IDENTITY_PATH, QUESTIONS_PATH
from robomme_interference_data.storage.files import format_sums, sha256_file, write_json
from robomme_interference_data.storage.text import digest_json, read_json
from robomme_interference_data.storage.video.encode import decode_image, png

Place = tuple[str | int, ...]
"""Keys and positions that lead to a value; in a table they begin with the column."""


def places(path: Path) -> Iterator[Place]:
    """Yield the place of each value of a file: of a table, those of one row."""
    if path.suffix == ".json":
        yield from _leaves(read_json(path))
        return
    table = pq.read_table(path)
    for name in table.column_names:
        values = table[name].to_pylist()
        row = next((number for number, value in enumerate(values) if value not in (None, [])), 0)
        yield from ((name, row, *rest) for rest in _leaves(values[row]))


def _leaves(value: Any) -> Iterator[Place]:
    if isinstance(value, dict) and value:
        for key, one in value.items():
            yield from ((key, *rest) for rest in _leaves(one))
    elif isinstance(value, list) and value:  # the others are alike
        yield from ((0, *rest) for rest in _leaves(value[0]))
    elif not isinstance(value, list | dict):
        yield ()


def mutate(path: Path, place: Place) -> None:
    """Change the value at a place to another one of its type."""
    if path.suffix == ".json":
        write_json(path, _changed(read_json(path), place))
        return
    table, (name, row, *rest) = pq.read_table(path), place
    number, field = table.column_names.index(name), table.schema.field(name)
    values = table[name].to_pylist()
    if values[row] is None and pa.types.is_struct(field.type):  # it is written whole or not at all
        values = [{one.name: _changed(None, (), one.type) for one in field.type}] * len(values)
    else:
        values[row] = _changed(values[row], tuple(rest), field.type)
    pq.write_table(table.set_column(number, field, pa.array(values, field.type)), path)


def _changed(value: Any, place: Place, kind: pa.DataType | None = None) -> Any:
    if place:
        value = copy.copy(value)
        value[place[0]] = _changed(value[place[0]], place[1:])
        return value
    if value is None:
        return [] if kind is not None and pa.types.is_list(kind) else _OF_NONE.get(kind, "x")
    return _OTHER[type(value)](value)


def _other_text(text: str) -> str:
    """Another text; of a SHA-256 another one."""
    return ("0" if text[0] != "0" else "1") + text[1:] if len(text) == 64 else f"{text}x"


_OTHER: dict[type, Callable[[Any], Any]] = {
    bool: lambda value: not value,
    bytes: lambda value: png(decode_image(value)[::-1]),
    float: lambda value: value + 1,
    int: lambda value: value + 1,
    str: _other_text,
}
_OF_NONE = {pa.int64(): 1}


def renew(root: Path, relative: str) -> None:
    """Recompute every checksum of a buffer set that covers a file, from the file upward."""
    top, _, inside = relative.partition("/")
    header = read_json(root / HEADER)
    if "/index/" in relative:
        _renew_index((root / relative).parent, inside)
        return
    if relative == ROWS:
        header["rows"] = sha256_file(root / ROWS)
    elif relative == QUESTIONS_PATH:
        header["questions"] = sha256_file(root / QUESTIONS_PATH)
    elif relative != HEADER:
        if inside != IDENTITY_PATH:
            renew_sums(root / top)
        header["datasets"][top]["identity"] = sha256_file(root / top / IDENTITY_PATH)
    if relative != HEADER:
        write_json(root / HEADER, header)


def _renew_index(folder: Path, relative: str) -> None:
    path = folder / "index.json"
    header = json.loads(path.read_text())
    if not relative.endswith("index.json"):
        names = [
            line.split("  ", 1)[1] for line in (folder / "SHA256SUMS").read_text().splitlines()
        ]
        (folder / "SHA256SUMS").write_text(format_sums(folder, names))
        header["sums"] = sha256_file(folder / "SHA256SUMS")
    sums = {key: value for key, value in header.items() if key != "sha256"}
    write_json(path, {**header, "sha256": digest_json([sums])})
