"""Open a run of rollouts, simulated or along recordings: all that happens before the first one."""

import dataclasses
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robomme_interference_data.constants import DEMONSTRATIONS, EXECUTIONS, ORACLE
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import open_dataset
from robomme_interference_data.data.renderers import dataset_renderers
from robomme_interference_data.data.state_reader import other_state_sizes
from robomme_interference_data.errors import (
    InterferenceError,
    PolicyServerError,
    SimulatorCrashError,
)
from robomme_interference_data.evaluate.policies.identity import (
    check_memory_kind,
    check_metadata,
    check_servers_memory,
    declared_memory,
    describe_policy,
    lock_servers,
    policy_identity,
)
from robomme_interference_data.evaluate.policies.kinds import Role
from robomme_interference_data.evaluate.policies.policy import Policy
from robomme_interference_data.evaluate.policies.registry import (
    POLICIES,
    policy_kind,
    policy_options,
    starts_server,
)
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.identity import retrieval_text, short_digest
from robomme_interference_data.evaluate.run.log import unfinished
from robomme_interference_data.evaluate.run.plan import WorkItem, plan_run
from robomme_interference_data.evaluate.run.worker import PlannedRun, RunContext, reported_number
from robomme_interference_data.evaluate.systems import System, SystemFacts, name_system
from robomme_interference_data.runtime.executor import Executor, WorkerPool
from robomme_interference_data.schema.renderers import LIVE_VIEWS, renderers_note
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.registry import (
    find_simulator_python,
    simulator_class,
    simulator_versions,
)

from .checks import check_plan, check_policy, check_settings
from .other_states import check_other_states
from .settings import complete_settings, live_renderer
from .worker import RolloutFunction, StartServer, StartSimulator

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.policies.answers import Answers
    from robomme_interference_data.evaluate.policies.shared import Address

logger = logging.getLogger(__name__)


@contextmanager
def open_rollouts(
    config: RunConfig, buffer_set: BufferSet, executor: Executor
) -> Iterator[tuple[PlannedRun[RunConfig], WorkerPool | None]]:
    """Plan a run, and keep its workers in the block; None if there is nothing to do for them."""
    # A server may hold one memory: no other run may use it until this one has ended.
    with lock_servers(config.policy, Path(config.out)):
        planned = plan_rollouts(config, buffer_set)
        run, items = planned.run, planned.items
        if note := renderers_note(run.identity["renderers"].items()):
            logger.warning(note)
        answers = _read_answers(run.config, buffer_set, items)
        todo = unfinished(Path(config.out), items)
        # Only a server that workers start identifies itself late: it is started even if no rollout
        # is left, so that a finished run is compared with it too.
        if not todo and not starts_server(config.policy):
            yield planned, None
            return
        with (
            _shared_policies(run.config) as addresses,
            executor.pool(RolloutFunction(run.config, answers, addresses)) as pool,
        ):
            if starts_server(config.policy):
                run = _start_server(run, pool)
            if todo:
                _start_simulator(run, pool, todo[0])
            yield dataclasses.replace(planned, run=run), pool


def plan_rollouts(config: RunConfig, buffer_set: BufferSet) -> PlannedRun[RunConfig]:
    """Check settings and policy, and plan the run, without workers."""
    config, system = complete_settings(config)
    check_settings(config, buffer_set)  # first: a server may take minutes to answer
    policy, metadata = describe_policy(config.policy, config.policy_options, workers=config.workers)
    check_policy(config, buffer_set, policy)
    run = _describe_run(config, system, buffer_set, policy, metadata)
    plan = plan_run(config, run.facts, buffer_set)
    items = plan.items()
    check_plan(config, system, buffer_set, plan, items)
    check_other_states(config, buffer_set, policy, items)
    if config.offline:
        executions = open_dataset(buffer_set, EXECUTIONS)
        for episode in dict.fromkeys(item.episode for item in items):
            executions.index_of(episode)  # raises if there is none
    return PlannedRun(run, plan, items)


def _describe_run(
    config: RunConfig,
    system: System,
    buffer_set: BufferSet,
    policy: Policy,
    policy_metadata: Mapping[str, Any],
) -> RunContext[RunConfig]:
    """Return what is known of a run from its settings, and from what its policy reports."""
    kind, published = policy_kind(config.policy), SystemFacts()
    if system.paper or system.elsewhere:
        published = system.facts
    subgoals, subgoals_identity, metadata = None, None, dict(policy_metadata)
    if config.subgoals is not None:
        from robomme_interference_data.evaluate.language import subgoal_settings

        writer = subgoal_settings.describe_subgoals(config)
        subgoals = subgoal_settings.subgoals_text(config, writer)
        subgoals_identity = subgoal_settings.subgoals_identity(config, writer)
        metadata |= writer
    identity = policy_identity(config.policy, config.policy_options, policy_metadata)
    python = find_simulator_python(config.simulator, config.simulator_python)
    config = dataclasses.replace(config, simulator_python=python)
    versions = simulator_versions(config.simulator, python)
    live = live_renderer(config, policy.cameras, buffer_set.datasets[DEMONSTRATIONS])
    facts = SystemFacts(
        policy=POLICIES.parse(config.policy).kind,
        policy_id=short_digest(identity),
        training_step=reported_number(policy_metadata, "training_step"),
        memory=declared_memory(policy, policy_metadata) or published.memory,
        retrieval=retrieval_text(config, buffer_set),
        subgoals=subgoals,
        # A policy without memory may have a subgoal writer that reads the history.
        reads_history=published.reads_history
        and (policy.wants_history or config.subgoals is not None),
        reference=config.subgoals == ORACLE
        or (kind.role is Role.REFERENCE and config.subgoals is None),
    )
    # Without units of another robot the rule has no effect.
    others = other_state_sizes(buffer_set.datasets)
    other_states = {"other_states": policy.other_states} if others else {}
    options = sorted(config.simulator_options)
    simulator_options = {"simulator_options": options} if options else {}
    return RunContext(
        config,
        system.name,
        facts,
        buffer_set.name,
        buffer_set.revision,
        metadata=metadata,
        identity={
            "simulator_version": dict(versions),
            "renderers": {**dataset_renderers(buffer_set.datasets), LIVE_VIEWS: live},
            "subgoals": subgoals_identity,
            **other_states,
            **simulator_options,
            **identity,
        },
        versions=versions,
    )


def _read_answers(
    config: RunConfig, buffer_set: BufferSet, items: Sequence[WorkItem]
) -> "Answers | None":
    """Return the answers that the policy `answers` carries out; None for all other policies."""
    if not policy_kind(config.policy).acts_out_answers:
        return None
    from robomme_interference_data.evaluate.policies.answers import read_answers

    path = Path(POLICIES.parse(config.policy).target)
    return read_answers(config, path, buffer_set, items)


def _shared_policies(config: RunConfig) -> "AbstractContextManager[Sequence[Address]]":
    """Run the processes of shared policies in the block; none if each worker has its own."""
    if config.policies is None:
        return nullcontext(())
    from robomme_interference_data.evaluate.policies.process import policy_processes

    return policy_processes(config)


def _start_server(run: RunContext[RunConfig], pool: WorkerPool) -> RunContext[RunConfig]:
    """Let a worker start the policy's server; return the run with what the server reports."""
    config, system = run.config, name_system(run.system)
    asks = system.keeps_frames is not None
    reported, memory, keeps = _run_first(pool, StartServer(asks), None, _server_fault)
    options = policy_options(config.policy, config.policy_options)
    check_metadata([reported], options["checkpoint"])
    if keeps is not None:
        check_memory_kind(keeps, reported["server"], system)
    identity = policy_identity(config.policy, config.policy_options, reported)
    facts = dataclasses.replace(
        run.facts,
        policy_id=short_digest(identity),
        training_step=reported_number(reported, "training_step"),
        memory=memory or run.facts.memory,
    )
    # Until now the policy's metadata were empty; those of a writer of subgoals are kept.
    return dataclasses.replace(
        run,
        facts=facts,
        metadata=reported | dict(run.metadata),
        identity=dict(run.identity) | identity,
    )


def _start_simulator(run: RunContext[RunConfig], pool: WorkerPool, first: WorkItem) -> None:
    """Let a worker start the simulator, and check servers, before the first rollout."""
    config, simulator = run.config, simulator_class(run.config.simulator)
    # Of a function that declares no class nothing is known, not even how it begins.
    tried = simulator.try_out and simulator is not Simulator
    start = StartSimulator(first.episode if tried else None)
    _run_first(pool, start, config.simulator_timeout_s, _simulator_fault)
    check_servers_memory(config.policy, config.policy_options, name_system(run.system))


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
