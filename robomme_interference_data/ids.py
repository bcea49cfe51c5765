"""Episode ids and condition names: parse and format are inverses of each other."""

import re
from dataclasses import dataclass
from typing import Self

from robomme_interference_data.constants import FAMILIES, MAX_K, SPLITS
from robomme_interference_data.errors import InvalidIdError, nearest

__all__ = ["EpisodeId", "condition_name", "parse_condition"]

_FAMILY = re.compile(r"[A-Za-z][A-Za-z0-9_.-]*")
_INDEX = re.compile(r"0|[1-9][0-9]{0,17}")  # fits the int64 of the tables
_CONDITION = re.compile(r"k(0|[1-9][0-9]?)")
_FAMILY_RANK = {family: rank for rank, family in enumerate(FAMILIES)}


@dataclass(frozen=True)
class EpisodeId:
    """The name of an episode, `<Family>/<split>/<index>`, e.g. `VideoRepick/test/7`.

    Ids sort by family (the nine of the benchmark first, in the paper's order, then others by
    name), split and index as a number: the canonical order of everything that is written.

    Args:
        family: Task family: a letter, then letters, digits, `_`, `.` or `-`.
        split: `train`, `val` or `test`.
        index: Number of the episode within family and split, from 0.

    Raises:
        InvalidIdError: A part is not as described.
    """

    family: str
    split: str
    index: int

    def __post_init__(self) -> None:
        if not _FAMILY.fullmatch(self.family):
            raise InvalidIdError(
                f"{self.family!r} is not a family name",
                "A family is a letter followed by letters, digits, '_', '.' or '-', such as "
                "VideoRepick.",
            )
        if self.split not in SPLITS:
            raise InvalidIdError(
                f"{self.split!r} is not a split; expected one of {', '.join(SPLITS)}",
                nearest(self.split, SPLITS),
            )
        if not 0 <= self.index < 10**18:
            raise InvalidIdError(
                f"episode index {self.index} is out of range", "Indices count from 0."
            )

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read an id from text.

        Raises:
            InvalidIdError: The text is not `<Family>/<split>/<index>`.
        """
        parts = text.split("/")
        if len(parts) != 3 or not _INDEX.fullmatch(parts[2]):
            raise InvalidIdError(
                f"{text!r} is not an episode id",
                "Expected <Family>/<split>/<index>, for example VideoRepick/test/7.",
            )
        return cls(parts[0], parts[1], int(parts[2]))

    def __str__(self) -> str:
        return f"{self.family}/{self.split}/{self.index}"

    @property
    def sort_key(self) -> tuple[int, str, int, int]:
        """Key of the canonical order."""
        rank = _FAMILY_RANK.get(self.family, len(FAMILIES))
        return (rank, self.family, SPLITS.index(self.split), self.index)

    def __lt__(self, other: "EpisodeId") -> bool:
        return self.sort_key < other.sort_key


def condition_name(k: int) -> str:
    """Name of the condition with `k` distractor sessions: `k0`, `k1`, `k3`, `k7` and so on."""
    return f"k{k}"


def parse_condition(text: str) -> int:
    """Read `k` from a condition name; the inverse of `condition_name`.

    Raises:
        InvalidIdError: The text is not `k` followed by a number from 0 to 63.
    """
    match = _CONDITION.fullmatch(text)
    if not match or int(match[1]) > MAX_K:
        raise InvalidIdError(
            f"{text!r} is not a condition with history", f"Expected k0, k1, … k{MAX_K}."
        )
    return int(match[1])
