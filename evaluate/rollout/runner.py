"""Runs of rollouts, simulated and offline: the checks before one, and what identifies it."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robomme_interference_data.constants import EXECUTIONS, ORACLE, RECORDINGS
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import open_dataset
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    PolicyServerError,
    SimulatorCrashError,
    named,
)
from robomme_interference_data.evaluate import optional
from robomme_interference_data.evaluate.policies.capabilities import Role
from robomme_interference_data.evaluate.policies.identity import (
    check_memory_kind,
    check_metadata,
    check_servers_memory,
    describe_policy,
    lock_servers,
    policy_identity,
)
from robomme_interference_data.evaluate.policies.registry import (
    POLICIES,
    policy_kind,
    policy_memory,
    policy_options,
    starts_server,
)
from robomme_interference_data.evaluate.run.config import RunConfig, check_unused
from robomme_interference_data.evaluate.run.plan import RunPlan, WorkItem
from robomme_interference_data.evaluate.run.runner import (
    RunContext,
    Runner,
    retrieval_text,
    short_digest,
)
from robomme_interference_data.evaluate.systems import SystemFacts, name_system
from robomme_interference_data.runtime.executor import WorkerPool
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.registry import simulator_class, simulator_versions

from .checks import check_plan, check_settings, check_system
from .names import default_system
from .worker import RolloutFunction, StartServer, StartSimulator

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.policies.answers import Answers
    from robomme_interference_data.evaluate.policies.shared import Address


class RolloutRunner(Runner[RunConfig]):
    """Rollouts of a policy in a simulator."""

    def __init__(self, config: RunConfig, buffer_set: BufferSet):
        self.system = config.system or default_system(config)
        self._answers: Answers | None = None
        self._addresses: Sequence[Address] = ()
        # The commit of a model is the same for all workers.
        config = dataclasses.replace(config, policy=POLICIES.pin(config.policy))
        if config.subgoals is not None:
            config = dataclasses.replace(config, subgoals=optional.pin_subgoals(config.subgoals))
        super().__init__(config, buffer_set)

    @property
    def retried_errors(self) -> tuple[type[Exception], ...]:
        """Errors after which a rollout is started again."""
        if self.config.policies is None:
            return super().retried_errors
        # A shared policy that hangs delays all its rollouts: which of them it hung at is unknown.
        return (*super().retried_errors, TimeoutError)

    def lock(self, folder: Path) -> AbstractContextManager[None]:
        """Keep other runs from the policy's servers."""
        return lock_servers(self.config.policy, folder)

    def prepare(self) -> None:
        """Check the settings, and identify the policy and the writer of its subgoals."""
        if self.config.subgoals is not None:
            self.config = optional.with_published(self.config)
        config = self.config
        check_system(config, self.system)  # before a policy server is waited for
        self._policy, self._policy_metadata = describe_policy(
            config.policy, config.policy_options, workers=config.workers
        )
        check_settings(config, self.buffer_set, self._policy)
        self._system = name_system(self.system)
        self._subgoal_metadata: dict[str, Any] = {}
        if config.subgoals is not None:
            self._subgoal_metadata = optional.describe_subgoals(config)
        self.metadata = self._policy_metadata | self._subgoal_metadata
        self.versions = simulator_versions(config.simulator, config.robomme_python)

    def facts(self) -> SystemFacts:
        """Return what the system is."""
        config, spec = self.config, POLICIES.parse(self.config.policy)
        published = self._system.facts if self._system.paper else SystemFacts()
        subgoals = None
        if config.subgoals is not None:
            subgoals = optional.subgoals_text(config, self._subgoal_metadata)
        return SystemFacts(
            policy=spec.kind,
            policy_id=short_digest(self._policy_identity()),
            memory=policy_memory(config.policy) or published.memory,
            retrieval=retrieval_text(config, self.buffer_set),
            subgoals=subgoals,
            # A policy without memory may have a subgoal writer that reads the history.
            reads_history=published.reads_history
            and (self._policy.wants_history or config.subgoals is not None),
            reference=config.subgoals == ORACLE
            or (policy_kind(config.policy).role is Role.REFERENCE and config.subgoals is None),
        )

    def check(self, plan: RunPlan, items: Sequence[WorkItem]) -> None:
        """Check every rollout."""
        check_plan(self.config, self._system, self.buffer_set, plan, items)
        if policy_kind(self.config.policy).acts_out_answers:
            path = Path(POLICIES.parse(self.config.policy).target)
            self._answers = optional.read_answers(self.config, path, self.buffer_set, items)

    @contextmanager
    def shared(self) -> Iterator[None]:
        """Run the processes of shared policies in the block."""
        if self.config.policies is None:
            yield
            return
        with optional.policy_processes(self.config) as self._addresses:
            yield

    def function(self, run: RunContext[RunConfig]) -> RolloutFunction:
        """Return the function that runs rollouts."""
        return RolloutFunction(run, self._answers, self._addresses)

    def needs_workers(self, todo: Sequence[WorkItem]) -> bool:
        """Whether there is work, or a server that only workers start must be identified."""
        return bool(todo) or starts_server(self.config.policy)

    def open(self, pool: WorkerPool, todo: Sequence[WorkItem]) -> None:
        """Let a worker start the policy's server, and the simulator, before the first rollout."""
        config = self.config
        if starts_server(config.policy):
            self._policy_metadata, keeps = _run_first(pool, StartServer(), None, _server_fault)
            options = policy_options(config.policy, config.policy_options)
            check_metadata([self._policy_metadata], options["checkpoint"])
            if keeps is not None:
                check_memory_kind(keeps, self._policy_metadata["server"], self._system)
            self.metadata = self._policy_metadata | self._subgoal_metadata
        if todo:
            simulator = simulator_class(config.simulator)
            # Of a function that declares no class nothing is known, not even how it begins.
            tried = simulator.try_out and simulator is not Simulator
            start = StartSimulator(todo[0].episode if tried else None)
            _run_first(pool, start, config.simulator_timeout_s, _simulator_fault)
            check_servers_memory(config.policy, config.policy_options, self._system)

    def identity(self) -> dict[str, Any]:
        """Return what of simulator, policy and subgoals can change a result."""
        subgoals = None
        if self.config.subgoals is not None:
            subgoals = optional.subgoals_identity(self.config, self._subgoal_metadata)
        return {
            "simulator_version": dict(self.versions),
            "subgoals": subgoals,
            **self._policy_identity(),
        }

    def _policy_identity(self) -> dict[str, Any]:
        config = self.config
        return policy_identity(config.policy, config.policy_options, self._policy_metadata)


_UNUSED = ("simulator", "shift", "check_lesson", "videos")
"""Settings of simulators."""


class OfflineRunner(RolloutRunner):
    """Rollouts along recorded executions: the policy acts, and the recording goes on."""

    def __init__(self, config: RunConfig, buffer_set: BufferSet):
        check_unused(config, _UNUSED, "an offline evaluation", "Leave it out.")
        if config.subgoals == ORACLE:
            raise InvalidOptionError(
                f"subgoals of {ORACLE} need a simulator",
                f"Set a model, or leave out {named('offline')}.",
            )
        super().__init__(dataclasses.replace(config, simulator=RECORDINGS), buffer_set)

    def check(self, plan: RunPlan, items: Sequence[WorkItem]) -> None:
        """Check every item, and that its episode has an execution."""
        super().check(plan, items)
        executions = open_dataset(self.buffer_set, EXECUTIONS)
        for episode in dict.fromkeys(item.episode for item in items):
            executions.index_of(episode)  # raises


def _run_first(
    pool: WorkerPool,
    task: StartServer | StartSimulator,
    time_limit: float | None,
    fault: Callable[[object], InterferenceError],
) -> Any:
    """Run a task before all jobs; raise its error, or what `fault` makes of an unexpected one."""
    (outcome,) = pool.run([task], time_limit=time_limit, attempts=1)
    if isinstance(outcome.error, InterferenceError):
        raise outcome.error
    if outcome.error is not None:
        raise fault(outcome.error)
    return outcome.value


def _server_fault(error: object) -> InterferenceError:
    return PolicyServerError(f"the policy's server cannot be started: {error}")


def _simulator_fault(error: object) -> InterferenceError:
    return SimulatorCrashError(
        f"the simulator cannot be started: {error}", "Check what works on this machine.", "doctor"
    )
