"""The label of a run's rows: the default one, and whether a name fits what is run."""

import re

from robomme_interference_data.constants import ORACLE
from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.evaluate.policies.capabilities import PolicyKind, Role
from robomme_interference_data.evaluate.policies.registry import (
    POLICIES,
    policy_kind,
    policy_memory,
    policy_options,
)
from robomme_interference_data.evaluate.run.config import RunConfig, with_retrieval
from robomme_interference_data.evaluate.systems import SYSTEMS, System
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.schema.sampling import Memory


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


def check_name(config: RunConfig, system: System) -> None:
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
    if not system.paper:
        control = kind.role in (Role.CONTROL, Role.REFERENCE)
        if system.name not in SYSTEMS or (control and default_system(config) == system.name):
            return None
        step = "" if config.retrieval is None else " with a retrieval step in front"
        return f"the policy {config.policy} is not the control {system.name}{step}"
    return _fault_of_published_name(config, kind, system)


def _fault_of_published_name(config: RunConfig, kind: PolicyKind, system: System) -> str | None:
    """Return why a run is not a system of the paper, or None."""
    if not kind.published:
        return f"the policy {config.policy} is not the paper's system {system.name}"
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
    if has_step and Rule.parse(config.retrieval_rule).method != "max":
        return f"the retrieval step of {system.name} has the rule max, not {config.retrieval_rule}"
    return None
