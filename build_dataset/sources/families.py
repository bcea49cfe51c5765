"""Which family, split and index each episode of a LeRobot dataset has."""

import csv
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from robomme_interference_data.errors import InvalidIdError, SourceError
from robomme_interference_data.ids import EpisodeId

from .robomme_families import BLOCKS

_BLOCK = 100
_CSV = ("episode_index,family on the first line, and split and index if wanted", "0,MoveCube")
_JSON = ("one object, episode index to family", '{"0": "MoveCube", "1": "InsertPeg"}')


class _Told(NamedTuple):
    """What is said of an episode, where, and of which."""

    where: str
    episode: int
    values: Mapping[str, Any]


def ids_by_block() -> dict[int, EpisodeId]:
    """Name the episodes 0 to 1,599 by their block of 100."""
    return {
        _BLOCK * block + index: EpisodeId(family, "train", index)
        for block, family in enumerate(BLOCKS)
        for index in range(_BLOCK)
    }


def ids_by_columns(rows: Sequence[Mapping[str, Any]], place: str) -> dict[int, EpisodeId] | None:
    """Name the episodes by per-episode columns.

    Args:
        rows: Row of `meta/episodes` by episode index: `episode_id`, or `family` and, if there,
            `split` and `index` (a number).
        place: The dataset in words, for messages.

    Returns:
        Episode index to id, or None if the dataset has no such columns.
    """
    if not rows or not {"episode_id", "family"} & set(rows[0]):
        return None
    where = f"{place}: meta/episodes, episode"
    return _name(_Told(f"{where} {index}", index, row) for index, row in enumerate(rows))


def ids_by_file(path: Path, count: int) -> dict[int, EpisodeId]:
    """Name the episodes by a families file; `docs/sources.md` describes it.

    Args:
        path: A `.json` file (episode index to family), or a CSV file with the columns
            `episode_index`, `family` and, optionally, `split` and `index`.
        count: Number of the dataset's episodes; all must be named.
    """
    read, (expected, example) = (_csv, _CSV) if path.suffix != ".json" else (_json, _JSON)
    try:
        told = list(read(path, path.read_text(encoding="utf-8-sig")))
    except SourceError:
        raise
    except (OSError, ValueError, csv.Error, RecursionError) as error:
        raise SourceError(
            f"families file {path} cannot be read: {error}",
            f"Expected {expected}. For example: {example}",
        ) from None
    seen: dict[int, str] = {}
    for where, episode, _ in told:
        if episode >= count:
            raise SourceError(f"{where}: the dataset has no episode {episode}; it has {count}")
        if episode in seen:
            raise SourceError(
                f"{where}: episode {episode} was named before, in {seen[episode]}",
                "Keep one of the two.",
            )
        seen[episode] = where
    missing = [episode for episode in range(count) if episode not in seen]
    if missing:
        first = ", ".join(map(str, missing[:5])) + (", …" if len(missing) > 5 else "")
        raise SourceError(
            f"{path} names {len(seen)} of {count} episodes; missing: {first}",
            "Add a line for each of them.",
        )
    return _name(sorted(told, key=lambda one: one.episode))


def _name(told: Iterable[_Told]) -> dict[int, EpisodeId]:
    """Make ids of what is said; without an index, the next one of its family and split."""
    ids: dict[int, EpisodeId] = {}
    places: dict[EpisodeId, str] = {}
    ranks: Counter[EpisodeId] = Counter()
    for where, episode, values in told:
        try:
            if "episode_id" in values:
                found = EpisodeId.parse(values["episode_id"])
            else:
                family: Any = values.get("family")  # ids check themselves, also what is no text
                first = EpisodeId(family, values.get("split") or "train", 0)
                index = values.get("index")
                index = ranks[first] if index is None else index
                found = EpisodeId(first.family, first.split, index)
                ranks[first] += 1
        except InvalidIdError as error:
            raise SourceError(f"{where}: {error.message}", error.hint) from None
        if found in places:
            raise SourceError(
                f"{where}: {found} is already the name of {places[found]}",
                "Every episode needs a name of its own.",
            )
        places[found] = where
        ids[episode] = found
    return ids


def _csv(path: Path, text: str) -> Iterator[_Told]:
    lines = csv.reader(text.splitlines())
    header = [name.strip() for name in next(lines, [])]
    needed, known = {"episode_index", "family"}, {"episode_index", "family", "split", "index"}
    if len(set(header)) != len(header) or not needed <= set(header) <= known:
        raise ValueError(f"its first line is {','.join(header)!r}")
    for cells in lines:
        where = f"{path}, line {lines.line_num}"
        if not any(cell.strip() for cell in cells):
            continue
        if len(cells) != len(header):
            raise SourceError(f"{where}: {len(cells)} values; the first line has {len(header)}")
        values: dict[str, Any] = dict(zip(header, map(str.strip, cells), strict=True))
        if "index" in values:
            values["index"] = _number(where, "index", values["index"])
        yield _Told(where, _number(where, "episode_index", values["episode_index"]), values)


def _json(path: Path, text: str) -> Iterator[_Told]:
    # As pairs, so that a key that comes twice is seen.
    pairs = json.loads(text, object_pairs_hook=tuple)
    if not isinstance(pairs, tuple):
        raise ValueError("it holds no JSON object")
    for key, family in pairs:
        where = f"{path}, key {key!r}"
        yield _Told(where, _number(where, "episode_index", key), {"family": family})


def _number(where: str, name: str, text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        raise SourceError(f"{where}: {name} is {text!r}; expected a number from 0 on")
    return int(text)
