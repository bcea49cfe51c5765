"""What the two kinds of work, rollouts and questions, do differently in a run."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import PROTOCOL_VERSION
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.runtime.executor import Session, Task
from robomme_interference_data.schema.rollouts import Rollout

from .config import AskConfig, RunConfig
from .plan import Plan, WorkItem


@dataclass(frozen=True)
class Job:
    """What a worker does next."""

    item: WorkItem
    metadata: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Run[C: RunConfig | AskConfig]:
    """A run whose settings were checked: what its workers need, and what all its rows share."""

    config: C
    system: str
    buffer_set: str
    revision: str

    def row(self, item: WorkItem, **values: Any) -> Rollout:
        """Return the row of a work item: `values`, and what identifies it."""
        return Rollout(
            system=self.system,
            simulator=self.config.simulator,
            buffer_set=self.buffer_set,
            revision=self.revision,
            family=item.episode.family,
            condition=item.condition,
            split=item.episode.split,
            episode=item.episode.index,
            shift=self.config.shift,
            model_seed=self.config.model_seed,
            protocol_version=PROTOCOL_VERSION,
            **values,
        )


def stored_count(count: int | None) -> int | None:
    """Return a count that a model reports; None for one that no file of a run can hold."""
    return count if count is not None and 0 <= count < 1 << 63 else None


class RunKind[C: RunConfig | AskConfig](ABC):
    """One kind of work: `evaluation.run_evaluation` calls its methods in their order here."""

    system: str
    metadata: dict[str, Any]
    versions: Mapping[str, str]

    def __init__(self, config: C, buffer_set: BufferSet):
        self.config, self.buffer_set = config, buffer_set
        self.metadata, self.versions = {}, {}

    def claim(self, folder: Path) -> AbstractContextManager[None]:
        """Keep other runs from what only one run may use, in the block."""
        return nullcontext()

    @abstractmethod
    def prepare(self) -> None:
        """Check the settings, and find out what is run."""

    @abstractmethod
    def refusal(self, condition: str) -> InterferenceError | None:
        """Return why a condition does not apply, or None."""

    @abstractmethod
    def check(self, plan: Plan, items: Sequence[WorkItem]) -> None:
        """Check what is planned."""

    @abstractmethod
    def task(self, run: Run[C]) -> Task:
        """Return what workers do with a `Job`: it returns a row, and a problem or None."""

    def needs_session(self, todo: Sequence[WorkItem]) -> bool:
        """Whether workers have to be asked for something."""
        return bool(todo)

    def open(self, session: Session, todo: Sequence[WorkItem]) -> None:
        """Check by a worker what it will use; what it opens stays open for its first job."""

    @abstractmethod
    def identity(self, plan: Plan) -> dict[str, Any]:
        """Return what can change a result, as plain values."""
