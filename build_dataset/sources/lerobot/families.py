"""The family, split and index of each episode of a LeRobot dataset.

They are per-episode columns: of the dataset itself, of a families file, or made from tasks.
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from robomme_interference_data.constants import SPLITS
from robomme_interference_data.errors import InvalidIdError, SourceError, named
from robomme_interference_data.ids import EpisodeId

from ..robomme_families import BLOCKS
from .families_file import one_line
from .family_names import families_of

_BLOCK = 100
_RANGE = re.compile(r"(\d{1,9}):(\d{1,9})", re.ASCII)


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
            raise SourceError(
                f"{where}: episodes {other} and {episode} are both named {name}",
                "Give each a name of its own, for example in a CSV file: "
                f"{named('families_from', 'FILE.csv')}.",
            )
    return {episode: name for name, episode in ids.items()}


def families_by_task(tasks: Sequence[Sequence[str]], where: str) -> dict[str, str]:
    """Return the family of each task of the episodes; see `family_of`.

    Raises:
        SourceError: An episode has no task, or several of different families.
    """
    hint = f"Name the families in a CSV file: {named('families_from', 'FILE.csv')}."
    if without := [episode for episode, texts in enumerate(tasks) if not texts]:
        raise SourceError(
            f"{where}: {len(without)} of {len(tasks)} episodes have no task, the first of them "
            f"episode {without[0]}",
            hint,
        )
    families = families_of(dict.fromkeys(one_line(text) for texts in tasks for text in texts))
    for episode, texts in enumerate(tasks):
        if len({families[one_line(text)] for text in texts}) > 1:
            listed = ", ".join(map(repr, texts))
            raise SourceError(f"{where}: episode {episode} has several tasks: {listed}", hint)
    return families


def recorded_splits(given: Any, count: int, where: str) -> list[str]:
    """Return the split of each episode by `splits` of `info.json`, such as `{"train": "0:50"}`.

    Episodes that it does not list are `train`, as all are in datasets of LeRobot's recorder.

    Raises:
        SourceError: It lists episodes in another split, or in two.
    """
    splits: list[str | None] = [None] * count
    for name, text in given.items() if isinstance(given, dict) else ():
        match = _RANGE.fullmatch(text) if isinstance(text, str) else None
        numbers = range(int(match[1]), min(int(match[2]), count)) if match else range(0)
        if not numbers or name == "train":
            continue
        if name not in SPLITS or any(splits[number] is not None for number in numbers):
            raise SourceError(
                f"{where}: info.json has the split {name!r} of the episodes {text}; expected "
                f"{', '.join(SPLITS)}, none of them with an episode of another",
                f"Write the splits in a CSV file, {named('families_from', 'FILE.csv')}, with the "
                "columns episode_index, family and split.",
            )
        for number in numbers:
            splits[number] = name
    return [split or "train" for split in splits]
