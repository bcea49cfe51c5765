"""The row of a rollout, its line in the record of a run, and the reader of a record."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from robomme_interference_data.constants import RUN_RECORD
from robomme_interference_data.errors import FormatError, first_line
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.schema.codec import from_dict, to_dict
from robomme_interference_data.schema.rollouts import OutcomeColumns, RolloutKey, Status, Timing
from robomme_interference_data.schema.sampling import HistoryColumns
from robomme_interference_data.storage.text import canonical_json, parse_json

from .plan import WorkItem
from .record import rows_that_count, whole_lines


@dataclass(frozen=True, kw_only=True)
class RetrievalColumns:
    """The frames that a retrieval step chose; all None without one, or without a history."""

    retrieval_start: Annotated[int | None, "First retrieved frame of the buffer."] = None
    retrieval_stop: Annotated[
        int | None, "Frame after the last retrieved one; frames between may be left out."
    ] = None
    retrieval_selected_lesson_fraction: Annotated[
        float | None,
        "Share of lesson frames in an even 32-frame sample of the retrieved frames and the first "
        "live observation, as in the released CSV.",
    ] = None
    retrieval_selected_filler_fraction: Annotated[
        float | None, "Share of frames of other sessions in that sample."
    ] = None
    retrieval_selected_query_fraction: Annotated[
        float | None, "Share of the first live observation in that sample."
    ] = None


@dataclass(frozen=True, kw_only=True)
class AnswerColumns:
    """An answer to a question; all None for a rollout."""

    answer: Annotated[
        str | None, "Letter of the chosen option; None for a rollout or without a choice."
    ] = None
    chance: Annotated[
        float | None, "Expected share of right answers from random guesses; None for a rollout."
    ] = None


@dataclass(frozen=True, kw_only=True)
class ModelColumns:
    """The calls of a vision-language model; all None without one. Their time is `model_s`."""

    model_calls: Annotated[
        int | None, "Calls of the vision-language model, with retries; None without a model."
    ] = None
    model_tokens: Annotated[int | None, "Tokens of all prompts and answers, if reported."] = None
    model_faults: Annotated[int | None, "Unusable answers of the model."] = None


@dataclass(frozen=True, kw_only=True)
class ActionErrorColumns:
    """The difference of a policy's actions to those of a recording; all None in a simulator."""

    action_l1: Annotated[
        float | None,
        "Offline: mean absolute difference of the actions to the recorded ones, over all steps and "
        "values, in the actions' units.",
    ] = None
    action_l1_values: Annotated[
        str | None, "The same for each value of the action, in their order, separated by spaces."
    ] = None


@dataclass(frozen=True, kw_only=True)
class TraceColumns:
    """What the policy did; None for a question."""

    actions_sha256: Annotated[
        str | None,
        "SHA-256 of all executed actions, offline of all compared ones, in order: float32, "
        "little-endian.",
    ] = None


# Each feature is one line here. A dataclass takes the fields of its last base first, so files have
# the columns of these lines from the last to first.
@dataclass(frozen=True, kw_only=True)
class Rollout(
    Timing,
    TraceColumns,
    ModelColumns,
    ActionErrorColumns,
    AnswerColumns,
    RetrievalColumns,
    HistoryColumns,
    OutcomeColumns,
    SystemFacts,
    RolloutKey,
):
    """One rollout, one answered question about the past, or one recording of an offline run."""

    def __post_init__(self) -> None:
        RolloutKey.__post_init__(self)
        OutcomeColumns.__post_init__(self)


def model_columns(calls: int, tokens: Sequence[int | None], faults: int) -> dict[str, Any]:
    """Return the columns about a vision-language model, given the tokens of each answer.

    A total that the files of a run cannot hold becomes None, and counts as a fault.
    """
    counts = [count for count in tokens if count is not None]
    total = sum(counts)
    stored = all(count >= 0 for count in counts) and total < 1 << 63
    return {
        "model_calls": calls,
        "model_tokens": total if counts and stored else None,
        "model_faults": faults + (not stored),
    }


def is_done(row: Rollout) -> bool:
    """Whether a rollout need not run again: all but errors."""
    return row.status != Status.ERROR


def row_of(line: bytes) -> Rollout:
    """Read a line of a record."""
    row = from_dict(Rollout, parse_json(line, "its text"), "its fields", strict=True)
    # Half of a surrogate pair is valid JSON, but no table or page can hold it: encoding raises.
    if b"\\u" in line:
        canonical_json(to_dict(row)).encode()
    return row


def row_line(row: Rollout) -> bytes:
    """Return a row's line in a record."""
    return (canonical_json(to_dict(row)) + "\n").encode()


def read_record(folder: Path) -> dict[WorkItem, Rollout]:
    """Read the row that counts of each rollout; none from a missing file.

    Raises:
        FormatError: A line is no row, or a rollout has a second row after a finished one.
    """
    path = folder / RUN_RECORD
    if not path.exists():
        return {}
    rows: list[Rollout] = []
    items: list[WorkItem] = []
    for number, line in enumerate(whole_lines(path).splitlines(), 1):
        try:
            row = row_of(line)
            item = WorkItem.of(row)
            if row.video not in (None, item.clip):  # a path that would be read and written
                raise ValueError(f"video {row.video!r}; expected {item.clip} or null")
        except ValueError as error:
            raise _bad_line(path, number, error) from None
        rows.append(row)
        items.append(item)
    counted: dict[WorkItem, Rollout] = {}
    for place in rows_that_count(items, [row.status for row in rows]):
        item = items[place]
        if item in counted:
            raise _bad_line(path, place + 1, ValueError(f"it is a second one of {item}"))
        counted[item] = rows[place]
    return counted


def _bad_line(path: Path, number: int, reason: ValueError) -> FormatError:
    return FormatError(
        f"{path}, line {number} is no row of a rollout: {first_line(reason)}",
        "Remove the line to run that rollout again.",
    )
