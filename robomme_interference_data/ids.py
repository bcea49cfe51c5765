"""Parse and format episode ids and lists of episode numbers."""

import operator
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

from robomme_interference_data.constants import ABILITIES, DIFFICULTIES, FAMILIES, SPLITS
from robomme_interference_data.errors import InvalidIdError, InvalidOptionError, nearest

_FAMILY = re.compile(r"[A-Za-z][A-Za-z0-9_.-]*")
_INDEX = re.compile(r"0|[1-9][0-9]{0,17}")  # fits the int64 of the tables
_START = re.compile(r"[1-9][0-9]{0,17}")
_SPAN = re.compile(r"(\d{1,9})(?:-(\d{1,9}))?")
_MAX_NUMBERS = 1_000_000
_FAMILY_RANK = {family: rank for rank, family in enumerate(FAMILIES)}
_RESERVED = (*DIFFICULTIES, *ABILITIES, "all")
"""What tables call other parts of the episodes."""


def family_order(family: str) -> tuple[int, str]:
    """Return the key of the canonical order of families: the paper's, then others by name."""
    return (_FAMILY_RANK.get(family, len(FAMILIES)), family)


@dataclass(frozen=True)
class EpisodeId:
    """The name of an episode, `<Family>/<split>/<index>`, e.g. `VideoRepick/test/7`.

    A fourth part, as in `VideoRepick/test/7/2`, denotes a contradicting lesson: the same scene
    played with answer 2. A start, as in `VideoRepick/train/7@1000`, denotes a distractor unit that
    begins at raw frame 1000 of the episode; one that begins at frame 0 has the episode's id.

    Ids sort by family (see `family_order`), split, index, answer and start. This is the canonical
    order of all stored data.

    Args:
        family: Task family: a letter, then letters, digits, `_`, `.` or `-`; not `all`, a
            difficulty or an ability.
        split: `train`, `val`, `test` or `heldout`.
        index: Number of the episode within family and split, from 0.
        answer: Number of the played answer, from 0; None for the scene's correct answer.
        start: First raw frame of a distractor unit in the episode, from 0.

    Raises:
        InvalidIdError: A part is invalid.
    """

    family: str
    split: str
    index: int
    answer: int | None = None
    start: int = 0

    def __post_init__(self) -> None:
        if not isinstance(self.family, str) or not _FAMILY.fullmatch(self.family):
            raise InvalidIdError(
                f"{self.family!r} is not a family name",
                "Expected a letter, then letters, digits, '_', '.' or '-', such as VideoRepick.",
            )
        if self.family in _RESERVED:
            raise InvalidIdError(
                f"{self.family!r} is not a family name: tables have other rows of this name",
                f"Use another one than {', '.join(_RESERVED)}.",
            )
        if self.split not in SPLITS:
            raise InvalidIdError(
                f"{self.split!r} is not a split; expected one of {', '.join(SPLITS)}",
                nearest(str(self.split), SPLITS),
            )
        answer = 0 if self.answer is None else self.answer
        numbers = {"episode index": self.index, "answer": answer, "start": self.start}
        for what, number in numbers.items():
            if type(number) is not int or not 0 <= number < 10**18:
                raise InvalidIdError(f"{what} {number!r} is invalid", "Expected an integer from 0.")
        if self.start and self.answer is not None:
            raise InvalidIdError(
                f"{self}: a contradicting lesson has no start", "Only distractor units have one."
            )

    @classmethod
    def parse(cls, text: "str | EpisodeId") -> Self:
        """Parse an id from text; an id is returned unchanged.

        Raises:
            InvalidIdError: The text is not `<Family>/<split>/<index>`.
        """
        if isinstance(text, cls):
            return text
        name, at, start = text.partition("@") if isinstance(text, str) else ("", "", "")
        parts = name.split("/")
        numbers = len(parts) in (3, 4) and all(map(_INDEX.fullmatch, parts[2:]))
        if not numbers or (at and not _START.fullmatch(start)):
            raise InvalidIdError(
                f"{text!r} is not an episode id",
                "Expected <Family>/<split>/<index>, for example VideoRepick/test/7.",
            )
        answer = int(parts[3]) if len(parts) == 4 else None
        return cls(parts[0], parts[1], int(parts[2]), answer, int(start or 0))

    def __str__(self) -> str:
        text = f"{self.family}/{self.split}/{self.index}"
        if self.answer is not None:
            text += f"/{self.answer}"
        return f"{text}@{self.start}" if self.start else text

    @property
    def scene(self) -> "EpisodeId":
        """Id of the recorded episode: the same scene with the correct answer, from its start."""
        return EpisodeId(self.family, self.split, self.index)

    @property
    def sort_key(self) -> tuple[int, str, int, int, int, int]:
        """Key of the canonical order."""
        answer = -1 if self.answer is None else self.answer
        split = SPLITS.index(self.split)
        return (*family_order(self.family), split, self.index, answer, self.start)

    def __lt__(self, other: "EpisodeId") -> bool:
        return self.sort_key < other.sort_key


def whole_number(option: str, given: Any, expected: str, least: int | None = None) -> int:
    """Return an integer argument, Python's or numpy's, but not a boolean; else raise an error.

    The error also has those below `least`.
    """
    try:
        if not isinstance(given, bool):
            number = operator.index(given)
            if least is None or number >= least:
                return number
    except TypeError:
        pass
    raise InvalidOptionError.expected(option, given, expected)


def parse_numbers(text: str) -> tuple[int, ...]:
    """Parse episode numbers such as `0-49` or `0,3,10-12`, ends included; ascending, each once."""
    return tuple(sorted({number for span in _spans(text) for number in span}))


def count_numbers(text: str) -> int:
    """Count the numbers in such a text without listing them; repeated numbers count repeatedly."""
    return sum(map(len, _spans(text)))


def nth_number(text: str, n: int) -> int | None:
    """Return the n-th number, from 0, of such a text without listing them; None if it has fewer."""
    for span in _spans(text):
        if n < len(span):
            return span[n]
        n -= len(span)
    return None


def _spans(text: str) -> list[range]:
    spans, count = [], 0
    for part in text.split(","):
        match = _SPAN.fullmatch(part.strip())
        where = "" if part == text else f" in {text!r}"
        if match is None:
            raise InvalidOptionError(
                f"{part.strip()!r}{where} is not an episode number or a range of them",
                "Expected numbers and ranges separated by commas, such as 0-49 or 0,3,10-12.",
            )
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first:
            raise InvalidOptionError(
                f"the range {part.strip()}{where} ends before it begins", f"Write {last}-{first}."
            )
        spans.append(range(first, last + 1))
        count += len(spans[-1])
        if count > _MAX_NUMBERS:
            raise InvalidOptionError(
                f"{text!r} asks for over {_MAX_NUMBERS:,} episodes",
                "Name those that exist, such as 0-49.",
            )
    return spans


def format_numbers(numbers: Iterable[int]) -> str:
    """Format ascending numbers for `parse_numbers`."""
    spans: list[list[int]] = []
    for number in numbers:
        if spans and spans[-1][1] == number - 1:
            spans[-1][1] = number
        else:
            spans.append([number, number])
    return ",".join(f"{a}-{b}" if a < b else str(a) for a, b in spans)
