"""The columns of rows that describe answers to questions, and calls of models."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any


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
