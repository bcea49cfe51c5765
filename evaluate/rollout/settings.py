"""The settings of rollouts: completed, and checked as far as no policy or server is needed."""

import dataclasses
import re
from collections.abc import Iterable
from typing import Any

from robomme_interference_data.constants import ORACLE, RECORDINGS
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.evaluate.policies.kinds import PolicyKind, Role
from robomme_interference_data.evaluate.policies.registry import (
    POLICIES,
    policy_kind,
    policy_memory,
    policy_options,
)
from robomme_interference_data.evaluate.run.config import RunConfig, check_unused, with_retrieval
from robomme_interference_data.evaluate.systems import SYSTEMS, System, name_system
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.simulators.registry import (
    simulator_arguments,
    simulator_class,
    simulator_renderer,
)

_OF_SIMULATORS = (
    "simulator",
    "simulator_python",
    "simulator_options",
    "shift",
    "check_lesson",
    "videos",
)
"""Settings without effect along recordings."""


def complete_settings(config: RunConfig) -> tuple[RunConfig, System]:
    """Return the settings with what follows from them, and the system of the label of their rows.

    Models on the Hub get their commit, which is the same for all workers; the writer of subgoals
    gets the options of a published system; an offline run gets the simulator of recordings.

    Raises:
        InvalidOptionError: Settings contradict each other, or the system that the label means.
    """
    if config.offline:
        check_unused(config, _OF_SIMULATORS, "an offline evaluation", "Leave it out.")
        if config.subgoals == ORACLE:
            raise InvalidOptionError(
                f"subgoals of {ORACLE} need a simulator",
                f"Set a model, or leave out {named('offline')}.",
            )
        config = dataclasses.replace(config, simulator=RECORDINGS)
    label = config.system or default_system(config)
    config = dataclasses.replace(config, policy=POLICIES.pin(config.policy))
    if config.subgoals is not None:
        from robomme_interference_data.evaluate.language.subgoal_settings import (
            pin_subgoals,
            with_published,
        )

        subgoals = pin_subgoals(config.subgoals)
        config = with_published(dataclasses.replace(config, subgoals=subgoals))
    check_system(config, label)
    return config, name_system(label)


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
            "see docs/how-to/official-simulator.md.",
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


def _check_name(config: RunConfig, system: System) -> None:
    """Reject the name of a published system or control for a run of another one."""
    fault = _fault_of_name(config, system)
    if fault is not None:
        raise InvalidOptionError(
            fault,
            f"Set {named('system')} to a name of your own: see docs/how-to/official-simulator.md.",
        )


def _fault_of_name(config: RunConfig, system: System) -> str | None:
    """Return why a run is not the system with this name; None for a name of the user."""
    kind = policy_kind(config.policy)
    if system.name not in SYSTEMS:
        return None
    if system.paper or system.elsewhere:
        return _fault_of_published_name(config, kind, system)
    control = kind.role in (Role.CONTROL, Role.REFERENCE)
    if control and default_system(config) == system.name:
        return None
    step = "" if config.retrieval is None else " with a retrieval step in front"
    return f"the policy {config.policy} is not the control {system.name}{step}"


def _fault_of_published_name(config: RunConfig, kind: PolicyKind, system: System) -> str | None:
    """Return why a run is not a system of the paper or of others, or None."""
    if not kind.published:
        whose = "the paper's system" if system.paper else "the system"
        return f"the policy {config.policy} is not {whose} {system.name}"
    acts_on_subgoals = system.facts.subgoals is not None
    # Code of the user may write the subgoals itself.
    if acts_on_subgoals is not (config.subgoals is not None) and kind.role is not Role.OWN:
        needs = f"subgoals of a model ({named('subgoals')})" if acts_on_subgoals else "no subgoals"
        return f"system {system.name} acts on {needs}, and {named('subgoals')} is {config.subgoals}"
    if config.subgoals == ORACLE:
        return f"system {system.name} has subgoals of a model, and {ORACLE} knows the answer"
    has_step = system.facts.retrieval is not None
    if has_step is not (config.retrieval is not None):
        expected = "a" if has_step else "no"
        return (
            f"system {system.name} has {expected} retrieval step, and {named('retrieval')} is "
            f"{config.retrieval}"
        )
    if has_step and Rule.parse(config.retrieval_rule).name != "max":
        return f"the retrieval step of {system.name} has the rule max, not {config.retrieval_rule}"
    return None


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


def used_cameras(
    config: RunConfig, policy_cameras: Iterable[str], demonstrations: Dataset
) -> set[str]:
    """Return the cameras whose live images a run reads."""
    used = {*policy_cameras}
    if config.subgoals not in (None, ORACLE):
        used.add(demonstrations.camera())
    if config.retrieval is not None:
        used.add(demonstrations.camera(config.retrieval_camera, "retrieval_camera"))
    return used


def live_renderer(
    config: RunConfig, policy_cameras: Iterable[str], demonstrations: Dataset
) -> str | None:
    """Return the renderer of a run's live observations; None if it has none, or if it is unknown.

    Points of the simulator's own subgoals are located in its images.
    """
    drawn = used_cameras(config, policy_cameras, demonstrations) or config.subgoals == ORACLE
    return simulator_renderer(config.simulator, config.simulator_python) if drawn else None


def simulator_options(
    config: RunConfig, policy_cameras: Iterable[str], demonstrations: Dataset
) -> dict[str, Any]:
    """Return the options of a run's simulator, which draws only the cameras that are used."""
    used = used_cameras(config, policy_cameras, demonstrations)
    if config.videos or config.check_lesson:
        used |= {*simulator_class(config.simulator).cameras}
    settings = {
        "cameras": tuple(sorted(used)),
        "shift": config.shift,
        "subgoals": config.subgoals == ORACLE,
        "buffer_set": config.buffer_set,
        "python": config.simulator_python,
        # Its own limit ends a little before the worker's: its error shows its output.
        "answer_s": 0.9 * config.simulator_timeout_s,
    }
    return simulator_arguments(config.simulator, settings, config.simulator_options)
