"""All that can be known to be wrong with a run before its first rollout."""

import re
from collections.abc import Sequence

from robomme_interference_data.constants import DEMONSTRATIONS
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import InterferenceError, InvalidOptionError
from robomme_interference_data.evaluate.policies.policy import Policy
from robomme_interference_data.evaluate.policies.registry import (
    BUILTINS,
    parse_policy,
    policy_options,
)
from robomme_interference_data.evaluate.run.config import (
    RunConfig,
    check_shared,
    non_default_retrieval,
)
from robomme_interference_data.evaluate.run.plan import Plan, WorkItem
from robomme_interference_data.evaluate.subgoals.prompt import load_prompt
from robomme_interference_data.evaluate.subgoals.writer import ORACLE
from robomme_interference_data.evaluate.systems import (
    System,
    base_of,
    check_history,
    known_system,
    name_system,
)
from robomme_interference_data.retrieval.select import Rule
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.simulators.registry import (
    SIMULATORS,
    check_shift,
    find_simulator,
    simulator_class,
)

from .clips import check_drawing

READS_SUBGOALS = ("websocket", "python", "follow-subgoals")
"""Kinds of policies that may read subgoals."""


def default_system(config: RunConfig) -> str:
    """Return the name under which rows stand if none is given.

    That is the policy's own, `retrieval-…` with a retrieval step, and what is not usual of the
    step behind it, such as `retrieval-replay-window-oracle`; with the simulator's subgoals
    `…-oracle`, and of `replay` that goes on `…-extrapolate`.
    """
    spec = parse_policy(config.policy)
    # Folders are called alike, and so are revisions; and served models.
    learned = config.policy if spec.kind in ("websocket", "lerobot") else config.subgoals
    if learned not in (None, ORACLE):
        raise InvalidOptionError(
            f"the rows of {learned} need a name: it does not tell one checkpoint from another",
            "Set `system`, such as perceptual-framesamp-modul, or a name of your own: see "
            "docs/systems.md.",
        )
    name = "-".join(filter(None, (spec.kind, spec.target, config.subgoals)))
    if (
        spec.kind == "replay"
        and policy_options(config.policy, config.policy_options)["extrapolate"]
    ):
        name += "-extrapolate"
    if spec.kind == "python":
        name = re.sub(r"[^A-Za-z0-9._-]+", "-", name.partition("-")[2]).strip("-")
    if config.retrieval is None:
        return name
    return "-".join(("retrieval", name, *non_default_retrieval(config).values())).replace("/", "-")


def check_settings(config: RunConfig, system: str, buffer_set: BufferSet, policy: Policy) -> None:
    """Check the settings against each other, the buffer set and the policy."""
    find_simulator(config.simulator)
    check_shift(config.simulator, config.shift)
    check_shared(config)
    if policy.privileged and not simulator_class(config.simulator).scripted:
        raise InvalidOptionError(
            f"the policy {config.policy} asks the simulator for actions, and {config.simulator} "
            "gives none",
            "Run it on another simulator, such as tabletop, or take another policy.",
        )
    step = [] if config.retrieval is None else [config.retrieval_camera]
    for camera in (*policy.history_cameras, *step):
        buffer_set.datasets[DEMONSTRATIONS].shape(camera)  # refuses one that is not there
    _check_name(config, name_system(system))
    _check_subgoals(config, name_system(system))
    if config.videos:
        check_drawing()


def _check_name(config: RunConfig, system: System) -> None:
    """Refuse a name of the table for a policy, or a retrieval step, that is not that system's."""
    kind, step = parse_policy(config.policy).kind, config.retrieval is not None
    why = None
    if not system.paper:
        if known_system(system.name) is not None and (
            kind not in BUILTINS or default_system(config) != system.name
        ):
            why = f"the policy {config.policy} is not the control {system.name}"
            why += " with a retrieval step in front" if step else ""
    elif kind not in ("websocket", "python"):
        why = f"the policy {config.policy} is not the paper's system {system.name}"
    elif (system.subgoals is None) is (config.subgoals is not None) and kind == "websocket":
        needs = "no subgoals" if system.subgoals is None else "subgoals of a model (`subgoals`)"
        why = f"system {system.name} acts on {needs}, and `subgoals` is {config.subgoals}"
    elif config.subgoals == ORACLE:
        why = f"the subgoals of {system.name} are a model's, and {ORACLE} knows the answer"
    elif system.retrieval != step:
        has, given = ("a", "none is given") if system.retrieval else ("no", "one is given")
        why = f"system {system.name} has {has} retrieval step, and {given} (`retrieval`)"
    elif step and Rule.parse(config.retrieval_rule).method != "max":
        why = f"the retrieval step of {system.name} chooses by max, not by {config.retrieval_rule}"
    if why is not None:
        raise InvalidOptionError(why, "Set `system` to a name of your own: see docs/systems.md.")


def _check_subgoals(config: RunConfig, system: System) -> None:
    """Refuse subgoals that nobody reads, and settings of them that say nothing."""
    for name in ("subgoal_prompt", "subgoal_options"):
        if getattr(config, name) and config.subgoals in (None, ORACLE):
            raise InvalidOptionError(
                f"`{name}` has no effect without a model that writes subgoals",
                'Set subgoals="openai:URL#MODEL", or leave it out.',
            )
    if config.subgoals is None:
        return
    kind = parse_policy(config.policy).kind
    if kind not in READS_SUBGOALS:
        raise InvalidOptionError(
            f"the policy {config.policy} reads no subgoals",
            f"Take {', '.join(READS_SUBGOALS)}, or leave out `subgoals`.",
        )
    if config.subgoals != ORACLE:
        keeps = load_prompt(config.subgoal_prompt or system.prompt)[0].watches
        if system.subgoals is not None and keeps is not (system.prompt == "memer"):
            raise InvalidOptionError(
                f"the prompt {config.subgoal_prompt} shows the model "
                f"{'' if keeps else 'no '}recent frames; that of {system.name} "
                f"{'does not' if keeps else 'does'}",
                "Give that system's prompt, or set `system` to a name of your own.",
            )


def check_plan(
    config: RunConfig, system: System, buffer_set: BufferSet, plan: Plan, items: Sequence[WorkItem]
) -> None:
    """Check every rollout of a plan."""
    recalls = parse_policy(config.policy).kind == "recall"
    own = ":" in config.simulator  # a simulator of one's own may serve any episodes
    for episode in dict.fromkeys(item.episode for item in items):
        record = buffer_set.query(episode).record
        if recalls and record.evidence is None:
            raise InvalidOptionError(
                f"{config.policy} needs to know which frames show the answer, and of {episode} "
                "this is unknown",
                "Build the demonstrations from a source with evidence: see docs/sources.md.",
            )
        recorded = record.simulator
        if not own and recorded not in (None, config.simulator):
            raise InvalidOptionError(
                f"{episode} was recorded on {recorded!r}, the run is on {config.simulator!r}",
                f'Set simulator="{recorded}", or give a buffer set of {config.simulator}.'
                if recorded in SIMULATORS
                else "No simulator plays the episodes of this buffer set: give one whose demonstrations "
                f"are of {' or '.join(SIMULATORS)}, or a simulator of your own that plays them.",
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
        who = "the policy" if system.with_history else system.name
        return InvalidOptionError(
            f"{who} takes no history, so {condition} says nothing of it",
            f"Set `conditions` to {NO_HISTORY}.",
        )
    if not system.applies(condition):
        return InvalidOptionError(
            f"{system.name} has nothing to retrieve from under {NO_HISTORY}",
            f"Run {base_of(system.name)} under {NO_HISTORY}: there the two are the same system.",
        )
    return None
