"""How an episode stands, and what is written down of one that was rolled out."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

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
    "split",
    "revision",
    "family",
    "condition",
    "episode_split",
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
    """One rollout.

    Attributes:
        system: Name of the system: a policy together with its memory mechanism.
        simulator: `tabletop` or `robomme`; `questions` where one was answered instead.
        split: Name of the split of buffers.
        revision: Identity of that split, `Split.revision`.
        family: Task family.
        condition: `no-history`, `k0`, `k1`, …
        episode_split: `train`, `val` or `test`.
        episode: Index of the query episode.
        shift: How the live scene differed from the lesson's, such as `light:2`; `none` if not.
        model_seed: Seed that the policy was given.
        protocol_version: `PROTOCOL_VERSION` of the run.
        seed: Seed of the scene.
        difficulty: `easy`, `medium` or `hard`; None if not known.
        goal: The goal in words, as the policy got it.
        status: `success`, `fail`, `timeout` (after 1300 steps) or `error`.
        success: Whether the status is `success`; None for an error, which is neither.
        steps: Executed steps.
        history_frames: Frames that the policy was given before the first live observation.
        lesson_frames: Those of them that are of the lesson.
        lesson_share: Share of lesson frames in an even 32-frame sample of what was given and the
            first live observation (see `sampling.lesson_share`); None without history.
        evidence_kept: Share of the lesson's evidence spans of which the system's memory holds a
            frame at the first step (see `sampling.evidence_kept`); None where the evidence or the
            memory's rule is unknown, and without a lesson.
        retrieval_model: Encoder and rule of the retrieval step, or None.
        retrieval_start: First frame in the buffer that was retrieved, or None.
        retrieval_stop: Frame after the last one that was, or None; not all between need be.
        retrieval_selected_lesson_fraction: Share of lesson frames in an even 32-frame sample of
            what was retrieved and the first live observation, as the released CSV has it.
        retrieval_selected_filler_fraction: The same for frames of other sessions.
        retrieval_selected_query_fraction: The same for the first live observation.
        answer: Letter of the option that was chosen, of a question about the past; None for a
            rollout, and where no option was named.
        chance: Share of right answers that drawing at random would have, of a question; None for
            a rollout.
        model_calls: How often a vision-language model was asked, repetitions after faults among
            them; None without one.
        model_tokens: Tokens of all questions and answers; None if it does not say.
        model_faults: Its answers that could not be used.
        error: What broke, in one line; None unless the status is `error`.
        attempt: How often the rollout was started, this time included.
        video: Path of its video inside the run's folder, or None.
        reset_s: Seconds to reset the simulator.
        history_s: Seconds to hand the history over, and to wait for what is not decoded yet.
        policy_s: Seconds that the policy took for actions and observations.
        simulator_s: Seconds of stepping.
        model_s: Seconds that the vision-language model took.
        wall_s: Seconds in all.
        finished_at: When it ended, UTC, `2026-01-31T12:00:00Z`.
    """

    system: str
    simulator: str
    split: str
    revision: str
    family: str
    condition: str
    episode_split: str
    episode: int
    shift: str
    model_seed: int
    protocol_version: int
    seed: int | None
    difficulty: str | None
    goal: str | None
    status: str
    success: bool | None
    steps: int
    history_frames: int
    lesson_frames: int
    lesson_share: float | None
    evidence_kept: float | None = None
    retrieval_model: str | None = None
    retrieval_start: int | None = None
    retrieval_stop: int | None = None
    retrieval_selected_lesson_fraction: float | None = None
    retrieval_selected_filler_fraction: float | None = None
    retrieval_selected_query_fraction: float | None = None
    answer: str | None = None
    chance: float | None = None
    model_calls: int | None = None
    model_tokens: int | None = None
    model_faults: int | None = None
    error: str | None = None
    attempt: int = 1
    video: str | None = None
    reset_s: float | None = None
    history_s: float | None = None
    policy_s: float | None = None
    simulator_s: float | None = None
    model_s: float | None = None
    wall_s: float | None = None
    finished_at: str | None = None

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
        return EpisodeId(self.family, self.episode_split, self.episode)
