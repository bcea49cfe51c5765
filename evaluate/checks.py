"""All that can be known to be wrong with a run before its first rollout."""

import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    PolicyError,
    PolicyServerError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.config import RunConfig, default_system
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.policies.base import Policy
from robomme_interference_data.evaluate.policies.checks import plain
from robomme_interference_data.evaluate.policies.registry import (
    BUILTINS,
    check_workers,
    make_policy,
    parse_policy,
)
from robomme_interference_data.evaluate.retrieval import check_retrieval, make_selector
from robomme_interference_data.evaluate.rows import NO_HISTORY
from robomme_interference_data.evaluate.systems import (
    SYSTEMS,
    System,
    check_condition,
    check_history,
    name_system,
)
from robomme_interference_data.evaluate.videos import check_videos
from robomme_interference_data.evaluate.worker import simulator_options
from robomme_interference_data.ids import condition_name
from robomme_interference_data.loader import Split
from robomme_interference_data.progress import MESSAGES
from robomme_interference_data.simulators.registry import (
    SIMULATORS,
    find_simulator,
    make_simulator,
)
from robomme_interference_data.workers import run_tasks

__all__ = [
    "PolicyTraits",
    "applicable",
    "check_plan",
    "check_settings",
    "check_simulator",
    "describe_policy",
]


@dataclass(frozen=True)
class PolicyTraits:
    """What a policy says of itself; see `Policy`."""

    cameras: tuple[str, ...]
    history_cameras: tuple[str, ...]
    wants_history: bool
    privileged: bool
    metadata: Mapping[str, Any]


def describe_policy(config: RunConfig) -> PolicyTraits:
    """Make the policy once, ask what it is, and release it; of several servers ask each.

    Raises:
        InterferenceError: It cannot be made, a server cannot be reached, servers say different
            things of themselves, or it does not say what it is.
    """
    spec = parse_policy(config.policy)
    check_workers(spec, config.workers)
    with redirect_stdout(sys.stderr):  # stdout is for the rows
        traits = [
            _traits(config, make_policy(config.policy, worker=worker, **config.policy_arguments))
            for worker in range(max(1, len(spec.servers)))
        ]
    first = traits[0]
    metadata = dict(first.metadata)
    if spec.kind == "websocket":
        names = [str(one.metadata["server"]) for one in traits]
        for name, other in zip(names, traits, strict=True):
            if other.metadata["server_metadata"] != metadata["server_metadata"]:
                raise PolicyServerError(
                    f"the policy servers {names[0]} and {name} serve different models: one says "
                    f"{metadata['server_metadata']}, the other {other.metadata['server_metadata']}",
                    "Start all of them with the same checkpoint and seed.",
                )
        metadata["server"] = ", ".join(names)
    if first.privileged:
        metadata["privileged"] = True
        if spec.kind not in BUILTINS:
            MESSAGES.print(
                f"The policy {config.policy} is privileged: it gets the simulator itself, under "
                f"every condition, {NO_HISTORY} too; run.json says so."
            )
    return replace(first, metadata=metadata)


def _traits(config: RunConfig, policy: Policy) -> PolicyTraits:
    try:
        said = policy.metadata()
        if not isinstance(said, Mapping):
            raise PolicyError(
                f"policy {config.policy!r}: metadata() returned a {type(said).__name__}",
                'Expected a dict that says which policy this is, such as {"policy": "mine"}.',
            )
        return PolicyTraits(
            tuple(policy.cameras),
            tuple(policy.history_cameras),
            policy.wants_history,
            policy.privileged,
            plain(said),
        )
    finally:
        policy.close()


def check_settings(config: RunConfig, split: Split, policy: PolicyTraits) -> None:
    """Check the settings against each other, the split and the policy.

    Raises:
        UnknownNameError: There is no such simulator, or a name passes for a system.
        InvalidOptionError: A setting is out of range or does not go with another.
        MissingExtraError: A library for videos or retrieval is not installed.
    """
    name = config.simulator
    find_simulator(name)
    for setting in ("workers", "history_chunk", "max_errors", "rollout_s", "simulator_s"):
        if getattr(config, setting) <= 0:
            raise InvalidOptionError(
                f"{setting} {getattr(config, setting)}; expected more than 0",
                "Leave it out for the default.",
            )
    if policy.privileged and name == "robomme":
        raise InvalidOptionError(
            f"the policy {config.policy} asks the simulator for actions, and robomme gives none",
            "Run it on --simulator tabletop, or take another policy.",
        )
    system = name_system(config.system)
    _check_label(config, system)
    check_retrieval(config, system)
    if config.videos:
        check_videos()
    cameras = split.load(split.episode_ids[0], split.k_values[0]).cameras
    for camera in policy.history_cameras:
        if camera not in cameras:
            raise InvalidOptionError(
                f"the policy wants the camera {camera!r} of the history; the split has "
                f"{', '.join(cameras)}",
                "Build the split with that camera (build … --cameras), or take another policy.",
            )


def _check_label(config: RunConfig, system: System) -> None:
    """Refuse a name of the table for a policy that is not that system."""
    kind = parse_policy(config.policy).kind
    own = "Leave out --system, or give a name of your own."
    if system.paper and kind not in ("websocket", "python"):
        raise InvalidOptionError(
            f"the policy {config.policy} is not the paper's system {system.name}",
            f"Such a name stands for a websocket: or python: policy. {own}",
        )
    if system.subgoals is not None and kind == "websocket":
        raise InvalidOptionError(
            f"{system.name} acts on subgoals that a vision-language model writes, and this package "
            f"sends the server none: what runs would not be {system.name}",
            "Give --system a name of your own, or a python: policy that has such a model.",
        )
    if system.name in SYSTEMS and not system.paper:
        step = (config.retrieval, config.retrieval_rule, config.retrieval_camera)
        names = default_system(config.policy, config.memory, *step) if kind in BUILTINS else ""
        if names.removeprefix("retrieval-") != system.name.removeprefix("retrieval-"):
            memory = f" with the memory {config.memory}" if config.memory is not None else ""
            raise InvalidOptionError(
                f"the policy {config.policy}{memory} is not the control {system.name}", own
            )


def applicable(config: RunConfig, split: Split, policy: PolicyTraits) -> tuple[str, ...]:
    """Return the conditions that the split has and that apply to system and policy."""
    conditions = [NO_HISTORY, *(condition_name(k) for k in split.k_values)]
    system = name_system(config.system)
    return tuple(name for name in conditions if _refusal(system, policy, name) is None)


def check_plan(
    config: RunConfig, split: Split, policy: PolicyTraits, plan: Sequence[WorkItem]
) -> None:
    """Check every planned rollout.

    Raises:
        InvalidOptionError: There is none, a condition does not apply, or the split is of another
            simulator.
        UnknownNameError: The split has no buffers for a condition.
        HistoryTooLongError: A buffer exceeds the system's position limit.
        MissingIndexError, StaleIndexError: The split has no fitting index for the retrieval step.
    """
    system = name_system(config.system)
    if not plan:
        raise InvalidOptionError(
            "there is nothing to run: no family, or no condition that applies",
            "Give --families and --conditions, or leave them out for all.",
        )
    known = [NO_HISTORY, *(condition_name(k) for k in split.k_values)]
    for condition in dict.fromkeys(item.condition for item in plan):
        if (refusal := _refusal(system, policy, condition)) is not None:
            raise refusal
        if condition not in known:
            raise UnknownNameError(
                f"the split has no buffers for {condition}; it has {', '.join(known)}",
                "Plan them: robomme-interference build manifests … --k 0 1 3 7",
            )
    for item in plan:
        manifest = split.manifest(item.episode, split.k_values[0] if item.k is None else item.k)
        own = ":" in config.simulator  # a simulator of one's own may serve any episodes
        if not own and manifest.simulator not in (None, config.simulator):
            raise InvalidOptionError(
                f"{item.episode} was recorded on the simulator {manifest.simulator!r}, the run "
                f"is on {config.simulator!r}",
                f"Give --simulator {manifest.simulator}, or a split of {config.simulator}.",
            )
        if item.k is not None and config.retrieval is None:
            check_history(system, manifest.history_frames)
    longest = max(plan, key=lambda item: -1 if item.k is None else item.k)
    selector = make_selector(config)
    if selector is not None and longest.k is not None:
        buffer = split.load(longest.episode, longest.k)
        selector.select(buffer, buffer.query_frame(selector.camera))


def check_simulator(config: RunConfig, policy: PolicyTraits) -> None:
    """Make the simulator once, in a process of its own, as a broken driver may end its process.

    One of the user's own is made by the workers only.

    Raises:
        NoRendererError: This machine cannot draw its pictures.
        MissingExtraError: Its libraries are not installed, or RoboMME's interpreter lacks it.
        SimulatorCrashError: It cannot be made for another reason.
    """
    if config.simulator not in SIMULATORS:
        return
    options = simulator_options(config, policy.cameras, make_selector(config))
    make = partial(_make_once, config.simulator)
    for outcome in run_tasks(make, [options], workers=1, time_limit=config.simulator_s, attempts=1):
        if isinstance(outcome.error, InterferenceError):
            raise outcome.error
        if outcome.error is not None:
            raise SimulatorCrashError(
                f"the {config.simulator} simulator cannot be made: {outcome.error}",
                "robomme-interference doctor tells what works on this machine.",
            )


def _make_once(name: str, options: Mapping[str, Any]) -> None:
    make_simulator(name, **options).close()


def _refusal(system: System, policy: PolicyTraits, condition: str) -> InterferenceError | None:
    """Return why a condition does not apply, or None."""
    try:
        check_condition(system, condition)
    except InvalidOptionError as error:
        return error
    if condition != NO_HISTORY and not policy.wants_history:
        return InvalidOptionError(
            f"the policy takes no history, so {condition} says nothing of it",
            f"Give --conditions {NO_HISTORY}.",
        )
    return None
