"""What workers of a run get, rollouts and questions alike, and what they open."""

import platform
from abc import ABC, abstractmethod
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from importlib import metadata
from typing import TYPE_CHECKING, Any

from robomme_interference_data.constants import PROTOCOL_VERSION
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.evaluate.policies.registry import policy_kind
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.rollouts import Status, success_of

from .config import AskConfig, RetrievalConfig, RunConfig
from .history import HistoryReader
from .plan import RunPlan, WorkItem
from .row import Rollout
from .traces import PlannedPlay

if TYPE_CHECKING:
    from robomme_interference_data.retrieval.selector import Selector


def reported_number(metadata: Mapping[str, Any], name: str) -> int | None:
    """Return a whole number that a policy or its server reports of itself; None if none does."""
    for reported in (metadata, metadata.get("server_metadata")):
        number = reported.get(name) if isinstance(reported, Mapping) else None
        # A bool is an int in Python, and no number.
        if isinstance(number, int) and not isinstance(number, bool) and number >= 0:
            return number
    return None


@dataclass(frozen=True)
class RunContext[C: RunConfig | AskConfig]:
    """What is known of a run before its first row.

    Attributes:
        config: Its settings, checked; a model on the Hub has its commit.
        system: The label of its rows.
        facts: What the system is.
        buffer_set: Label of the buffer set in its rows.
        revision: `BufferSet.revision`.
        metadata: What the policy or model reports of itself.
        identity: What of policy or model, and simulator, can change a result, as plain values.
        versions: Versions of the simulator.
    """

    config: C
    system: str
    facts: SystemFacts
    buffer_set: str
    revision: str
    metadata: Mapping[str, Any] = field(default_factory=dict)
    identity: Mapping[str, Any] = field(default_factory=dict)
    versions: Mapping[str, str] = field(default_factory=dict)

    @property
    def training_seed(self) -> int | None:
        """Seed of the training run of the weights: the setting, or else what the policy reports.

        A policy reports it as `training_seed` in its metadata, a server in that of the server.
        None if nobody knows it.
        """
        if self.config.training_seed is not None:
            return self.config.training_seed
        return reported_number(self.metadata, "training_seed")

    @property
    def unfinished_training(self) -> str | None:
        """That the weights are of an unfinished training run, in a sentence; None if not known.

        A policy reports the length of the run as `training_steps`, beside `training_step`.
        """
        step, steps = self.facts.training_step, reported_number(self.metadata, "training_steps")
        if step is None or steps is None or step >= steps:
            return None
        return f"{self.system}: the training run is not finished, step {step:,} of {steps:,}"

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


@dataclass(frozen=True)
class PlannedRun[C: RunConfig | AskConfig]:
    """A run, its plan, and the work items of that, in canonical order."""

    run: RunContext[C]
    plan: RunPlan
    items: tuple[WorkItem, ...]


@dataclass(frozen=True)
class Job[C: RunConfig | AskConfig]:
    """A work item for a worker, and its run.

    Workers start before all of their run is known: some start the server that identifies it.
    """

    item: WorkItem
    run: RunContext[C]


@dataclass(frozen=True)
class ProbeTask:
    """Rollouts that a worker plays for the leak probe, one after the other; it returns `Play`s.

    Attributes:
        run: Their run.
        turns: What to play.
        fresh: Whether to begin with a policy, simulator and subgoal writer that played nothing.
    """

    run: RunContext[RunConfig]
    turns: tuple[PlannedPlay, ...]
    fresh: bool


def make_selector(config: RetrievalConfig) -> "Selector | None":
    """Make the retrieval step of a run; None if it has none."""
    if config.retrieval is None:
        return None
    from robomme_interference_data.retrieval.selector import Selector

    return Selector(config.retrieval, rule=config.retrieval_rule, camera=config.retrieval_camera)


def package_versions(config: RunConfig | AskConfig) -> dict[str, str]:
    """Return the versions of Python and of the packages that a run uses, if installed.

    Those that the simulator uses are in `simulator_versions`.
    """
    names = ["robomme-interference-data", "numpy", "av", "torch"]
    if isinstance(config, RunConfig):
        names += policy_kind(config.policy).packages
    if config.retrieval is not None:
        names.append("transformers")
    versions = {"python": platform.python_version()}
    for name in names:
        with suppress(metadata.PackageNotFoundError):
            versions[name] = metadata.version(name)
    return versions


class RunFunction[C: RunConfig | AskConfig](ABC):
    """The function of a worker; it opens the buffer set and the retrieval step on first use.

    After an exception it closes and makes anew everything else that it uses.
    """

    def __init__(self, config: C):
        self.config = config

    @cached_property
    def buffer_set(self) -> BufferSet:
        """The buffer set."""
        # Workers share the processors: each decodes in one thread.
        return load_buffer_set(self.config.buffer_set, cache=self.config.cache, threads=1)

    @cached_property
    def selector(self) -> "Selector | None":
        """The retrieval step."""
        return make_selector(self.config)

    @cached_property
    def history(self) -> HistoryReader:
        """Reads history frames."""
        return HistoryReader(self.buffer_set.datasets)

    def __call__(self, task: Any, worker: Worker) -> Any:
        """Do a task."""
        try:
            return self.work(task, worker)
        except Exception:
            # Simulator, server or model may be in any state now.
            self.close()
            raise

    def describe(self) -> dict[str, str]:
        """Return what must be the same on all machines that run the task."""
        buffer_set = load_buffer_set(self.config.buffer_set)
        buffer_set.check_tables(buffer_set.conditions)
        revision = {"the buffer set's revision": buffer_set.revision}
        return package_versions(self.config) | revision

    @abstractmethod
    def work(self, task: Any, worker: Worker) -> Any:
        """Do a task; of a `Job`, return the row, and a problem with its files or None."""

    @abstractmethod
    def close(self) -> None:
        """Release everything that may be broken after an exception."""
