"""What a kind of policies declares of itself; see `kinds.py`."""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from robomme_interference_data.runtime.specs import SpecKind


class Role(Enum):
    """What the results of a policy are for."""

    CONTROL = "control"
    """A policy without learned weights, ranked beside others."""

    REFERENCE = "reference"
    """A control that shows a bound: with the answer or a part of it, by chance, or without motion.

    It is never ranked.
    """

    LEARNED = "learned"
    """The policy is under test."""

    OWN = "own"
    """Code of the user, by the name of a function or class; it may be anything."""


@dataclass(frozen=True, kw_only=True)
class Server:
    """What is known of the servers of a kind of policies.

    Attributes:
        one_client: Whether each holds the memory of one rollout: it serves one worker, and no other
            run may use it meanwhile.
        starter: Name, beside the factory, of what starts a server with the command in a policy's
            text; None if nothing does.
    """

    one_client: bool
    starter: str | None


@dataclass(frozen=True, kw_only=True)
class PolicyKind(SpecKind):
    """A kind of policies. Its capabilities have no defaults: a wrong one would go unnoticed.

    A group `memory` of `target` is the policy's memory, in the spelling of `Memory`.

    Attributes:
        role: What its results are for.
        identified: Whether its text and options identify it, so that rows have a label by default.
            Folders, revisions and servers have the same names for different checkpoints.
        published: Whether it may be one of the paper's systems.
        option_labels: Options that make another system: what the default label gets if they do not
            have their defaults, with `{}` for the value.
        action_size: Number of values that it reads of a state and returns in an action; None: any.
        reads_subgoals: Whether it may act on subgoals.
        script: The script of a simulator (`Simulator.policies`) that acts for it; None without one.
            A privileged policy of the user may use any.
        needs_evidence: Whether it must know which frames show the answer.
        acts_out_answers: Whether it carries out answers; its target is where they are.
        server: Its server, to which its target leads; None if it has none.
        packages: Distributions whose versions a run records.
    """

    role: Role
    identified: bool
    published: bool
    option_labels: Mapping[str, str]
    action_size: int | None
    reads_subgoals: bool
    script: str | None
    needs_evidence: bool
    acts_out_answers: bool
    server: Server | None
    packages: tuple[str, ...]
