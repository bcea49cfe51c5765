"""The kinds of policies, and what each declares of itself.

A new kind is a file with its policy, and an entry here. Checks read what it declares, never its
name. What only the policy's object knows, because it depends on weights or on a server (`cameras`,
`wants_history`, `memory`, whether it can batch), are attributes and methods of `Policy`.
"""

import shlex
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import NamedTuple

from robomme_interference_data.runtime.specs import SpecKind
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.simulators.episode import ACTION_SIZE


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
        published: Whether it may be a system that the paper or others published.
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


_HERE = __package__

_SERVER = r"(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):[0-9]{1,5}"

_SERVER_OPTIONS = ("server", "connect_s", "response_s")
"""Options, and metadata, of a server that change no result."""


class ServerAddress(NamedTuple):
    """Where a server listens, and whether the connection is encrypted (`wss://`)."""

    host: str
    port: int
    tls: bool = False


def addresses(target: str) -> tuple[ServerAddress, ...]:
    """Return each server of `//HOST:PORT,…`, `ws://…` or `wss://…`; empty for a command."""
    scheme, slashes, servers = target.partition("//")
    if scheme not in ("", "ws:", "wss:") or not slashes:
        return ()
    pairs = (server.rpartition(":") for server in servers.split(","))
    return tuple(
        ServerAddress(host.strip("[]"), int(port), scheme == "wss:") for host, _, port in pairs
    )


def _valid_addresses(target: str) -> bool:
    servers = addresses(target)
    return len({*servers}) == len(servers) and all(0 < server.port < 65536 for server in servers)


def _valid_command(target: str) -> bool:
    """Whether a target without addresses is a command with `{port}` in one of its words."""
    try:
        words = shlex.split(target)
    except ValueError:  # an unclosed quote
        return False
    return bool(addresses(target)) or any("{port}" in word for word in words)


def _memory(target: str) -> str:
    return str(Memory.parse(target))


def _module_hint(target: str) -> str | None:
    """Return how to name the module of `folder/file.py:factory`; None for another target."""
    path, _, factory = target.rpartition(":")
    if not path.endswith(".py"):
        return None
    file = Path(path)
    return (
        f"Name the module, not its file: python:{file.stem}:{factory}, with PYTHONPATH set to the "
        f"folder {file.parent}."
    )


_CONTROL = PolicyKind(
    form="",
    factory="",
    role=Role.REFERENCE,
    identified=True,
    published=False,
    option_labels={},
    action_size=None,
    reads_subgoals=False,
    script=None,
    needs_evidence=False,
    acts_out_answers=False,
    server=None,
    packages=(),
)
"""What most policies without learned weights declare. A new capability is declared here, too:
without it, this module cannot be imported."""

_LEARNED = replace(_CONTROL, role=Role.LEARNED, identified=False, action_size=ACTION_SIZE)
"""What most policies under test declare."""

# Each kind is one of the two above, and what sets it apart.
KINDS: dict[str, PolicyKind] = {
    "replay": replace(
        _CONTROL,
        form="replay, replay:framesamp:N, replay:window:N or replay:window:SECONDS@FPS",
        factory=f"{_HERE}.builtin:ReplayPolicy",
        target="(?P<memory>.+)",
        default="full",
        spelled=_memory,
        role=Role.CONTROL,
        option_labels={"extrapolate": "extrapolate"},
        action_size=ACTION_SIZE,
    ),
    "recall": replace(
        _CONTROL,
        form="recall, recall:framesamp:N, recall:window:N or recall:window:SECONDS@FPS",
        factory=f"{_HERE}.builtin:Recall",
        target="(?P<memory>.+)",
        default="full",
        spelled=_memory,
        script="recall",
        needs_evidence=True,
    ),
    "oracle": replace(
        _CONTROL,
        form="oracle",
        factory=f"{_HERE}.builtin:Privileged",
        arguments={"name": "oracle"},
        script="oracle",
    ),
    "guess": replace(
        _CONTROL,
        form="guess",
        factory=f"{_HERE}.builtin:Privileged",
        arguments={"name": "guess"},
        script="guess",
    ),
    "follow-subgoals": replace(
        _CONTROL,
        form="follow-subgoals",
        factory=f"{_HERE}.builtin:FollowSubgoals",
        option_labels={"points": "simple"},
        reads_subgoals=True,
        script="follow-subgoals",
    ),
    "noop": replace(
        _CONTROL, form="noop", factory=f"{_HERE}.builtin:Noop", action_size=ACTION_SIZE
    ),
    "hold": replace(
        _CONTROL,
        form="hold",
        factory=f"{_HERE}.baselines:Hold",
        option_labels={"chunk": "chunk{}"},
        script="hold",
    ),
    "mean": replace(_CONTROL, form="mean", factory=f"{_HERE}.baselines:Mean", script="mean"),
    "answers": replace(
        _LEARNED,
        form="answers:folder of a run of questions, or answers:file.csv",
        factory=f"{_HERE}.answers:ActOutAnswers",
        target="(?P<path>.+)",
        not_in_identity=("path",),
        action_size=None,
        script="answer",
        acts_out_answers=True,
    ),
    "websocket": replace(
        _LEARNED,
        form="websocket://host:port, with TLS websocket:wss://host:port, with commas between "
        "several servers, each once, or websocket:COMMAND with {port}, which each worker starts",
        factory=f"{_HERE}.websocket:WebsocketPolicy",
        target=rf"(?:wss:)?//{_SERVER}(?:,{_SERVER})*|(?!//).*\{{port\}}.*",
        extra="evaluate",
        not_in_identity=_SERVER_OPTIONS,
        valid=lambda target: _valid_addresses(target) and _valid_command(target),
        published=True,
        reads_subgoals=True,
        server=Server(one_client=True, starter="ServedPolicy"),
    ),
    "vla-eval": replace(
        _LEARNED,
        form="vla-eval:ws://host:port, or wss://, with commas between several servers, each once",
        factory="robomme_interference_data.evaluate.vla_eval.policy:VlaEvalPolicy",
        target=rf"wss?://{_SERVER}(?:,{_SERVER})*",
        extra="vla-eval",
        not_in_identity=_SERVER_OPTIONS,
        valid=_valid_addresses,
        # Some servers have one client: their hello shows it, see `VlaEvalPolicy.metadata`.
        server=Server(one_client=False, starter=None),
        packages=("vla-eval",),
    ),
    "lerobot": replace(
        _LEARNED,
        form="lerobot:namespace/name[@revision] or lerobot:folder",
        factory=f"{_HERE}.lerobot.policy:LeRobotPolicy",
        target="(?P<path>.+)",
        extra="build",
        not_in_identity=("source", "device"),
        on_hub=True,
        packages=("lerobot",),
    ),
    "python": replace(
        _LEARNED,
        form="python:module:factory",
        target=r"[A-Za-z_][\w.]*:[A-Za-z_]\w*",
        hint=_module_hint,
        role=Role.OWN,
        identified=True,
        published=True,
        action_size=None,
        reads_subgoals=True,
    ),
}
"""Name to kind, in the order of messages."""
