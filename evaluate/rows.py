"""One row per rollout: what a run writes, and what scoring reads."""

from dataclasses import dataclass, fields
from typing import Any

import pyarrow as pa

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import FormatError, InvalidIdError
from robomme_interference_data.ids import parse_condition
from robomme_interference_data.simulators.base import Status

__all__ = [
    "FINAL_STATUSES",
    "KEY_COLUMNS",
    "NO_HISTORY",
    "PROTOCOL_VERSION",
    "ROLLOUT_SCHEMA",
    "TIMING_COLUMNS",
    "Rollout",
    "condition_rank",
]

PROTOCOL_VERSION = 1
"""Version of the rules by which a rollout is run; rows of different versions never mix."""

NO_HISTORY = "no-history"
"""The condition with an empty buffer; the others are `k0`, `k1`, …"""

FINAL_STATUSES = (Status.SUCCESS, Status.FAIL, Status.TIMEOUT, Status.ERROR)

KEY_COLUMNS = (
    "system",
    "simulator",
    "split",
    "revision",
    "family",
    "condition",
    "episode_split",
    "episode",
    "model_seed",
    "protocol_version",
)
"""What makes a rollout the one that it is: no two rows of a run agree in all of them."""

TIMING_COLUMNS = ("reset_s", "history_s", "policy_s", "simulator_s", "wall_s", "finished_at")
"""Columns that differ from one run to the next; all others do not."""


@dataclass(frozen=True)
class Rollout:
    """One rollout. `ROLLOUT_SCHEMA` has the columns in this order.

    Attributes:
        system: Name of the system: a policy together with its memory mechanism.
        simulator: `tabletop` or `robomme`.
        split: Name of the split of buffers.
        revision: Identity of that split, `Split.revision`.
        family: Task family.
        condition: `no-history`, `k0`, `k1`, …
        episode_split: `train`, `val` or `test`.
        episode: Index of the query episode.
        model_seed: Seed that the policy was given.
        protocol_version: `PROTOCOL_VERSION` of the run.
        seed: Seed of the scene.
        difficulty: `easy`, `medium` or `hard`; None if the simulator never said.
        goal: The goal in words, as the policy got it.
        status: `success`, `fail`, `timeout` (after 1300 steps) or `error`.
        success: Whether the status is `success`; None for an error, which is neither.
        steps: Executed steps.
        history_frames: Frames that the policy was given before the first live observation.
        lesson_frames: Those of them that are of the lesson.
        lesson_share: Share of lesson frames in an even 32-frame sample of the history and the
            first live observation (see `draw.lesson_share`); None without history.
        retrieval_model: Encoder and rule of the retrieval step, or None.
        retrieval_start: First frame in the buffer of the retrieved span, or None.
        retrieval_stop: Frame after its last one, or None.
        retrieval_selected_lesson_fraction: Share of lesson frames in an even 32-frame sample of
            the retrieved span and the first live observation, as the released CSV has it.
        retrieval_selected_filler_fraction: The same for frames of other sessions.
        retrieval_selected_query_fraction: The same for the first live observation.
        error: What broke, in one line; None unless the status is `error`.
        attempt: How often the rollout was started, this time included.
        video: Path of its video inside the run's folder, or None.
        reset_s: Seconds to reset the simulator.
        history_s: Seconds to hand the history over, and to wait for what is not decoded yet.
        policy_s: Seconds that the policy took for actions and observations.
        simulator_s: Seconds of stepping.
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
    retrieval_model: str | None = None
    retrieval_start: int | None = None
    retrieval_stop: int | None = None
    retrieval_selected_lesson_fraction: float | None = None
    retrieval_selected_filler_fraction: float | None = None
    retrieval_selected_query_fraction: float | None = None
    error: str | None = None
    attempt: int = 1
    video: str | None = None
    reset_s: float | None = None
    history_s: float | None = None
    policy_s: float | None = None
    simulator_s: float | None = None
    wall_s: float | None = None
    finished_at: str | None = None

    def __post_init__(self) -> None:
        condition_rank(self.condition)
        if self.status not in FINAL_STATUSES:
            raise FormatError(
                f"status {self.status!r} is none of {', '.join(FINAL_STATUSES)}",
            )
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

    def as_dict(self) -> dict[str, Any]:
        """Return the columns by name, in order."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def condition_rank(condition: str) -> int:
    """Return the place of a condition in tables: −1 for `no-history`, else its k.

    Raises:
        InvalidIdError: The text is no condition.
    """
    if condition == NO_HISTORY:
        return -1
    try:
        return parse_condition(condition)
    except InvalidIdError:
        raise InvalidIdError(
            f"{condition!r} is not a condition", "Expected no-history, k0, k1, … k63."
        ) from None


ROLLOUT_SCHEMA = pa.schema(
    [
        pa.field("system", pa.string(), nullable=False),
        pa.field("simulator", pa.string(), nullable=False),
        pa.field("split", pa.string(), nullable=False),
        pa.field("revision", pa.string(), nullable=False),
        pa.field("family", pa.string(), nullable=False),
        pa.field("condition", pa.string(), nullable=False),
        pa.field("episode_split", pa.string(), nullable=False),
        pa.field("episode", pa.int64(), nullable=False),
        pa.field("model_seed", pa.int64(), nullable=False),
        pa.field("protocol_version", pa.int32(), nullable=False),
        pa.field("seed", pa.int64()),
        pa.field("difficulty", pa.string()),
        pa.field("goal", pa.string()),
        pa.field("status", pa.string(), nullable=False),
        pa.field("success", pa.bool_()),
        pa.field("steps", pa.int32(), nullable=False),
        pa.field("history_frames", pa.int32(), nullable=False),
        pa.field("lesson_frames", pa.int32(), nullable=False),
        pa.field("lesson_share", pa.float64()),
        pa.field("retrieval_model", pa.string()),
        pa.field("retrieval_start", pa.int32()),
        pa.field("retrieval_stop", pa.int32()),
        pa.field("retrieval_selected_lesson_fraction", pa.float64()),
        pa.field("retrieval_selected_filler_fraction", pa.float64()),
        pa.field("retrieval_selected_query_fraction", pa.float64()),
        pa.field("error", pa.string()),
        pa.field("attempt", pa.int32(), nullable=False),
        pa.field("video", pa.string()),
        pa.field("reset_s", pa.float64()),
        pa.field("history_s", pa.float64()),
        pa.field("policy_s", pa.float64()),
        pa.field("simulator_s", pa.float64()),
        pa.field("wall_s", pa.float64()),
        pa.field("finished_at", pa.string()),
    ]
)
"""The columns of `rollouts.parquet`, and of `rollouts.csv` in the same order."""
