"""The row of a rollout: what identifies it, how it ended, and the columns of each feature."""

from dataclasses import dataclass

from robomme_interference_data.evaluate.language.columns import AnswerColumns, ModelColumns
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.retrieval.columns import RetrievalColumns
from robomme_interference_data.schema.rollouts import OutcomeColumns, RolloutKey, Timing
from robomme_interference_data.schema.sampling import HistoryColumns
from robomme_interference_data.simulators.measured import ActionErrorColumns


# A feature declares its columns in its own module and is one line here. A dataclass takes the
# fields of its last base first, so files have the columns of these lines from the last to first.
@dataclass(frozen=True, kw_only=True)
class Rollout(
    Timing,
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
