"""The families file of a LeRobot dataset: CSV with the family of each episode, task or dataset."""

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import InterferenceError, SourceError
from robomme_interference_data.storage.text import read_text

from .goals import one_form

TASK = "task"
DATASET = "dataset"
EPISODE = "episode_index"

_EMPTY_ALLOWED = ("start", "stop")
_NUMBERS = ("episode_index", "index", "exec_start_idx", *_EMPTY_ALLOWED)
_COMMON = {"family", "split", "exec_start_idx"}
_KNOWN = {
    TASK: {TASK, *_COMMON},
    DATASET: {DATASET, *_COMMON},
    EPISODE: {EPISODE, *_COMMON, "index", "start", "stop"},
}
"""Columns of a file by its key, which says what has a line of its own."""
_FORM = (
    "Expected CSV with the first line task,family and a line for every task; or with the first "
    "line episode_index,family and a line such as 0,MoveCube for every episode. Further columns: "
    "split, exec_start_idx and, for episodes, index, start and stop."
)
_LISTED = 40
"""Most lines that an error offers to paste."""


def one_line(text: str) -> str:
    """Return a text as it is compared: in one Unicode form, with single spaces."""
    return " ".join(one_form(text).split())


def read_families(path: Path, tasks: Sequence[Sequence[str]], name: str) -> list[dict[str, Any]]:
    """Read the per-episode columns of a CSV file that lists episodes, tasks or datasets.

    Args:
        path: The file.
        tasks: The tasks of each episode of the dataset.
        name: The name of the dataset.

    Raises:
        SourceError: The file is invalid, or lacks a line: the hint has the missing ones.
    """
    try:
        header, rows = _read_rows(path, len(tasks))
    except InterferenceError:  # of the text, such as another encoding
        raise
    except OSError as error:
        hint = f"Give {TASK}, {DATASET} or the path of a CSV file. {_FORM}"
        raise SourceError(f"families file {path}: {error.strerror}", hint) from None
    except (ValueError, csv.Error) as error:
        raise SourceError(f"families file {path}: {error}", _FORM) from None
    wanted = _keys(header[0], tasks, name)
    names = dict.fromkeys(key for keys in wanted for key in keys)
    if missing := [key for key in names if key not in rows]:
        what = "episodes" if header[0] == EPISODE else f"{header[0]}s"
        raise SourceError(
            f"families file {path} names {len(names) - len(missing)} of {len(names)} {what}",
            f"Add these lines, with the names of families:\n{_lines(missing, header)}",
        )
    found = []
    for episode, keys in enumerate(wanted):
        first, *others = [rows[key] for key in keys] or [{}]
        if any(other != first for other in others):
            raise SourceError(
                f"families file {path}: the tasks of episode {episode} differ: "
                f"{', '.join(map(repr, keys))}",
                "Give them the same values, or write a line for every episode, with the column "
                "episode_index.",
            )
        found.append(first)
    return found


def template(tasks: Sequence[Sequence[str]]) -> str:
    """Return the text of a families file for episodes of these tasks, with names to fill in."""
    names = dict.fromkeys(one_line(text) for texts in tasks for text in texts)
    if names:
        return f"task,family\n{_lines([*names], [TASK, 'family'])}"
    return f"episode_index,family\n{_lines(range(len(tasks)), [EPISODE, 'family'])}"


def _keys(key: str, tasks: Sequence[Sequence[str]], name: str) -> list[list[Any]]:
    """Return, for each episode, the values of the key whose lines are its own."""
    if key == TASK:
        return [[one_line(text) for text in texts] for texts in tasks]
    if key == DATASET:
        return [[one_line(name)] for _ in tasks]
    return [[episode] for episode in range(len(tasks))]


def _read_rows(path: Path, count: int) -> tuple[list[str], dict[Any, dict[str, Any]]]:
    """Return the columns of a file, its key first, and its rows by that key."""
    lines = csv.reader(io.StringIO(read_text(path), newline=""))
    header = [name.strip() for name in next(lines, [])]
    keys = [name for name in _KNOWN if name in header]
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
        row: dict[str, Any] = dict(zip(header, map(one_line, cells), strict=True))
        for name in (column for column in _NUMBERS if column in row):
            row[name] = _number(where, name, row[name])
        name = row.pop(key)
        if name in rows:
            raise ValueError(f"{where} is a second line of {key} {name!r}")
        if key == EPISODE and name >= count:
            raise ValueError(f"{where}: the dataset has {count} episodes, no {name}")
        rows[name] = row
    return sorted(header, key=lambda name: name != key), rows


def _lines(names: Sequence[object], header: Sequence[str]) -> str:
    """Return lines of CSV for some values of the key, with the other columns to fill in."""
    # Not a name that a family may have: a line that is pasted as it is must be an error.
    text = _csv([name, *(f"<{column}>" for column in header[1:])] for name in names[:_LISTED])
    if len(names) > _LISTED:
        text += f"and {len(names) - _LISTED} more"
    return text.rstrip()


def _csv(rows: Iterable[Sequence[object]]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def _number(where: str, name: str, text: str) -> int | None:
    if not text and name in _EMPTY_ALLOWED:
        return None
    if name == "exec_start_idx" and not text:
        raise ValueError(
            f"{where}: exec_start_idx is empty; write the number of the first frame after the "
            "demonstration, or 0 if the episode has none"
        )
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise ValueError(f"{where}: {name} is {text[:80]!r}; expected a whole number")
    return int(text)
