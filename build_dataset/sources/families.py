"""The family, split and index of each episode of a LeRobot dataset.

They are per-episode columns: in the dataset itself, or in a CSV file beside it.
"""

import csv
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import InvalidIdError, SourceError
from robomme_interference_data.ids import EpisodeId

from .robomme_families import BLOCKS

_BLOCK = 100
_REQUIRED = {"episode_index", "family"}
_NUMBERS = ("episode_index", "index", "exec_start_idx")
_KNOWN = {*_REQUIRED, *_NUMBERS, "split"}
_FORM = (
    "Expected CSV with the first line episode_index,family and, optionally, split, index and "
    "exec_start_idx; then a line such as 0,MoveCube for every episode."
)


def ids_by_block() -> dict[int, EpisodeId]:
    """Name the episodes 0 to 1,599 by their block of 100."""
    return {
        _BLOCK * block + index: EpisodeId(family, "train", index)
        for block, family in enumerate(BLOCKS)
        for index in range(_BLOCK)
    }


def ids_by_columns(rows: Sequence[Mapping[str, Any]], where: str) -> dict[int, EpisodeId] | None:
    """Name the episodes by per-episode columns; None if the dataset has no such columns.

    The columns are `episode_id`, or `family` and, optionally, `split` and `index`. Without an
    index, the episodes of a family and split are counted.
    """
    if not rows or not {"episode_id", "family"} & set(rows[0]):
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


def read_families(path: Path, count: int) -> list[dict[str, Any]]:
    """Read the per-episode columns of a CSV file that lists all `count` episodes of a dataset."""
    try:
        lines = csv.reader(path.read_text(encoding="utf-8-sig").splitlines())
        header = [name.strip() for name in next(lines, [])]
        if len(set(header)) != len(header) or not _REQUIRED <= set(header) <= _KNOWN:
            raise ValueError(f"its first line is {','.join(header)!r}")
        rows: dict[int, dict[str, Any]] = {}
        for cells in lines:
            where = f"line {lines.line_num}"
            if not any(cell.strip() for cell in cells):
                continue
            if len(cells) != len(header):
                raise ValueError(f"{where} has {len(cells)} values; expected {len(header)}")
            row: dict[str, Any] = dict(zip(header, map(str.strip, cells), strict=True))
            for name in (column for column in _NUMBERS if column in row):
                row[name] = _number(where, name, row[name])
            episode = row.pop("episode_index")
            if episode in rows:
                raise ValueError(f"{where} is a second line of episode {episode}")
            if episode >= count:
                raise ValueError(f"{where}: the dataset has {count} episodes, no {episode}")
            rows[episode] = row
    except (OSError, ValueError, csv.Error) as error:
        raise SourceError(f"families file {path}: {error}", _FORM) from None
    if missing := [episode for episode in range(count) if episode not in rows]:
        raise SourceError(
            f"families file {path} names {len(rows)} of {count} episodes; missing: "
            f"{', '.join(map(str, missing[:5]))}",
            "Add a line for each of them.",
        )
    return [rows[episode] for episode in range(count)]


def _number(where: str, name: str, text: str) -> int:
    if name == "exec_start_idx" and not text:
        raise ValueError(
            f"{where}: exec_start_idx is empty; write the number of demonstration frames, or 0 if "
            "the episode has none"
        )
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise ValueError(f"{where}: {name} is {text[:80]!r}; expected a whole number")
    return int(text)
