"""The policy `answers`, and the checked answers of a run of questions that it carries out."""

import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.csv as pa_csv
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_ROW_BYTES
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.questions import (
    NOT_SHOWN,
    Question,
    digest_questions,
    read_questions,
)
from robomme_interference_data.errors import (
    FormatError,
    InvalidOptionError,
    MissingFileError,
    RunError,
    first_line,
    named,
)
from robomme_interference_data.evaluate.run.config import AskConfig, RunConfig
from robomme_interference_data.evaluate.run.log import read_run
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.row import Rollout, is_done
from robomme_interference_data.schema.codec import arrow_schema, from_table
from robomme_interference_data.simulators.episode import Observation
from robomme_interference_data.storage.csv_text import unquoted_table
from robomme_interference_data.storage.files import sha256_file
from robomme_interference_data.storage.text import read_text

from .builtin import Noop, Privileged
from .policy import RolloutInfo

Answers = Mapping[WorkItem, int | None]
"""Number of the chosen option's answer in `Scene.answers`; None where nothing is to be done."""

_ASK = "Give the folder of a run of questions (ask), or a CSV file of its rows."


class ActOutAnswers(Privileged):
    """`answers`: the simulator's script carries out what a run of questions answered.

    It holds the first pose, as `noop` does, if the answer is that nothing was shown, and without a
    choice, which then never succeeds: see `chosen_answer`.

    Args:
        path: Folder of a run of questions, or a CSV file of its rows. Workers do not read it.
    """

    def __init__(self, path: str):
        super().__init__("answers")
        self._path = Path(path)

    def reset(self, info: RolloutInfo) -> None:
        """Keep the simulator and the answer."""
        super().reset(info)
        self._answer = info.answer

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Return the script's next action, `(1, 8) float32`; see `Privileged.act`."""
        if self._answer is None:
            return Noop().act(observation, goal)
        return self._running().act("answer", answer=self._answer)[None]

    def metadata(self) -> dict[str, Any]:
        """Return its name, and the identity of the answers."""
        return {"policy": self.name, "answers": answers_identity(self._path)}


def answers_identity(path: Path) -> dict[str, Any]:
    """Return what identifies answers: a run's own identity, or the SHA-256 of a CSV file."""
    if not path.is_dir():
        if not path.is_file():
            raise MissingFileError(f"there are no answers in {path}", _ASK)
        return {"sha256": sha256_file(path)}
    header, _ = read_run(path)
    _check_kind(path, {header.identity.get("simulator")})
    return header.identity


def read_answers(
    config: RunConfig, path: Path, buffer_set: BufferSet, items: Iterable[WorkItem]
) -> Answers:
    """Read the answers of planned rollouts; those whose question broke are left out.

    Args:
        config: Settings of the rollouts.
        path: Folder of a run of questions, or a CSV file of its rows.
        buffer_set: The buffer set of the rollouts.
        items: The rollouts.

    Raises:
        RunError, MissingFileError: `path` holds no answers.
        FormatError: The rows are damaged, or answer other questions.
        InvalidOptionError: A question was not asked, or the settings differ from the answers'.
    """
    questions, stated = read_questions(buffer_set), None
    if path.is_dir():
        header, rows = read_run(path)
        stated = header.identity.get("questions")
    else:
        rows = _read_csv(path)
    _check_kind(path, {row.simulator for row in rows.values()})
    if stated not in (None, digest_questions(questions.values())):
        raise _other_questions(path, buffer_set)
    for row in rows.values():
        # The same episode and condition have other questions in another buffer set.
        if row.revision != buffer_set.revision:
            raise _other_questions(path, buffer_set)
        for name in ("shift", "model_seed"):
            if getattr(row, name) != getattr(config, name):
                raise InvalidOptionError(
                    f"the answers in {path} have {name} {getattr(row, name)}, the rollouts "
                    f"{getattr(config, name)}",
                    f"Set {named(name)} to that of the answers.",
                )
    chosen = {}
    for item in items:
        if item not in rows:
            raise InvalidOptionError(
                f"{path} has no answer for {item}",
                "Ask these questions first, or leave out the episode or condition.",
            )
        if is_done(rows[item]):
            chosen[item] = chosen_answer(rows[item], questions[item.episode])
    return chosen


def chosen_answer(row: Rollout, question: Question) -> int | None:
    """Return the number of the answer that a row chose, or None if it is to do nothing.

    Without a choice that is nothing, too, but a wrong answer in days, where nothing may be right.

    Raises:
        FormatError: The row does not answer this question.
    """
    right = question.letters[question.right]
    letter = row.answer
    if row.success is not (letter == right) or letter not in (None, *question.letters):
        raise FormatError(
            f"the row of {WorkItem.of(row)}, {row.status} with the answer {letter}, does not "
            f"answer its question, whose options are {question.letters} and {right} is right",
            "Ask the questions of this buffer set again.",
        )
    if letter is not None:
        answer = question.answers[question.letters.index(letter)]
        return None if answer == NOT_SHOWN else answer
    if NOT_SHOWN not in question.answers:
        return None
    # To do nothing might be right, as no choice never is.
    wrong = (n for at, n in enumerate(question.answers) if at != question.right and n != NOT_SHOWN)
    return next(wrong)


def _read_csv(path: Path) -> dict[WorkItem, Rollout]:
    text = read_text(path, MAX_ROW_BYTES)
    # CSV states no types, and guessed ones depend on the values.
    options = pa_csv.ConvertOptions(column_types=arrow_schema(Rollout), strings_can_be_null=True)
    try:
        table = pa_csv.read_csv(io.BytesIO(text.encode()), convert_options=options)
    except pa.ArrowInvalid as error:
        raise FormatError(f"{path}: {first_line(error)}", _ASK) from None
    if len({*table.column_names}) < len(table.column_names):
        raise FormatError.damaged(path, "a column occurs twice")
    rows = [*from_table(Rollout, unquoted_table(table), path)]
    by_item = {WorkItem.of(row): row for row in rows}
    if len(by_item) < len(rows):
        raise FormatError.damaged(path, "a question has two answers")
    return by_item


def _check_kind(path: Path, simulators: set[Any]) -> None:
    # Runs of rollouts have the same files.
    if simulators - {AskConfig.simulator}:
        raise RunError(f"{path} holds rollouts, not answers to questions", _ASK)


def _other_questions(path: Path, buffer_set: BufferSet) -> FormatError:
    return FormatError(
        f"{path} answers other questions than those of {buffer_set.location}",
        "Ask the questions of this buffer set.",
    )
