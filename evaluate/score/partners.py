"""Which system another one is compared with: by their facts, never by their labels."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

from robomme_interference_data.constants import ORACLE
from robomme_interference_data.evaluate.systems import SystemFacts

from .outcomes import Outcomes


def base_of(outcomes: Outcomes, system: str) -> str | None:
    """Return the same policy with the same memory and subgoals, and without the retrieval step."""
    without = {
        replace(facts, retrieval=None)
        for facts in outcomes.facts_of(system)
        # Two unknown policies are not the same one.
        if facts.retrieval is not None and facts.policy_id is not None
    }
    return next((name for name in outcomes.systems if without & outcomes.facts_of(name)), None)


def share_weights(outcomes: Outcomes, system: str, other: str) -> bool:
    """Whether two systems are one policy, so that equal training seeds mean the same weights."""
    return system == other or related(outcomes.facts_of(system), outcomes.facts_of(other))


def related(facts: Iterable[SystemFacts], others: Iterable[SystemFacts]) -> bool:
    """Whether facts of two systems are of one policy."""
    ids, other_ids = ({(each.policy, each.policy_id) for each in side} for side in (facts, others))
    # Two unknown policies are not the same one.
    return any(policy_id is not None for _, policy_id in ids & other_ids)


def ceilings_of(outcomes: Outcomes, system: str) -> list[str]:
    """Return the ideal observers with the same memory, the one with the same retrieval first.

    References have none, and neither have systems that keep no frames.
    """
    own = next(iter(outcomes.facts_of(system)))
    if own.memory is None or own.reference:
        return []
    same, others = [], []
    for name in outcomes.systems:
        facts = next(iter(outcomes.facts_of(name)))
        if (facts.policy, facts.memory) == ("recall", own.memory):
            if facts.retrieval == own.retrieval:
                same.append(name)
            elif None not in (facts.retrieval, own.retrieval):
                others.append(name)
    return same + others


def control_of(outcomes: Outcomes, system: str) -> str | None:
    """Return the system whose failures are failures of execution alone, if it has rows.

    It knows the answer: best the system itself with the simulator's subgoals, else the policies
    that follow these, else the simulator's own script.
    """
    return next(_controls(outcomes, system), None)


def _controls(outcomes: Outcomes, system: str) -> Iterator[str]:
    # Without those of an unknown policy: two unknown policies are not the same one.
    known = [facts for facts in outcomes.facts_of(system) if facts.policy_id is not None]
    with_oracle = set(map(_with_oracle, known))
    others = [name for name in outcomes.systems if name != system]
    for name in others:
        facts_of_other = outcomes.facts_of(name)
        has_oracle = any(facts.subgoals == ORACLE for facts in facts_of_other)
        if has_oracle and with_oracle & set(map(_with_oracle, facts_of_other)):
            yield name
    for policy, subgoals in (("follow-subgoals", ORACLE), ("oracle", None)):
        for name in others:
            if any(
                (facts.policy, facts.subgoals) == (policy, subgoals)
                for facts in outcomes.facts_of(name)
            ):
                yield name


def _with_oracle(facts: SystemFacts) -> SystemFacts:
    """Return the facts of the same policy with the simulator's subgoals."""
    return replace(facts, subgoals=ORACLE, reads_history=True, reference=True)
