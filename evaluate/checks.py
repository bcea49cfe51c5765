"""All that can be known to be wrong with a run before its first rollout."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    PolicyError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.policies.checks import plain
from robomme_interference_data.evaluate.policies.registry import (
    check_workers,
    make_policy,
    parse_policy,
)
from robomme_interference_data.evaluate.rows import NO_HISTORY
from robomme_interference_data.evaluate.systems import (
    System,
    check_condition,
    check_history,
    name_system,
)
from robomme_interference_data.evaluate.worker import make_selector
from robomme_interference_data.ids import condition_name
from robomme_interference_data.loader import Split
from robomme_interference_data.simulators.registry import SIMULATORS, make_simulator

__all__ = ["PolicyTraits", "applicable", "check_plan", "check_settings", "describe_policy"]


@dataclass(frozen=True)
class PolicyTraits:
    """What a policy says of itself; see `Policy`."""

    history_cameras: tuple[str, ...]
    wants_history: bool
    privileged: bool
    metadata: Mapping[str, Any]


def describe_policy(config: RunConfig) -> PolicyTraits:
    """Make the policy once, ask what it is, and release it.

    Raises:
        InterferenceError: It cannot be made, its server cannot be reached, or it does not say
            what it is.
    """
    check_workers(parse_policy(config.policy), config.workers)
    policy = make_policy(config.policy, **config.policy_arguments)
    try:
        said = policy.metadata()
        if not isinstance(said, Mapping):
            raise PolicyError(
                f"policy {config.policy!r}: metadata() returned a {type(said).__name__}",
                'Expected a dict that says which policy this is, such as {"policy": "mine"}.',
            )
        return PolicyTraits(
            tuple(policy.history_cameras), policy.wants_history, policy.privileged, plain(said)
        )
    finally:
        policy.close()


def check_settings(config: RunConfig, split: Split, policy: PolicyTraits) -> None:
    """Check the settings against each other, the split and the policy.

    Raises:
        UnknownNameError: There is no such simulator, or a name passes for a system.
        InvalidOptionError: A setting is out of range or does not go with another.
    """
    name = config.simulator
    if name not in SIMULATORS and ":" not in name:
        raise UnknownNameError(f"there is no simulator {name!r}", nearest(name, SIMULATORS))
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
    if config.retrieval is not None and system.paper and not system.retrieval:
        raise InvalidOptionError(
            f"system {system.name} has no retrieval step, and --retrieval puts one in front",
            "Leave out one of the two, or give a --system of your own.",
        )
    if config.retrieval is None and system.retrieval:
        raise InvalidOptionError(
            f"system {system.name} has a retrieval step, and none is given",
            "Add --retrieval ENCODER, such as --retrieval siglip.",
        )
    if config.retrieval is not None:
        make_selector(config)
    cameras = split.load(split.episode_ids[0], split.k_values[0]).cameras
    for camera in policy.history_cameras:
        if camera not in cameras:
            raise InvalidOptionError(
                f"the policy wants the camera {camera!r} of the history; the split has "
                f"{', '.join(cameras)}",
                "Build the split with that camera (build … --cameras), or take another policy.",
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
        InvalidOptionError: A condition does not apply, or the split is of another simulator.
        UnknownNameError: The split has no buffers for a condition.
        HistoryTooLongError: A buffer exceeds the system's position limit.
        MissingExtraError: RoboMME's interpreter does not have it.
    """
    system = name_system(config.system)
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
    if config.simulator == "robomme":  # its interpreter may be missing, or lack RoboMME
        make_simulator("robomme", python=config.robomme_python).close()


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
