"""A run of rollouts or questions: what its workers do, and what differs between the two kinds."""

import platform
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robomme_interference_data.constants import DEMONSTRATIONS, PROTOCOL_VERSION
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.errors import (
    ServerDiedError,
    ServerKeepaliveError,
    SimulatorCrashError,
)
from robomme_interference_data.evaluate.policies.registry import policy_kind
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.retrieval.columns import retrieval_columns
from robomme_interference_data.runtime.executor import Worker, WorkerPool
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.rollouts import Status, success_of
from robomme_interference_data.schema.sampling import (
    Memory,
    evidence_kept,
    lesson_frames,
    lesson_share,
)
from robomme_interference_data.simulators.registry import simulator_class
from robomme_interference_data.storage.files import digest_json

from .config import AskConfig, RetrievalConfig, RunConfig
from .history import HistoryReader
from .plan import RunPlan, WorkItem
from .row import Rollout

if TYPE_CHECKING:
    from robomme_interference_data.retrieval.selector import Selector


@dataclass(frozen=True)
class Job:
    """A work item for a worker, with the metadata that the policy or model reported to the run."""

    item: WorkItem
    metadata: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class RunContext[C: RunConfig | AskConfig]:
    """A run with checked settings: what its workers need, and what all its rows share.

    Attributes:
        config: Its settings; a model on the Hub has its commit.
        system: The label of its rows.
        facts: What the system is.
        buffer_set: Label of the buffer set in its rows.
        revision: `BufferSet.revision`.
        training_seed: Seed of the training run that made the weights; None if unknown.
    """

    config: C
    system: str
    facts: SystemFacts
    buffer_set: str
    revision: str
    training_seed: int | None = None

    def key(self, item: WorkItem) -> dict[str, Any]:
        """Return what identifies the row of a work item: its `KEY_COLUMNS`."""
        return {
            "system": self.system,
            "simulator": self.config.simulator,
            "buffer_set": self.buffer_set,
            "revision": self.revision,
            "family": item.episode.family,
            "condition": item.condition,
            "split": item.episode.split,
            "episode": item.episode.index,
            "shift": self.config.shift,
            "training_seed": self.training_seed,
            "model_seed": self.config.model_seed,
            "protocol_version": PROTOCOL_VERSION,
        }

    def row(self, item: WorkItem, status: Status, **values: Any) -> Rollout:
        """Return the row of a work item."""
        return Rollout(
            **self.key(item),
            **to_dict(self.facts),
            status=str(status),
            success=success_of(status),
            **values,
        )


def make_selector(config: RetrievalConfig) -> "Selector | None":
    """Make the retrieval step of a run; None if it has none."""
    if config.retrieval is None:
        return None
    from robomme_interference_data.retrieval.selector import Selector

    return Selector(config.retrieval, rule=config.retrieval_rule, camera=config.retrieval_camera)


def retrieval_text(config: RetrievalConfig, buffer_set: BufferSet) -> str | None:
    """Return the retrieval step of a run as `SystemFacts` have it; None if it has none."""
    if config.retrieval is None:
        return None
    from robomme_interference_data.retrieval.selector import RetrievalStep

    step = RetrievalStep(
        config.retrieval, rule=config.retrieval_rule, camera=config.retrieval_camera
    )
    return step.label(buffer_set.datasets[DEMONSTRATIONS])


def short_digest(identity: Mapping[str, Any]) -> str:
    """Return what identifies a policy or a model in a column: 16 letters of a SHA-256."""
    return digest_json([identity])[:16]


def package_versions(config: RunConfig | AskConfig) -> dict[str, str]:
    """Return the versions of Python and of the packages that a run uses, if installed.

    RoboMME's interpreter has others: see `simulator_versions`.
    """
    names = ["robomme-interference-data", "numpy", "av", "torch"]
    if isinstance(config, RunConfig):
        names += policy_kind(config.policy).packages
    if config.retrieval is not None:
        names.append("transformers")
    if isinstance(config, RunConfig):
        names += simulator_class(config.simulator).packages
    versions = {"python": platform.python_version()}
    for name in names:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


def history_columns(
    buffer: Buffer, received: Sequence[int], memory: Memory | None, *, retrieved: bool
) -> dict[str, Any]:
    """Return the columns about the frames of a buffer that a policy or model received.

    Args:
        buffer: The history.
        received: The frames, as ascending indices.
        memory: What of them the memory keeps; None if unknown.
        retrieved: Whether a retrieval step chose them; if not, the policy received all.
    """
    share = lesson_share(buffer.sessions, received) if received else None
    columns: dict[str, Any] = {
        "history_frames": len(received),
        "lesson_frames": lesson_frames(buffer.sessions, received),
        "lesson_share": share,
    }
    if retrieved and share is not None:
        columns |= retrieval_columns(received, share)
    if memory is not None and buffer.evidence is not None:
        columns["evidence_kept"] = evidence_kept(buffer.evidence, memory.kept(received))
    return columns


class RunFunction[C: RunConfig | AskConfig](ABC):
    """The function of a worker; it opens the buffer set and the retrieval step on first use.

    After an exception it closes and makes anew everything else that it uses.
    """

    def __init__(self, run: RunContext[C]):
        self.run = run

    @cached_property
    def buffer_set(self) -> BufferSet:
        """The buffer set."""
        return load_buffer_set(self.run.config.buffer_set, cache=self.run.config.cache, threads=1)

    @cached_property
    def selector(self) -> "Selector | None":
        """The retrieval step."""
        return make_selector(self.run.config)

    @cached_property
    def history(self) -> HistoryReader:
        """Reads history frames."""
        return HistoryReader(self.buffer_set.datasets)

    def __call__(self, task: Any, worker: Worker) -> Any:
        """Do a task."""
        try:
            return self.work(task, worker)
        except Exception:
            self.close()
            raise

    def describe(self) -> dict[str, str]:
        """Return what must be the same on all machines that run the task."""
        buffer_set = load_buffer_set(self.run.config.buffer_set)
        buffer_set.check_tables(buffer_set.conditions)
        revision = {"the buffer set's revision": buffer_set.revision}
        return package_versions(self.run.config) | revision

    @abstractmethod
    def work(self, task: Any, worker: Worker) -> Any:
        """Do a task; of a `Job`, return the row, and a problem with its files or None."""

    @abstractmethod
    def close(self) -> None:
        """Release everything that may be broken after an exception."""


class Runner[C: RunConfig | AskConfig](ABC):
    """Rollouts or questions: `evaluation.run_evaluation` calls the methods in their order here.

    Attributes:
        config: The settings; `prepare` adds the commits of models.
        buffer_set: The buffer set.
        system: The label of the rows; set by `prepare`.
        metadata: What the policy or model reports of itself; set by `prepare`.
        versions: Versions of the simulator; set by `prepare`.
    """

    system: str

    def __init__(self, config: C, buffer_set: BufferSet):
        self.config, self.buffer_set = config, buffer_set
        self.metadata: dict[str, Any] = {}
        self.versions: Mapping[str, str] = {}

    @property
    def retried_errors(self) -> tuple[type[Exception], ...]:
        """Errors after which a rollout or question is started again."""
        return (SimulatorCrashError, ServerKeepaliveError, ServerDiedError)

    def lock(self, folder: Path) -> AbstractContextManager[None]:
        """Keep other runs from policy servers in the block; `folder` is this run's."""
        return nullcontext()

    @abstractmethod
    def prepare(self) -> None:
        """Check the settings, and identify the policy or model."""

    @abstractmethod
    def facts(self) -> SystemFacts:
        """Return what the system is; after `open`, with what its servers report."""

    def training_seed(self) -> int | None:
        """Return the seed of the training run: the setting, or else what the policy reports.

        A policy reports it as `training_seed` in its metadata, a server in that of the server.
        None if nobody knows it.
        """
        if self.config.training_seed is not None:
            return self.config.training_seed
        for reported in (self.metadata, self.metadata.get("server_metadata")):
            seed = reported.get("training_seed") if isinstance(reported, Mapping) else None
            if isinstance(seed, int) and not isinstance(seed, bool) and seed >= 0:
                return seed
        return None

    @abstractmethod
    def check(self, plan: RunPlan, items: Sequence[WorkItem]) -> None:
        """Check the plan."""

    def shared(self) -> AbstractContextManager[None]:
        """Run what the workers share in the block."""
        return nullcontext()

    @abstractmethod
    def function(self, run: RunContext[C]) -> RunFunction[C]:
        """Return the function of the workers."""

    def needs_workers(self, todo: Sequence[WorkItem]) -> bool:
        """Whether the run needs workers."""
        return bool(todo)

    def open(self, pool: WorkerPool, todo: Sequence[WorkItem]) -> None:
        """Let a worker open what the run uses, and check it."""

    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """Return what can change a result, as plain values."""
