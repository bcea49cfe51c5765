"""Checks of a run of rollouts before the first one."""

import math
import re
from collections.abc import Sequence

from robomme_interference_data.constants import (
    ACTION,
    ACTION_CHUNK,
    DEMONSTRATIONS,
    EXECUTIONS,
    STATE,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    UnknownNameError,
    named,
)
from robomme_interference_data.evaluate.language.subgoal_writer import ORACLE
from robomme_interference_data.evaluate.policies.policy import BATCH_METHODS, Policy
from robomme_interference_data.evaluate.policies.registry import BUILTINS, POLICIES, policy_options
from robomme_interference_data.evaluate.run.config import (
    RunConfig,
    check_unused,
    nothing_to_retrieve,
    with_retrieval,
)
from robomme_interference_data.evaluate.run.plan import Plan, WorkItem
from robomme_interference_data.evaluate.systems import (
    System,
    base_of,
    check_history,
    known_system,
    name_system,
)
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.runtime.executor import is_share
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.simulators.base import ACTION_SIZE
from robomme_interference_data.simulators.registry import (
    RECORDINGS,
    SIMULATORS,
    check_shift,
    find_simulator,
    simulator_class,
)

from .worker import used_cameras

PANDA_POLICIES = ("replay", "noop", "websocket", "vla-eval", "lerobot")
"""Kinds of policies that read and control RoboMME's robot: 7 joints, then the gripper."""

READS_SUBGOALS = ("websocket", "python", "follow-subgoals")
"""Kinds of policies that may read subgoals."""


def default_system(config: RunConfig) -> str:
    """Return the label of rows if none is set: the policy's text, and what changes its results.

    Such as `replay-window-extrapolate`, `follow-subgoals-oracle` with the simulator's subgoals, or
    `retrieval-replay-window-joined`.
    """
    spec = POLICIES.parse(config.policy)
    # Folders, revisions and served models have the same names for different checkpoints.
    trained = ("websocket", "vla-eval", "lerobot", "answers")
    learned = config.policy if spec.kind in trained else config.subgoals
    if learned not in (None, ORACLE):
        raise InvalidOptionError(
            f"the rows of {learned} need a name: its text does not identify it",
            f"Set {named('system')}, such as perceptual-framesamp-modul, or a name of your own: "
            "see "
            "docs/how-to/paper-systems.md.",
        )
    remembers = spec.kind in ("replay", "recall")
    target = Memory.parse(spec.target).label if remembers else spec.target
    name = "-".join(filter(None, (spec.kind, target, config.subgoals)))
    if spec.kind in ("replay", "follow-subgoals"):
        options = policy_options(config.policy, config.policy_options)
        name += "-extrapolate" if options.get("extrapolate") else ""
        name += "" if options.get("points", True) else "-simple"
    if spec.kind == "hold":
        chunk = policy_options(config.policy, config.policy_options)["chunk"]
        name += "" if chunk == ACTION_CHUNK else f"-chunk{chunk}"
    if spec.kind == "python":
        name = re.sub(r"[^A-Za-z0-9._-]+", "-", name.partition("-")[2]).strip("-")
    return with_retrieval(name, config)


def check_system(config: RunConfig, system: str) -> None:
    """Check that policy and subgoals are those that a label of rows means, and fit each other."""
    _check_name(config, name_system(system))
    _check_subgoals(config)


def check_settings(config: RunConfig, buffer_set: BufferSet, policy: Policy) -> None:
    """Check the settings against each other, the buffer set and the policy."""
    if config.simulator == RECORDINGS and not config.offline:
        raise InvalidOptionError(
            "recordings are no simulator to choose",
            f"Set {named('offline')} for an offline evaluation.",
        )
    find_simulator(config.simulator)
    check_shift(config.simulator, config.shift)
    _check_policies(config, policy)
    kind = POLICIES.parse(config.policy).kind
    scripts = simulator_class(config.simulator).policies
    needed = {"answers": {"answer"}, "python": {*scripts}}.get(kind, {kind})
    if policy.privileged and not needed & {*scripts}:
        raise InvalidOptionError(
            f"the policy {config.policy} needs a script of the simulator, and {config.simulator} "
            "has none for it",
            _script_hint(config, kind),
        )
    if kind == "answers":
        check_unused(config, ["retrieval"], config.policy, "Set it for the questions instead.")
    _check_cameras(config, buffer_set.datasets[DEMONSTRATIONS], policy)
    _check_robot(config, buffer_set, kind)
    if config.videos:
        from robomme_interference_data.simulators.play import check_pillow

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


def _script_hint(config: RunConfig, kind: str) -> str:
    if config.offline:
        return f"Leave out {named('offline')}, or set another policy."
    if kind in simulator_class(RECORDINGS).policies:
        return f"Set {named('offline')}: it repeats recorded actions."
    return "Set another simulator, such as tabletop, or another policy."


def _check_robot(config: RunConfig, buffer_set: BufferSet, kind: str) -> None:
    """Reject a policy for RoboMME's robot on another one."""
    (state,) = buffer_set.datasets[DEMONSTRATIONS].features[STATE]
    action = simulator_class(config.simulator).action_size
    if config.offline and EXECUTIONS in buffer_set.datasets:
        (action,) = buffer_set.datasets[EXECUTIONS].features[ACTION]
    if kind in PANDA_POLICIES and (state, action) != (ACTION_SIZE, ACTION_SIZE):
        raise InvalidOptionError(
            f"the policy {config.policy} reads {ACTION_SIZE} state values and returns "
            f"{ACTION_SIZE} action values, 7 joints and a gripper; this robot has {state} and "
            f"{action}",
            'Set a policy for this robot, such as "python:module:factory".',
        )


def _check_policies(config: RunConfig, policy: Policy) -> None:
    """Check the settings of shared policies, and that the policy can be shared."""
    if config.policies is None:
        own = "policies that are not shared"
        unused = ("max_batch_size", "batch_wait_timeout_s", "gpus_per_policy")
        check_unused(config, unused, own, f"Set {named('policies')}.")
        return
    if config.executor == "processes":
        own = "policies on this machine, which share its GPUs"
        check_unused(config, ("gpus_per_policy",), own, f"Set {named('executor', 'ray')}.")
    for name, valid, expected in (
        (
            "policies",
            1 <= config.policies <= config.workers,
            f"1 to {named('workers')}, {config.workers}",
        ),
        ("max_batch_size", config.max_batch_size >= 1, "1 or more"),
        ("gpus_per_policy", is_share(config.gpus_per_policy), "0 to 1, or a whole number"),
        ("batch_wait_timeout_s", 0 <= config.batch_wait_timeout_s < math.inf, "0 or more"),
    ):
        if not valid:
            raise InvalidOptionError.expected(name, getattr(config, name), expected)
    missing = [f"{one}()" for one in BATCH_METHODS if not callable(getattr(policy, one, None))]
    fault = None
    if POLICIES.parse(config.policy).kind == "websocket":
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
    kind, retrieval = POLICIES.parse(config.policy).kind, config.retrieval is not None
    fault = None
    if not system.paper:
        if known_system(system.name) is not None and (
            kind not in BUILTINS or default_system(config) != system.name
        ):
            fault = f"the policy {config.policy} is not the control {system.name}"
            fault += " with a retrieval step in front" if retrieval else ""
    elif kind not in ("websocket", "python"):
        fault = f"the policy {config.policy} is not the paper's system {system.name}"
    elif (system.subgoals is None) is (config.subgoals is not None) and kind == "websocket":
        needs = (
            "no subgoals"
            if system.subgoals is None
            else f"subgoals of a model ({named('subgoals')})"
        )
        fault = (
            f"system {system.name} acts on {needs}, and {named('subgoals')} is {config.subgoals}"
        )
    elif config.subgoals == ORACLE:
        fault = f"system {system.name} has subgoals of a model, and {ORACLE} knows the answer"
    elif system.retrieval != retrieval:
        expected = "a" if system.retrieval else "no"
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
    if POLICIES.parse(config.policy).kind not in READS_SUBGOALS:
        raise InvalidOptionError(
            f"the policy {config.policy} reads no subgoals",
            f"Set {named('policy')} to {', '.join(READS_SUBGOALS)}, or leave out "
            f"{named('subgoals')}.",
        )


def check_plan(
    config: RunConfig, system: System, buffer_set: BufferSet, plan: Plan, items: Sequence[WorkItem]
) -> None:
    """Check every rollout of a plan."""
    needs_evidence = POLICIES.parse(config.policy).kind == "recall"
    families = {one.family for one in simulator_class(config.simulator).episodes()}
    for episode in dict.fromkeys(item.episode for item in items):
        record = buffer_set.query(episode).record
        if needs_evidence and record.evidence is None:
            raise InvalidOptionError(
                f"{config.policy} needs to know which frames show the answer, which is unknown "
                f"for {episode}",
                "Build the demonstrations from a source with evidence; see "
                "docs/reference/sources.md.",
            )
        recorded = record.simulator
        # A simulator of the user may play any episode, and so may a recording.
        own = ":" in config.simulator or config.offline
        if recorded not in (None, config.simulator) and not own:
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


def condition_refusal(
    system: System, reads_history: bool, condition: str
) -> InterferenceError | None:
    """Return why a condition does not apply, or None."""
    if condition != NO_HISTORY and not (system.with_history and reads_history):
        subject = "the policy" if system.with_history else system.name
        return InvalidOptionError(
            f"{subject} takes no history, so {condition} has no effect",
            f"Set {named('conditions')} to {NO_HISTORY}.",
        )
    if not system.applies(condition):
        return nothing_to_retrieve(
            f"Run {base_of(system.name)} under {NO_HISTORY}: without history, {system.name} is "
            "the same system."
        )
    return None
