"""Checks of a run of rollouts before the first one."""

import math
import shlex
from collections.abc import Sequence

from robomme_interference_data.constants import (
    ACTION,
    DEMONSTRATIONS,
    EXECUTIONS,
    RECORDINGS,
    STATE,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, named
from robomme_interference_data.evaluate.policies.kinds import PolicyKind
from robomme_interference_data.evaluate.policies.policy import BATCH_METHODS, Policy
from robomme_interference_data.evaluate.policies.registry import policy_kind
from robomme_interference_data.evaluate.run.config import RunConfig, check_unused
from robomme_interference_data.evaluate.run.plan import RunPlan, WorkItem, plan_work
from robomme_interference_data.evaluate.systems import System, check_history
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Resources
from robomme_interference_data.simulators.registry import (
    SIMULATORS,
    check_shift,
    find_simulator_python,
    simulator_class,
    simulator_versions,
)

from .settings import used_cameras


def check_settings(config: RunConfig, buffer_set: BufferSet) -> None:
    """Check the settings against each other and the buffer set, without the policy."""
    simulator, kind = simulator_class(config.simulator), policy_kind(config.policy)
    if simulator.plays_back and not config.offline:
        raise InvalidOptionError(
            f"{config.simulator} are no simulator to choose",
            f"Set {named('offline')} for an offline evaluation.",
        )
    check_shift(config.simulator, config.shift)
    python = find_simulator_python(config.simulator, config.simulator_python)
    simulator_versions(config.simulator, python)  # raises if its interpreter does not run
    _check_policies(config)
    if kind.acts_out_answers:
        check_unused(config, ["retrieval"], config.policy, "Set it for the questions instead.")
    _check_robot(config, buffer_set, kind)
    if config.videos:
        from robomme_interference_data.viz.episode_video import check_pillow

        check_pillow(named("videos"))
    # Under which conditions the policy runs is not known yet, but their episodes are.
    plan_work(
        buffer_set.episodes_under(config.conditions),
        conditions=config.conditions or buffer_set.conditions,
        families=config.families,
        episodes=config.episodes,
        split=config.split,
        shard=config.shard,
    )


def check_policy(config: RunConfig, buffer_set: BufferSet, policy: Policy) -> None:
    """Check what a policy declares against the settings and the buffer set."""
    simulator, kind = simulator_class(config.simulator), policy_kind(config.policy)
    _check_shared(config, kind, policy)
    scripts = [name for name in simulator.policies if kind.script in (None, name)]
    if policy.privileged and not scripts:
        raise InvalidOptionError(
            f"the policy {config.policy} needs a script of the simulator, and {config.simulator} "
            "has none for it",
            _script_hint(config, kind),
        )
    _check_cameras(config, buffer_set.datasets[DEMONSTRATIONS], policy)


def _check_cameras(config: RunConfig, demonstrations: Dataset, policy: Policy) -> None:
    """Reject cameras that the demonstrations, or the live observations, lack."""
    live = demonstrations if config.offline else simulator_class(config.simulator)
    used = used_cameras(config, policy.cameras, demonstrations)
    for where, lacking in (
        (f"the history of {demonstrations.files.describe()}", {*policy.history_cameras}),
        ("the live observations of the recordings", used if config.offline else set()),
    ):
        for camera in sorted(lacking - {*demonstrations.cameras}):
            if not demonstrations.cameras:
                demonstrations.camera(camera)  # raises: stored without images
            raise UnknownNameError(
                f"the policy {config.policy} reads the camera {camera!r}, which is not in {where}",
                f"Its cameras: {', '.join(demonstrations.cameras)}. "
                f"{_policies_for_any_robot(config)}",
                _baseline(config),
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


def _policies_for_any_robot(config: RunConfig) -> str:
    """Return the advice to set a policy that needs neither this robot nor its cameras."""
    if config.offline:
        return "Set hold, mean or a policy for this robot, python:module:factory."
    return (
        "Set a policy for this robot, such as python:module:factory; to act along the recordings "
        f"of this buffer set, without a simulator, also {named('offline')}."
    )


def _baseline(config: RunConfig) -> str | None:
    """Return the command that evaluates a policy for any robot, if one can act here."""
    if not config.offline:
        return None
    command = ["evaluate", config.buffer_set, "--offline", "--policy", "hold"]
    return shlex.join([*command, "--out", str(config.out)])


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
            _policies_for_any_robot(config),
            _baseline(config),
        )


def _check_policies(config: RunConfig) -> None:
    """Check the settings of shared policies."""
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
    if not 1 <= config.policies <= config.workers:
        expected = f"1 to {named('workers')}, {config.workers}"
        raise InvalidOptionError.expected("policies", config.policies, expected)
    if config.max_batch_size < 1:
        raise InvalidOptionError.expected("max_batch_size", config.max_batch_size, "1 or more")
    wait_s = config.batch_wait_timeout_s
    if not 0 <= wait_s < math.inf:
        raise InvalidOptionError.expected("batch_wait_timeout_s", wait_s, "0 or more")


def _check_shared(config: RunConfig, kind: PolicyKind, policy: Policy) -> None:
    """Check that a policy can be shared, if it is to be."""
    fault = None if config.policies is None else _fault_of_sharing(kind, policy)
    if fault is not None:
        raise InvalidOptionError(
            f"the policy {config.policy} cannot be shared by workers ({named('policies')}): "
            f"{fault}",
            f"Leave out {named('policies')}; docs/how-to/your-own-policy.md describes shared "
            "policies.",
        )


def _fault_of_sharing(kind: PolicyKind, policy: Policy) -> str | None:
    """Return why several workers cannot share a policy, or None."""
    if kind.server is not None and kind.server.one_client:
        return "its server holds one memory"
    if policy.privileged:
        return "it needs the simulator, which runs in the worker"
    missing = [f"{name}()" for name in BATCH_METHODS if not callable(getattr(policy, name, None))]
    return f"it has no {' and no '.join(missing)}" if missing else None


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
        _check_playable(config, families, episode, record.simulator)
    # What a retrieval step selects is checked in each rollout.
    if system.position_limit is not None and config.retrieval is None:
        planned, longest = set(items), dict.fromkeys(plan.conditions, 0)
        for manifest in buffer_set.manifests():
            name = manifest.condition
            if WorkItem(name, manifest.episode_id) in planned:
                longest[name] = max(manifest.history_frames, longest[name])
        check_history(system, longest)


def _check_playable(
    config: RunConfig, families: set[str], episode: EpisodeId, recorded: str | None
) -> None:
    """Reject an episode that the simulator does not play.

    `families` are those that it plays, empty if unknown; `recorded` is the episode's simulator.
    """
    if simulator_class(config.simulator).own_episodes and recorded not in (None, config.simulator):
        if recorded in SIMULATORS:
            hint = f"Set {named('simulator', recorded)}, or give a buffer set of "
            hint += f"{config.simulator}."
        else:
            hint = (
                "No simulator plays the episodes of this buffer set: give one whose "
                f"demonstrations are of {' or '.join(SIMULATORS)}, or your own simulator."
            )
        raise InvalidOptionError(
            f"{episode} was recorded on {recorded!r}, the run is on {config.simulator!r}", hint
        )
    if families and episode.family not in families:
        raise InvalidOptionError(
            f"{config.simulator} does not play the family {episode.family} of {episode}",
            f"It plays {', '.join(sorted(families))}. Set {named('families')} to some of "
            "them, or "
            f"{named('simulator')} to one that plays these episodes, such as module:class.",
        )
