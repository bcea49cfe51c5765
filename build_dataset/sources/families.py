"""Which family, split and index each episode of a LeRobot dataset has."""

import csv
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import InvalidIdError, SourceError, nearest
from robomme_interference_data.ids import EpisodeId

__all__ = ["BLOCK_EPISODES", "BLOCK_FAMILIES", "ids_by_block", "ids_by_columns", "ids_by_file"]

BLOCK_FAMILIES = (
    "PatternLock",
    "ButtonUnmaskSwap",
    "ButtonUnmask",
    "VideoPlaceButton",
    "VideoUnmaskSwap",
    "PickXtimes",
    "StopCube",
    "SwingXtimes",
    "PickHighlight",
    "MoveCube",
    "InsertPeg",
    "RouteStick",
    "BinFill",
    "VideoPlaceOrder",
    "VideoRepick",
    "VideoUnmask",
)
"""Families of RoboMME's LeRobot datasets, which have no family column: 100 episodes of each, in
this order (`lerobot/robomme`, `Yinpei/robomme_data_lerobot`)."""

BLOCK_EPISODES = 100

_COLUMNS = ("episode_index", "family", "split", "index")
_EXAMPLE = "For example: episode_index,family on the first line, then 0,MoveCube and so on."


def ids_by_block(episodes: Sequence[int], split: str) -> dict[int, EpisodeId]:
    """Name the episodes 0 to 1,599 by their block of 100."""
    return {
        episode: EpisodeId(
            BLOCK_FAMILIES[episode // BLOCK_EPISODES], split, episode % BLOCK_EPISODES
        )
        for episode in episodes
    }


def ids_by_columns(
    rows: Mapping[int, Mapping[str, Any]], split: str, place: str
) -> dict[int, EpisodeId] | None:
    """Name the episodes by per-episode columns.

    Args:
        rows: Episode index to its row of `meta/episodes`: `episode_id`, or `family` and, if
            there, `split` and `source_episode` (a number).
        split: Split of episodes without one.
        place: The dataset in words, for messages.

    Returns:
        Episode index to id, or None if the dataset has no such columns.

    Raises:
        SourceError: A value is not valid, or two episodes have the same id.
    """
    if not all("episode_id" in row or "family" in row for row in rows.values()):
        return None
    wanted = []
    for episode, row in rows.items():
        where = f"{place}: meta/episodes, episode {episode}"
        if "episode_id" in row:
            try:
                found = EpisodeId.parse(str(row["episode_id"]))
            except InvalidIdError as error:
                raise SourceError(f"{where}: {error.message}", error.hint) from None
            wanted.append(_Wanted(where, episode, found.family, found.split, found.index))
        else:
            number = row.get("index")
            if number is not None and not isinstance(number, int):
                raise SourceError(f"{where}: index is {number!r}; expected a number")
            wanted.append(
                _Wanted(where, episode, str(row["family"]), row.get("split") or split, number)
            )
    return _name(wanted)


def ids_by_file(path: Path, episodes: Sequence[int], split: str) -> dict[int, EpisodeId]:
    """Name the episodes by a families file; `docs/sources.md` describes it.

    Args:
        path: A `.json` file (episode index to family), or a CSV file with the columns
            `episode_index`, `family` and, optionally, `split` and `index`.
        episodes: Indices of the dataset's episodes; all must be named.
        split: Split of episodes without one.

    Raises:
        SourceError: The file cannot be read, or a line of it is wrong; says which.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"families file {path} cannot be read: {error}", _EXAMPLE) from None
    read = _read_json if path.suffix == ".json" else _read_csv
    wanted = read(path, text, split)
    seen: dict[int, str] = {}
    known = set(episodes)
    for row in wanted:
        if row.episode not in known:
            raise SourceError(
                f"{row.where}: the dataset has no episode {row.episode}; it has "
                f"{len(known)} episodes, {min(known)} to {max(known)}"
            )
        if row.episode in seen:
            raise SourceError(
                f"{row.where}: episode {row.episode} was named before, in {seen[row.episode]}",
                "Keep one of the two.",
            )
        seen[row.episode] = row.where
    missing = sorted(known - seen.keys())
    if missing:
        first = ", ".join(map(str, missing[:5])) + (", …" if len(missing) > 5 else "")
        raise SourceError(
            f"{path} names {len(seen)} of {len(known)} episodes; missing: {first}",
            "Add a line for each of them.",
        )
    return _name(sorted(wanted, key=lambda row: row.episode))


@dataclass(frozen=True)
class _Wanted:
    """What an episode is to be called; index None means the next free one of its family."""

    where: str
    episode: int
    family: str
    split: str
    index: int | None


def _name(wanted: Sequence[_Wanted]) -> dict[int, EpisodeId]:
    ids: dict[int, EpisodeId] = {}
    places: dict[EpisodeId, str] = {}
    ranks: Counter[tuple[str, str]] = Counter()
    for row in wanted:
        index = ranks[row.family, row.split] if row.index is None else row.index
        ranks[row.family, row.split] += 1
        try:
            found = EpisodeId(row.family, row.split, index)
        except InvalidIdError as error:
            raise SourceError(f"{row.where}: {error.message}", error.hint) from None
        if found in places:
            raise SourceError(
                f"{row.where}: {found} is already the name of {places[found]}",
                "Every episode needs a name of its own.",
            )
        places[found] = row.where
        ids[row.episode] = found
    return ids


def _read_csv(path: Path, text: str, split: str) -> list[_Wanted]:
    lines = csv.reader(text.splitlines())
    header = [name.strip() for name in next(lines, [])]
    for name in header:
        if name not in _COLUMNS:
            raise SourceError(
                f"{path}, line 1: unknown column {name!r}; expected episode_index,family and, if "
                "wanted, split and index",
                nearest(name, _COLUMNS),
            )
    doubled = [name for name, count in Counter(header).items() if count > 1]
    lacking = [name for name in _COLUMNS[:2] if name not in header]
    if doubled or lacking:
        problem = f"column {doubled[0]!r} comes twice" if doubled else f"no column {lacking[0]!r}"
        raise SourceError(f"{path}, line 1: {problem}", _EXAMPLE)
    wanted = []
    for cells in lines:
        where = f"{path}, line {lines.line_num}"
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise SourceError(f"{where}: {len(cells)} values; the first line has {len(header)}")
        row = {name: cell.strip() for name, cell in zip(header, cells, strict=True)}
        wanted.append(
            _Wanted(
                where,
                _number(where, "episode_index", row["episode_index"]),
                row["family"],
                row.get("split", split),
                _number(where, "index", row["index"]) if "index" in row else None,
            )
        )
    return wanted


def _read_json(path: Path, text: str, split: str) -> list[_Wanted]:
    try:
        # As pairs, so that a key that comes twice is seen.
        pairs = json.loads(text, object_pairs_hook=list)
    except ValueError as error:
        raise SourceError(f"{path} is not JSON: {error}") from None
    if not text.lstrip().startswith("{"):
        raise SourceError(
            f"{path} holds no JSON object",
            'Expected episode index to family: {"0": "MoveCube", "1": "InsertPeg"}',
        )
    wanted = []
    for key, family in pairs:
        where = f"{path}, key {key!r}"
        if not isinstance(family, str):
            raise SourceError(f"{where}: the family is {family!r}; expected text")
        wanted.append(_Wanted(where, _number(where, "episode_index", key), family, split, None))
    return wanted


def _number(where: str, name: str, text: str) -> int:
    if not text.isascii() or not text.isdigit():
        raise SourceError(f"{where}: {name} is {text!r}; expected a number from 0 on")
    return int(text)
