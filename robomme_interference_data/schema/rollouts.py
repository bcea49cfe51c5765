"""How an episode stands, and what is written down of one that was rolled out."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId

from .shifts import parse_shift


class Status(StrEnum):
    """How an episode stands after a step.

    `error` means that something broke: such a rollout is no failure of the policy.
    """

    ONGOING = "ongoing"
    SUCCESS = "success"
    FAIL = "fail"
    TIMEOUT = "timeout"
    ERROR = "error"


FINAL = (Status.SUCCESS, Status.FAIL, Status.TIMEOUT, Status.ERROR)

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
"""What makes a rollout the one that it is: no two rows of a run agree in all of them."""

TIMING_COLUMNS = (
    *("reset_s", "history_s", "policy_s", "simulator_s", "model_s", "wall_s"),
    "finished_at",
)
"""Columns that differ from one run to the next; all others do not."""


@dataclass(frozen=True, slots=True)
class Rollout:
    """One rollout."""

    system: Annotated[str, "Name of the system: a policy together with its memory mechanism."]
    simulator: Annotated[
        str,
        "`tabletop` or `robomme`; `questions` where one was answered instead.",
    ]
    buffer_set: Annotated[str, "Name of the buffer set."]
    revision: Annotated[str, "Identity of that buffer set, `BufferSet.revision`."]
    family: Annotated[str, "Task family."]
    condition: Annotated[str, "`no-history`, `k0`, `k1`, …"]
    split: Annotated[str, "`train`, `val` or `test`."]
    episode: Annotated[int, "Index of the query episode."]
    shift: Annotated[
        str,
        "How the live scene differed from the lesson's, such as `light:2`; `none` if not.",
    ]
    model_seed: Annotated[int, "Seed that the policy was given."]
    protocol_version: Annotated[int, "`PROTOCOL_VERSION` of the run."]
    seed: Annotated[int | None, "Seed of the scene."]
    difficulty: Annotated[str | None, "`easy`, `medium` or `hard`; None if not known."]
    goal: Annotated[str | None, "The goal in words, as the policy got it."]
    status: Annotated[str, "`success`, `fail`, `timeout` (after 1300 steps) or `error`."]
    success: Annotated[
        bool | None,
        "Whether the status is `success`; None for an error, which is neither.",
    ]
    steps: Annotated[int, "Executed steps."]
    history_frames: Annotated[
        int,
        "Frames that the policy was given before the first live observation.",
    ]
    lesson_frames: Annotated[int, "Those of them that are of the lesson."]
    lesson_share: Annotated[
        float | None,
        "Share of lesson frames in an even 32-frame sample of what was given and the first "
        "live observation; None without history.",
    ]
    evidence_kept: Annotated[
        float | None,
        "Share of the lesson's evidence spans of which the system's memory holds a frame at "
        "the first step; None where the evidence or the memory's rule is unknown, and without"
        " a lesson.",
    ] = None
    retrieval_model: Annotated[
        str | None,
        "Encoder and rule of the retrieval step, or None.",
    ] = None
    retrieval_start: Annotated[
        int | None,
        "First frame in the buffer that was retrieved, or None.",
    ] = None
    retrieval_stop: Annotated[
        int | None,
        "Frame after the last one that was, or None; not all between need be.",
    ] = None
    retrieval_selected_lesson_fraction: Annotated[
        float | None,
        "Share of lesson frames in an even 32-frame sample of what was retrieved and the "
        "first live observation, as the released CSV has it.",
    ] = None
    retrieval_selected_filler_fraction: Annotated[
        float | None,
        "The same for frames of other sessions.",
    ] = None
    retrieval_selected_query_fraction: Annotated[
        float | None,
        "The same for the first live observation.",
    ] = None
    answer: Annotated[
        str | None,
        "Letter of the option that was chosen, of a question about the past; None for a "
        "rollout, and where no option was named.",
    ] = None
    chance: Annotated[
        float | None,
        "Share of right answers that drawing at random would have, of a question; None for a "
        "rollout.",
    ] = None
    model_calls: Annotated[
        int | None,
        "How often a vision-language model was asked, repetitions after faults among them; "
        "None without one.",
    ] = None
    model_tokens: Annotated[
        int | None,
        "Tokens of all questions and answers; None if it does not say.",
    ] = None
    model_faults: Annotated[int | None, "Its answers that could not be used."] = None
    error: Annotated[
        str | None,
        "What broke, in one line; None unless the status is `error`.",
    ] = None
    attempt: Annotated[int, "How often the rollout was started, this time included."] = 1
    video: Annotated[str | None, "Path of its video inside the run's folder, or None."] = None
    reset_s: Annotated[float | None, "Seconds to reset the simulator."] = None
    history_s: Annotated[
        float | None,
        "Seconds to hand the history over, and to wait for what is not decoded yet.",
    ] = None
    policy_s: Annotated[
        float | None,
        "Seconds that the policy took for actions and observations.",
    ] = None
    simulator_s: Annotated[float | None, "Seconds of stepping."] = None
    model_s: Annotated[float | None, "Seconds that the vision-language model took."] = None
    wall_s: Annotated[float | None, "Seconds in all."] = None
    finished_at: Annotated[str | None, "When it ended, UTC, `2026-01-31T12:00:00Z`."] = None

    def __post_init__(self) -> None:
        parse_shift(self.shift)
        if self.status not in FINAL:
            raise FormatError(f"status {self.status!r} is none of {', '.join(FINAL)}")
        expected = None if self.status == Status.ERROR else self.status == Status.SUCCESS
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
