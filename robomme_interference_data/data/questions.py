"""Questions about the past: at most one per query of a buffer set, with a marked picture."""

import re
import shlex
import string
from collections.abc import Iterable
from dataclasses import dataclass
from hashlib import sha256
from typing import Annotated

from robomme_interference_data.constants import DEMONSTRATIONS, MANIFEST_PATH, QUESTIONS_PATH
from robomme_interference_data.errors import FormatError, MissingFileError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.codec import from_table, to_dict
from robomme_interference_data.schema.subgoal import Pixel
from robomme_interference_data.storage.files import sha256_file
from robomme_interference_data.storage.parquet import open_parquet, read_table
from robomme_interference_data.storage.text import digest_json

from .buffer_set import BufferSet

LETTERS = string.ascii_uppercase[:8]
"""Letters of options, in order."""

NOT_SHOWN = -1
"""Number in `Question.answers` of the option that it was not shown; only days have it."""


# Five digits: no image that can be read has as many pixels on a side.
_POINTS = re.compile(r"(?:-?\d{1,5},-?\d{1,5}(?: -?\d{1,5},-?\d{1,5})*)?")


@dataclass(frozen=True)
class Question:
    """A multiple-choice question about what a query's lesson showed."""

    episode_id: Annotated[EpisodeId, "The query episode."]
    revision: Annotated[str, "Revision of the demonstrations that it was made for."]
    text: Annotated[str, "The question, in addition to the goal."]
    options: Annotated[
        tuple[str, ...],
        "The options in words, in the order of `LETTERS`; empty where only the picture shows one.",
    ]
    answers: Annotated[
        tuple[int, ...],
        "Number of each option's answer among the scene's possible answers; -1 if the option is "
        "that it was not shown, the last one in days.",
    ]
    right: Annotated[int, "Index of the right option, from 0."]
    points: Annotated[
        tuple[str, ...],
        "Marked points of each option in the picture, `y,x` in pixels, separated by spaces; empty "
        "where only the words show it.",
    ]
    picture: Annotated[
        bytes, "The first live observation with marked and lettered options, a PNG file."
    ]

    def __post_init__(self) -> None:
        count = len(self.options)
        if not 2 <= count <= len(LETTERS) or len(set(self.answers)) != count:
            raise FormatError(f"{count} options with {len(set(self.answers))} different answers")
        if not 0 <= self.right < count or min(self.answers) < NOT_SHOWN:
            raise FormatError(f"right option {self.right} of {count}, answers {self.answers}")
        if len(self.points) != count or not all(map(_POINTS.fullmatch, self.points)):
            raise FormatError(f"{count} options with the points {self.points}")

    @property
    def pixels(self) -> tuple[tuple[Pixel, ...], ...]:
        """The marked points of each option: row and column, (y, x)."""
        return tuple(
            tuple((int(y), int(x)) for y, x in (point.split(",") for point in points.split()))
            for points in self.points
        )

    @property
    def letters(self) -> str:
        """Letters of the options, such as `ABCD`."""
        return LETTERS[: len(self.options)]

    @property
    def lines(self) -> tuple[str, ...]:
        """The options with their letters, such as `A: the red cube`."""
        return tuple(
            f"{letter}: {words or f'the one marked {letter}'}"
            for letter, words in zip(self.letters, self.options, strict=True)
        )

    @property
    def chance(self) -> float:
        """Expected share of right answers from random guesses."""
        return 1 / len(self.options)


def digest_questions(questions: Iterable[Question]) -> str:
    """Return the SHA-256 over all questions, answers and pictures."""
    ordered = sorted(questions, key=lambda question: question.episode_id)
    return digest_json(
        # JSON has no bytes, so the picture's digest stands for it.
        to_dict(question) | {"picture": sha256(question.picture).hexdigest()}
        for question in ordered
    )


def read_questions(buffer_set: BufferSet) -> dict[EpisodeId, Question]:
    """Read the questions of a buffer set, by query episode."""
    hint, command = "Only its publisher can make them again.", None
    recorded = buffer_set.datasets[DEMONSTRATIONS].records()
    if all(record.simulator is None for record in recorded):
        hint = "Questions need demonstrations of a simulator that lists the possible answers."
    elif buffer_set.is_own:
        hint, command = "", f"build {shlex.quote(buffer_set.location)} --only questions"
    try:
        path = buffer_set.files.path(QUESTIONS_PATH)
    except MissingFileError:
        if buffer_set.copy is not None and buffer_set.header.questions is not None:
            raise buffer_set.copy.not_fetched("the questions", "--questions") from None
        what = f"{buffer_set.location} has no questions ({QUESTIONS_PATH})"
        raise MissingFileError(what, hint, command) from None
    if sha256_file(path) != buffer_set.header.questions:
        raise FormatError(f"{path} does not have the SHA-256 in {MANIFEST_PATH}", hint, command)
    table = read_table(open_parquet(path), path)
    questions = {question.episode_id: question for question in from_table(Question, table, path)}
    revision = buffer_set.datasets[DEMONSTRATIONS].identity.revision
    if len(questions) != len(table):
        raise FormatError.damaged(path, "a query has two questions")
    if any(question.revision != revision for question in questions.values()):
        raise FormatError(f"{path} has questions for other demonstrations", hint, command)
    if lacking := sorted({*buffer_set.episode_ids} - questions.keys()):
        raise FormatError(f"{path} lacks the question of {lacking[0]}", hint, command)
    return questions
