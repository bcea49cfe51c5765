"""The row that describes one rollout, and the status of an episode."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId

from .shifts import parse_shift


class Status(StrEnum):
    """Status of an episode after a step.

    `error` does not count as a failure of the policy. `measured` is the end of a recording, along
    which nothing succeeds or fails.
    """

    ONGOING = "ongoing"
    SUCCESS = "success"
    FAIL = "fail"
    TIMEOUT = "timeout"
    ERROR = "error"
    MEASURED = "measured"


FINAL = (Status.SUCCESS, Status.FAIL, Status.TIMEOUT, Status.ERROR, Status.MEASURED)

KEY_COLUMNS = (
    "system",
    "simulator",
    "buffer_set",
    "revision",
    "family",
    "condition",
    "split",
    "episode",
    "shift",
    "model_seed",
    "protocol_version",
)
"""Columns that identify a rollout: no two rows of a run agree in all of them."""

TIMING_COLUMNS = (
    "reset_s",
    "history_s",
    "policy_s",
    "simulator_s",
    "model_s",
    "wall_s",
    "finished_at",
)
"""The only columns that differ between repetitions of a run."""


def success_of(status: str) -> bool | None:
    """Return whether a final status is a success; None if it is neither success nor failure."""
    return None if status in (Status.ERROR, Status.MEASURED) else status == Status.SUCCESS


@dataclass(frozen=True, slots=True)
class Rollout:
    """One rollout, one answered question about the past, or one recording of an offline run."""

    system: Annotated[str, "Label of the system: a policy with its memory mechanism."]
    simulator: Annotated[
        str, "`tabletop`, `robomme`, …; `questions` for answers, `recordings` offline."
    ]
    buffer_set: Annotated[str, "Name of the buffer set."]
    revision: Annotated[str, "Identity of the buffer set, `BufferSet.revision`."]
    family: Annotated[str, "Task family of the query episode."]
    condition: Annotated[str, "`no-history`, `k0`, `k1`, …"]
    split: Annotated[str, "`train`, `val` or `test`."]
    episode: Annotated[int, "Index of the query episode."]
    shift: Annotated[str, "Difference of the live scene to the lesson's, `light:2`; or `none`."]
    model_seed: Annotated[int, "Seed of the policy."]
    protocol_version: Annotated[int, "`PROTOCOL_VERSION` of the run."]
    seed: Annotated[int | None, "Seed of the scene, or None."]
    difficulty: Annotated[str | None, "`easy`, `medium`, `hard`, or None."]
    goal: Annotated[str | None, "The goal that the policy received."]
    status: Annotated[
        str, "`success`, `fail`, `timeout` (after 1300 steps), `error`, or offline `measured`."
    ]
    success: Annotated[
        bool | None, "Whether the status is `success`; None for `error` and `measured`."
    ]
    steps: Annotated[int, "Executed steps; offline, compared actions."]
    history_frames: Annotated[int, "History frames that the policy received."]
    lesson_frames: Annotated[int, "Lesson frames among them."]
    lesson_share: Annotated[
        float | None,
        "Share of lesson frames in an even 32-frame sample of the received history and the first "
        "live observation; None without history.",
    ]
    evidence_kept: Annotated[
        float | None,
        "Share of the lesson's evidence spans with a frame in the system's memory at the first "
        "step; None if unknown or without a lesson.",
    ] = None
    retrieval_model: Annotated[str | None, "Encoder and rule of the retrieval step."] = None
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
    answer: Annotated[
        str | None, "Letter of the chosen option; None for a rollout or without a choice."
    ] = None
    chance: Annotated[
        float | None, "Expected share of right answers from random guesses; None for a rollout."
    ] = None
    action_l1: Annotated[
        float | None,
        "Offline: mean absolute difference of the actions to the recorded ones, over all steps and "
        "values, in the actions' units.",
    ] = None
    action_l1_values: Annotated[
        str | None, "The same for each value of the action, in their order, separated by spaces."
    ] = None
    model_calls: Annotated[
        int | None, "Calls of the vision-language model, with retries; None without a model."
    ] = None
    model_tokens: Annotated[int | None, "Tokens of all prompts and answers, if reported."] = None
    model_faults: Annotated[int | None, "Unusable answers of the model."] = None
    error: Annotated[str | None, "What failed, in one line; only if the status is `error`."] = None
    attempt: Annotated[int, "Number of attempts, this one included."] = 1
    video: Annotated[str | None, "Path of its video inside the run's folder."] = None
    reset_s: Annotated[float | None, "Seconds to reset the simulator."] = None
    history_s: Annotated[float | None, "Seconds to decode and deliver the history."] = None
    policy_s: Annotated[float | None, "Seconds in the policy."] = None
    simulator_s: Annotated[float | None, "Seconds of stepping the simulator."] = None
    model_s: Annotated[float | None, "Seconds in the vision-language model."] = None
    wall_s: Annotated[float | None, "Seconds in total."] = None
    finished_at: Annotated[str | None, "End, in UTC, `2026-01-31T12:00:00Z`."] = None

    def __post_init__(self) -> None:
        parse_shift(self.shift)
        if self.status not in FINAL:
            raise FormatError(f"status {self.status!r} is none of {', '.join(FINAL)}")
        expected = success_of(self.status)
        if self.success is not expected:
            raise FormatError(
                f"success {self.success} contradicts status {self.status!r}; expected {expected}"
            )
        if not 0 <= self.steps <= MAX_STEPS:
            raise FormatError(f"steps {self.steps}; expected 0 to {MAX_STEPS}")

    @property
    def key(self) -> tuple[Any, ...]:
        """The values of `KEY_COLUMNS`."""
        return tuple(getattr(self, name) for name in KEY_COLUMNS)

    @property
    def episode_id(self) -> EpisodeId:
        """The query episode."""
        return EpisodeId(self.family, self.split, self.episode)
