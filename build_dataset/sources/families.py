"""The family, split and index of each episode of a LeRobot dataset.

They are per-episode columns: in the dataset itself, or in a CSV file beside it, with a line for
each episode or for each task.
"""

import csv
import io
import unicodedata
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import FAMILIES_PATH
from robomme_interference_data.errors import InvalidIdError, SourceError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.storage.files import atomic_path

from .robomme_families import BLOCKS

_BLOCK = 100
_KEYS = ("episode_index", "task")
_NUMBERS = ("episode_index", "index", "exec_start_idx")
_KNOWN = {
    "task": {"task", "family", "split", "exec_start_idx"},
    "episode_index": {"episode_index", "family", "split", "index", "exec_start_idx"},
}
"""Columns of a file by its first one, which says what has a line of its own."""
_FORM = (
    "Expected CSV with the first line task,family and a line for every task; or with the first "
    "line episode_index,family and a line such as 0,MoveCube for every episode. Further columns: "
    "split, exec_start_idx and, for episodes, index."
)
_LISTED = 40
"""Most lines that an error offers to paste."""


def ids_by_block() -> dict[int, EpisodeId]:
    """Name the episodes 0 to 1,599 by their block of 100."""
    return {
        _BLOCK * block + index: EpisodeId(family, "train", index)
        for block, family in enumerate(BLOCKS)
        for index in range(_BLOCK)
    }


def names_episodes(columns: Iterable[str]) -> bool:
    """Return whether per-episode columns name the episodes."""
    return bool({"episode_id", "family"} & {*columns})


def ids_by_columns(rows: Sequence[Mapping[str, Any]], where: str) -> dict[int, EpisodeId] | None:
    """Name the episodes by per-episode columns; None if the dataset has no such columns.

    The columns are `episode_id`, or `family` and, optionally, `split` and `index`. Without an
    index, the episodes of a family and split are counted.
    """
    if not rows or not names_episodes(rows[0]):
        return None
    ids: dict[EpisodeId, int] = {}
    counts: Counter[tuple[Any, str]] = Counter()
    for episode, values in enumerate(rows):
        try:
            if "episode_id" in values:
                name = EpisodeId.parse(values["episode_id"])
            else:
                family: Any = values.get("family")  # EpisodeId checks its type
                split, index = values.get("split") or "train", values.get("index")
                name = EpisodeId(family, split, 0)
                name = EpisodeId(family, split, counts[family, split] if index is None else index)
                counts[family, split] += 1
        except InvalidIdError as error:
            raise SourceError(f"{where}, episode {episode}: {error.message}", error.hint) from None
        other = ids.setdefault(name, episode)
        if other != episode:
            raise SourceError(f"{where}: episodes {other} and {episode} are both named {name}")
    return {episode: name for name, episode in ids.items()}


def read_families(path: Path, tasks: Sequence[Sequence[str]]) -> list[dict[str, Any]]:
    """Read the per-episode columns of a CSV file that lists a dataset's episodes, or its tasks.

    Args:
        path: The file.
        tasks: The tasks of each episode of the dataset.

    Raises:
        SourceError: The file is invalid, or lacks a line: the hint has the missing ones.
    """
    try:
        header, rows = _read_rows(path, len(tasks))
    except OSError as error:
        raise SourceError(f"families file {path}: {error.strerror}", _FORM) from None
    except (ValueError, csv.Error) as error:
        raise SourceError(f"families file {path}: {error}", _FORM) from None
    wanted: dict[int, list[Any]] = {episode: [episode] for episode in range(len(tasks))}
    if header[0] == "task":
        wanted = {episode: [*map(_one_line, texts)] for episode, texts in enumerate(tasks)}
    names = dict.fromkeys(name for keys in wanted.values() for name in keys)
    if missing := [name for name in names if name not in rows]:
        what = "tasks" if header[0] == "task" else "episodes"
        raise SourceError(
            f"families file {path} names {len(names) - len(missing)} of {len(names)} {what}",
            f"Add these lines, with the names of families:\n{_lines(missing, header)}",
        )
    found = []
    for episode, keys in wanted.items():
        first, *others = [rows[name] for name in keys] or [{}]
        if any(other != first for other in others):
            raise SourceError(
                f"families file {path}: the tasks of episode {episode} differ: "
                f"{', '.join(map(repr, keys))}",
                "Give them the same values, or write a line for every episode, with the column "
                "episode_index.",
            )
        found.append(first)
    return found


def keep_families(path: Path, root: Path) -> None:
    """Keep a families file in the folder of a buffer set, so that later builds need not name it."""
    data = path.read_bytes()
    with atomic_path(root / FAMILIES_PATH) as partial:
        partial.write_bytes(data)


def template(tasks: Sequence[Sequence[str]]) -> str:
    """Return the text of a families file for episodes of these tasks, with names to fill in."""
    names = dict.fromkeys(_one_line(text) for texts in tasks for text in texts)
    if names:
        return f"task,family\n{_lines([*names], ['task', 'family'])}"
    return f"episode_index,family\n{_lines(range(len(tasks)), ['episode_index', 'family'])}"


def _read_rows(path: Path, count: int) -> tuple[list[str], dict[Any, dict[str, Any]]]:
    """Return the columns of a file, its key first, and its rows by that key."""
    lines = csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig"), newline=""))
    header = [name.strip() for name in next(lines, [])]
    keys = [name for name in _KEYS if name in header]
    known = len(keys) == 1 and {*header} <= _KNOWN[keys[0]]
    if not known or len({*header}) != len(header) or "family" not in header:
        raise ValueError(f"its first line is {','.join(header)!r}")
    [key] = keys
    rows: dict[Any, dict[str, Any]] = {}
    for cells in lines:
        where = f"line {lines.line_num}"
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise ValueError(f"{where} has {len(cells)} values; expected {len(header)}")
        row: dict[str, Any] = dict(zip(header, map(_one_line, cells), strict=True))
        for name in (column for column in _NUMBERS if column in row):
            row[name] = _number(where, name, row[name])
        name = row.pop(key)
        if name in rows:
            raise ValueError(f"{where} is a second line of {key} {name!r}")
        if key == "episode_index" and name >= count:
            raise ValueError(f"{where}: the dataset has {count} episodes, no {name}")
        rows[name] = row
    return sorted(header, key=lambda name: name != key), rows


def _one_line(text: str) -> str:
    """Return a text in one line, and in one of Unicode's forms: "ö" may be one character or two."""
    return unicodedata.normalize("NFC", " ".join(text.split()))


def _lines(names: Sequence[object], header: Sequence[str]) -> str:
    """Return lines of CSV for some values of the key, with the other columns to fill in."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for name in names[:_LISTED]:
        # Not a name that a family may have: a line that is pasted as it is must be an error.
        writer.writerow([name, *(f"<{column}>" for column in header[1:])])
    if len(names) > _LISTED:
        text.write(f"and {len(names) - _LISTED} more")
    return text.getvalue().rstrip()


def _number(where: str, name: str, text: str) -> int:
    if name == "exec_start_idx" and not text:
        raise ValueError(
            f"{where}: exec_start_idx is empty; write the number of demonstration frames, or 0 if "
            "the episode has none"
        )
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise ValueError(f"{where}: {name} is {text[:80]!r}; expected a whole number")
    return int(text)
