"""Checks of a run of rollouts before the first one."""

import math
import re
from collections.abc import Sequence

from robomme_interference_data.constants import (
    ACTION,
    DEMONSTRATIONS,
    EXECUTIONS,
    ORACLE,
    RECORDINGS,
    STATE,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, named
from robomme_interference_data.evaluate.policies.capabilities import PolicyKind, Role
from robomme_interference_data.evaluate.policies.policy import BATCH_METHODS, Policy
from robomme_interference_data.evaluate.policies.registry import (
    POLICIES,
    policy_kind,
    policy_memory,
    policy_options,
)
from robomme_interference_data.evaluate.run.config import RunConfig, check_unused, with_retrieval
from robomme_interference_data.evaluate.run.plan import RunPlan, WorkItem
from robomme_interference_data.evaluate.systems import SYSTEMS, System, check_history, name_system
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.runtime.executor import Resources
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.simulators.registry import SIMULATORS, check_shift, simulator_class

from .worker import used_cameras


def default_system(config: RunConfig) -> str:
    """Return the label of rows if none is set: the policy's text, and what changes its results.

    Such as `replay-window-extrapolate`, `follow-subgoals-oracle` with the simulator's subgoals, or
    `retrieval-replay-window-joined`.
    """
    spec, kind = POLICIES.parse(config.policy), policy_kind(config.policy)
    unidentified = config.subgoals if kind.identified else config.policy
    if unidentified not in (None, ORACLE):
        raise InvalidOptionError(
            f"the rows of {unidentified} need a name: its text does not identify it",
            f"Set {named('system')}, such as perceptual-framesamp-modul, or a name of your own: "
            "see docs/how-to/paper-systems.md.",
        )
    memory = policy_memory(config.policy)
    parts = [spec.target if memory is None else Memory.parse(memory).label]
    if kind.role is not Role.OWN:
        parts.insert(0, spec.kind)
    if config.subgoals is not None:
        parts.append(config.subgoals)
    parts += _option_labels(config, kind)
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", "-".join(filter(None, parts))).strip("-")
    return with_retrieval(name, config)


def _option_labels(config: RunConfig, kind: PolicyKind) -> list[str]:
    """Return what options that make another system add to the label of rows."""
    if not kind.option_labels:
        return []
    usual = policy_options(config.policy)
    options = policy_options(config.policy, config.policy_options)
    return [
        label.format(options[name])
        for name, label in kind.option_labels.items()
        if options[name] != usual[name]
    ]


def check_system(config: RunConfig, system: str) -> None:
    """Check that policy and subgoals are those that a label of rows means, and fit each other."""
    _check_name(config, name_system(system))
    _check_subgoals(config)


def check_settings(config: RunConfig, buffer_set: BufferSet, policy: Policy) -> None:
    """Check the settings against each other, the buffer set and the policy."""
    simulator, kind = simulator_class(config.simulator), policy_kind(config.policy)
    if simulator.plays_back and not config.offline:
        raise InvalidOptionError(
            f"{config.simulator} are no simulator to choose",
            f"Set {named('offline')} for an offline evaluation.",
        )
    check_shift(config.simulator, config.shift)
    _check_policies(config, kind, policy)
    scripts = [name for name in simulator.policies if kind.script in (None, name)]
    if policy.privileged and not scripts:
        raise InvalidOptionError(
            f"the policy {config.policy} needs a script of the simulator, and {config.simulator} "
            "has none for it",
            _script_hint(config, kind),
        )
    if kind.acts_out_answers:
        check_unused(config, ["retrieval"], config.policy, "Set it for the questions instead.")
    _check_cameras(config, buffer_set.datasets[DEMONSTRATIONS], policy)
    _check_robot(config, buffer_set, kind)
    if config.videos:
        from robomme_interference_data.viz.episode_video import check_pillow

        check_pillow(named("videos"))


def _check_cameras(config: RunConfig, demonstrations: Dataset, policy: Policy) -> None:
    """Reject cameras that the demonstrations, or the live views, lack."""
    live = demonstrations if config.offline else simulator_class(config.simulator)
    used = used_cameras(config, policy.cameras, demonstrations)
    for where, lacking in (
        (f"the history of {demonstrations.files.describe()}", {*policy.history_cameras}),
        ("the live views of the recordings", used if config.offline else set()),
    ):
        for camera in sorted(lacking - {*demonstrations.cameras}):
            if not demonstrations.cameras:
                demonstrations.camera(camera)  # raises: stored without images
            raise UnknownNameError(
                f"the policy {config.policy} reads the camera {camera!r}, which is not in {where}",
                f"Its cameras: {', '.join(demonstrations.cameras) or 'none'}. Set another policy.",
            )
    for camera in sorted(used - {*live.cameras}):
        raise UnknownNameError(
            f"the live camera {camera!r} is not in the simulator {config.simulator}, which draws "
            f"{', '.join(live.cameras)}",
            "To act along the recordings of this buffer set, without a simulator, set "
            f"{named('offline')}. "
            f"In the simulator, set another policy, or another {named('retrieval_camera')}.",
        )


def _script_hint(config: RunConfig, kind: PolicyKind) -> str:
    if config.offline:
        return f"Leave out {named('offline')}, or set another policy."
    if kind.script in simulator_class(RECORDINGS).policies:
        return f"Set {named('offline')}: it repeats recorded actions."
    return "Set another simulator, such as tabletop, or another policy."


def _check_robot(config: RunConfig, buffer_set: BufferSet, kind: PolicyKind) -> None:
    """Reject a policy for RoboMME's robot on a robot of another size."""
    (state,) = buffer_set.datasets[DEMONSTRATIONS].features[STATE]
    action = simulator_class(config.simulator).action_size
    if config.offline and EXECUTIONS in buffer_set.datasets:
        (action,) = buffer_set.datasets[EXECUTIONS].features[ACTION]
    if kind.action_size is not None and {state, action} != {kind.action_size}:
        raise InvalidOptionError(
            f"the policy {config.policy} reads {kind.action_size} state values and returns "
            f"{kind.action_size} action values, 7 joints and a gripper; this robot has {state} and "
            f"{action}",
            'Set a policy for this robot, such as "python:module:factory".',
        )


def _check_policies(config: RunConfig, kind: PolicyKind, policy: Policy) -> None:
    """Check the settings of shared policies, and that the policy can be shared."""
    if config.policies is None:
        own = "policies that are not shared"
        unused = ("max_batch_size", "batch_wait_timeout_s", "policy_resources")
        check_unused(config, unused, own, f"Set {named('policies')}.")
        return
    if config.on_cluster:
        Resources.parse("policy_resources", config.policy_resources)
    else:
        own = "policies on this machine, which share its GPUs"
        check_unused(config, ("policy_resources",), own, f"Set {named('executor', 'ray')}.")
    for name, valid, expected in (
        (
            "policies",
            1 <= config.policies <= config.workers,
            f"1 to {named('workers')}, {config.workers}",
        ),
        ("max_batch_size", config.max_batch_size >= 1, "1 or more"),
        ("batch_wait_timeout_s", 0 <= config.batch_wait_timeout_s < math.inf, "0 or more"),
    ):
        if not valid:
            raise InvalidOptionError.expected(name, getattr(config, name), expected)
    missing = [f"{name}()" for name in BATCH_METHODS if not callable(getattr(policy, name, None))]
    fault = None
    if kind.server is not None and kind.server.one_client:
        fault = "its server holds one memory"
    elif policy.privileged:
        fault = "it needs the simulator, which runs in the worker"
    elif missing:
        fault = f"it has no {' and no '.join(missing)}"
    if fault is not None:
        raise InvalidOptionError(
            f"the policy {config.policy} cannot be shared by workers ({named('policies')}): "
            f"{fault}",
            f"Leave out {named('policies')}; docs/how-to/your-own-policy.md describes shared "
            "policies.",
        )


def _check_name(config: RunConfig, system: System) -> None:
    """Reject the name of a published system or control for a run of another one."""
    kind, retrieval = policy_kind(config.policy), config.retrieval is not None
    fault = None
    if not system.paper:
        if system.name in SYSTEMS and (
            kind.role not in (Role.CONTROL, Role.REFERENCE) or default_system(config) != system.name
        ):
            fault = f"the policy {config.policy} is not the control {system.name}"
            fault += " with a retrieval step in front" if retrieval else ""
    elif not kind.published:
        fault = f"the policy {config.policy} is not the paper's system {system.name}"
    # Code of the user may write the subgoals itself.
    elif (system.facts.subgoals is None) is (
        config.subgoals is not None
    ) and kind.role is not Role.OWN:
        acts_on_none = system.facts.subgoals is None
        needs = "no subgoals" if acts_on_none else f"subgoals of a model ({named('subgoals')})"
        fault = (
            f"system {system.name} acts on {needs}, and {named('subgoals')} is {config.subgoals}"
        )
    elif config.subgoals == ORACLE:
        fault = f"system {system.name} has subgoals of a model, and {ORACLE} knows the answer"
    elif (system.facts.retrieval is not None) != retrieval:
        expected = "a" if system.facts.retrieval else "no"
        fault = f"system {system.name} has {expected} retrieval step, and {named('retrieval')} is "
        fault += str(config.retrieval)
    elif retrieval and Rule.parse(config.retrieval_rule).method != "max":
        fault = f"the retrieval step of {system.name} has the rule max, not {config.retrieval_rule}"
    if fault is not None:
        raise InvalidOptionError(
            fault, f"Set {named('system')} to a name of your own: see docs/how-to/paper-systems.md."
        )


def _check_subgoals(config: RunConfig) -> None:
    """Reject subgoals that no policy reads, and settings of them without effect."""
    for name in ("subgoal_prompt", "subgoal_options"):
        if getattr(config, name) and config.subgoals in (None, ORACLE):
            raise InvalidOptionError(
                f"{named(name)} has no effect without a model that writes subgoals",
                'Set subgoals="openai:URL#MODEL", or leave it out.',
            )
    if config.subgoals is None:
        return
    if not policy_kind(config.policy).reads_subgoals:
        able = [name for name, kind in POLICIES.kinds.items() if kind.reads_subgoals]
        raise InvalidOptionError(
            f"the policy {config.policy} reads no subgoals",
            f"Set {named('policy')} to {', '.join(able)}, or leave out {named('subgoals')}.",
        )


def check_plan(
    config: RunConfig,
    system: System,
    buffer_set: BufferSet,
    plan: RunPlan,
    items: Sequence[WorkItem],
) -> None:
    """Check every rollout of a plan."""
    kind, simulator = policy_kind(config.policy), simulator_class(config.simulator)
    families = {episode.family for episode in simulator.episodes()}
    for episode in dict.fromkeys(item.episode for item in items):
        record = buffer_set.query(episode).record
        if kind.needs_evidence and record.evidence is None:
            raise InvalidOptionError(
                f"{config.policy} needs to know which frames show the answer, which is unknown "
                f"for {episode}",
                "Build the demonstrations from a source with evidence; see "
                "docs/reference/sources.md.",
            )
        recorded = record.simulator
        if simulator.own_episodes and recorded not in (None, config.simulator):
            raise InvalidOptionError(
                f"{episode} was recorded on {recorded!r}, the run is on {config.simulator!r}",
                f'Set simulator="{recorded}", or give a buffer set of {config.simulator}.'
                if recorded in SIMULATORS
                else "No simulator plays the episodes of this buffer set: give one whose "
                f"demonstrations are of {' or '.join(SIMULATORS)}, or your own simulator.",
            )
        if families and episode.family not in families:
            raise InvalidOptionError(
                f"{config.simulator} does not play the family {episode.family} of {episode}",
                f"It plays {', '.join(sorted(families))}. Set {named('families')} to some of "
                "them, or "
                f"{named('simulator')} to one that plays these episodes, such as module:class.",
            )
    if system.position_limit is not None and config.retrieval is None:
        planned, longest = set(items), dict.fromkeys(plan.conditions, 0)
        for manifest in buffer_set.manifests():
            name = manifest.condition
            if WorkItem(name, manifest.episode_id) in planned:
                longest[name] = max(manifest.history_frames, longest[name])
        check_history(system, longest)
