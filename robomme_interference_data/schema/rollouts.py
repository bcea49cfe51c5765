"""The core columns of a rollout's row, and the status of an episode.

`evaluate.run.row.Rollout` is the row: these columns and those of each feature.
"""

from dataclasses import dataclass, fields
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


def success_of(status: str) -> bool | None:
    """Return whether a final status is a success; None if it is neither success nor failure."""
    return None if status in (Status.ERROR, Status.MEASURED) else status == Status.SUCCESS


@dataclass(frozen=True, kw_only=True)
class RolloutKey:
    """The columns that identify a rollout: no two rows of a run agree in all of them."""

    system: Annotated[str, "Label of the system: a policy with its memory mechanism."]
    simulator: Annotated[
        str, "`tabletop`, `robomme`, …; `questions` for answers, `recordings` offline."
    ]
    buffer_set: Annotated[str, "Name of the buffer set."]
    revision: Annotated[str, "Identity of the buffer set, `BufferSet.revision`."]
    family: Annotated[str, "Task family of the query episode."]
    condition: Annotated[str, "`no-history`, `k0`, `k1`, …"]
    split: Annotated[str, "`train`, `val`, `test` or `heldout`."]
    episode: Annotated[int, "Index of the query episode."]
    shift: Annotated[str, "Difference of the live scene to the lesson's, `light:2`; or `none`."]
    training_seed: Annotated[
        int | None, "Seed of the training run that made the weights, or None if unknown."
    ] = None
    model_seed: Annotated[int, "Seed of the policy: a repeat with the same weights."]
    protocol_version: Annotated[int, "`PROTOCOL_VERSION` of the run."]

    def __post_init__(self) -> None:
        parse_shift(self.shift)

    @property
    def key(self) -> tuple[Any, ...]:
        """The values of `KEY_COLUMNS`."""
        return tuple(getattr(self, name) for name in KEY_COLUMNS)

    @property
    def episode_id(self) -> EpisodeId:
        """The query episode."""
        return EpisodeId(self.family, self.split, self.episode)


@dataclass(frozen=True, kw_only=True)
class OutcomeColumns:
    """How a rollout ended, and of which scene."""

    seed: Annotated[int | None, "Seed of the scene, or None."]
    difficulty: Annotated[str | None, "`easy`, `medium`, `hard`, or None."]
    goal: Annotated[str | None, "The goal that the policy received."]
    ability: Annotated[
        str | None,
        "What a query of a day needs of a memory, such as `update`; None for other queries.",
    ] = None
    status: Annotated[
        str, "`success`, `fail`, `timeout` (after 1300 steps), `error`, or offline `measured`."
    ]
    success: Annotated[
        bool | None, "Whether the status is `success`; None for `error` and `measured`."
    ]
    steps: Annotated[int, "Executed steps; offline, compared actions."]
    error: Annotated[str | None, "What failed, in one line; only if the status is `error`."] = None
    attempt: Annotated[int, "Number of attempts, this one included."] = 1
    repeated_because: Annotated[
        str | None, "What failed in the first attempt, in one line; None if it is this one."
    ] = None
    video: Annotated[str | None, "Path of its video inside the run's folder."] = None

    def __post_init__(self) -> None:
        if self.status not in FINAL:
            raise FormatError(f"status {self.status!r} is none of {', '.join(FINAL)}")
        expected = success_of(self.status)
        if self.success is not expected:
            raise FormatError(
                f"success {self.success} contradicts status {self.status!r}; expected {expected}"
            )
        if not 0 <= self.steps <= MAX_STEPS:
            raise FormatError(f"steps {self.steps}; expected 0 to {MAX_STEPS}")


@dataclass(frozen=True, kw_only=True)
class Timing:
    """After what a rollout ran, when it ended, and how long its parts took."""

    predecessor: Annotated[
        str | None,
        "The rollout that the policy played just before, such as `MoveCube/test/3 k7`; None if it "
        "was new. Of a shared policy or a server, the last one of this worker.",
    ] = None
    reset_s: Annotated[float | None, "Seconds to reset the simulator."] = None
    history_s: Annotated[float | None, "Seconds to decode and deliver the history."] = None
    policy_s: Annotated[float | None, "Seconds in the policy."] = None
    simulator_s: Annotated[float | None, "Seconds of stepping the simulator."] = None
    model_s: Annotated[float | None, "Seconds in the vision-language model."] = None
    wall_s: Annotated[float | None, "Seconds in total."] = None
    finished_at: Annotated[str | None, "End, in UTC, `2026-01-31T12:00:00Z`."] = None


KEY_COLUMNS = tuple(field.name for field in fields(RolloutKey))
"""Names of the columns that identify a rollout."""

TIMING_COLUMNS = tuple(field.name for field in fields(Timing))
"""Names of the only columns that differ between repetitions of a run."""
