"""Policies by their text; each is imported when it is made."""

import inspect
import shlex
from collections.abc import Sequence
from typing import Any, get_type_hints

from robomme_interference_data.errors import InvalidOptionError, PolicyError
from robomme_interference_data.runtime.specs import (
    Factory,
    Kind,
    Registry,
    Spec,
    bind_options,
    import_factory,
    signature_of,
)
from robomme_interference_data.simulators.base import CAMERAS

from .policy import Policy

BUILTINS = ("replay", "recall", "oracle", "guess", "follow-subgoals", "noop")
"""Policies without learned weights."""

_SERVER = r"(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):[0-9]{1,5}"
_MEMORY = r"(?P<memory>[a-z]+)"


def _kind(form: str, factory: str, target: str = "", extra: str = "evaluate", **more: Any) -> Kind:
    return Kind(form, f"{__package__}.{factory}", target, extra=extra, **more)


POLICIES = Registry(
    "policy",
    {
        **{
            name: _kind(
                f"{name}, {name}:framesamp or {name}:window",
                f"builtin:{factory}",
                _MEMORY,
                default="full",
            )
            for name, factory in (("replay", "ReplayPolicy"), ("recall", "Recall"))
        },
        **{
            name: _kind(name, "builtin:Privileged", given={"name": name})
            for name in ("oracle", "guess")
        },
        "follow-subgoals": _kind("follow-subgoals", "builtin:FollowSubgoals"),
        "noop": _kind("noop", "builtin:Noop"),
        "websocket": _kind(
            "websocket://host:port, with commas between several servers, each once, or websocket "
            'with serve="COMMAND with {port}"',
            "websocket:WebsocketPolicy",
            rf"//{_SERVER}(?:,{_SERVER})*|(?!//).*\{{port\}}.*",
            no_effect=("server", "connect_s", "response_s"),
        ),
        "lerobot": _kind(
            "lerobot:namespace/name[@revision] or lerobot:folder",
            "lerobot:LeRobotPolicy",
            r"(?P<path>.+)",
            "build",
            no_effect=("source", "device"),
        ),
        "python": Kind("python:module:factory", "", r"[A-Za-z_][\w.]*:[A-Za-z_]\w*"),
    },
)


class PolicySpec(Spec):
    """A policy that was read.

    Its target is, of `replay` and `recall`, the memory rule; of `websocket`, servers, or the
    command that starts one; of other built-ins, empty.
    """

    @property
    def servers(self) -> tuple[tuple[str, int], ...]:
        """Host and port of each server, in order; empty where none runs yet, or is needed."""
        if self.kind != "websocket" or self.serves:
            return ()
        pairs = (one.rpartition(":") for one in self.target.removeprefix("//").split(","))
        return tuple((host.strip("[]"), int(port)) for host, _, port in pairs)

    @property
    def serves(self) -> bool:
        """Whether each worker starts a server, with the command that the target is."""
        return self.kind == "websocket" and not self.target.startswith("//")


def parse_policy(text: str) -> PolicySpec:
    """Read a policy; `replay` alone stands for `replay:full`, and so on."""
    read = POLICIES.parse(text)
    spec = PolicySpec(read.kind, read.target, read.given)
    servers = spec.servers
    if len(set(servers)) < len(servers) or not all(0 < port < 65536 for _, port in servers):
        raise InvalidOptionError.expected("policy", text, POLICIES.kinds["websocket"].form)
    return spec


def check_workers(spec: PolicySpec, workers: int) -> None:
    """Refuse more workers than there are servers: a server holds the memory of one rollout."""
    if spec.kind == "websocket" and not spec.serves and len(spec.servers) < workers:
        raise InvalidOptionError(
            f"{workers} workers need {workers} policy servers; {spec} names {len(spec.servers)}",
            f"Take workers={len(spec.servers)}, start more servers, or have each worker start its "
            "own (serve).",
        )


def make_policy(text: str, options: Sequence[str] = (), *, worker: int = 0) -> Policy:
    """Make a policy in this process. No server is reached before the first rollout."""
    factory, given = _factory(text, worker)
    policy = factory(**given, **bind_options(f"policy {text!r}", factory, given, options))
    _check_members(text, policy)
    return policy  # type: ignore[no-any-return]


def policy_options(text: str, options: Sequence[str] = ()) -> dict[str, Any]:
    """Return all options that a policy is made with, defaults included; see `make_policy`."""
    factory, given = _factory(text, 0)
    return bind_options(f"policy {text!r}", factory, given, options)


def served_policy(text: str, serve: str | None) -> str:
    """Return a policy as it is written, and with it the command that serves it, if there is one."""
    if serve is None:
        if parse_policy(text).serves:
            raise InvalidOptionError.expected("policy", text, POLICIES.kinds["websocket"].form)
        return text
    if text != "websocket":
        raise InvalidOptionError(
            f"serve starts the server of a policy, and {text} has none to start",
            'Give policy="websocket" with it, or leave it out.',
        )
    try:
        whole = shlex.split(serve)
    except ValueError:  # a quote is not closed
        whole = []
    if not any("{port}" in word for word in whole):
        raise InvalidOptionError.expected(
            "serve", serve, "a command with {port}, the port that it is to listen at"
        )
    return f"websocket:{serve}"


def pin_policy(text: str) -> str:
    """Return the one text of a policy: a model on the Hub has its commit.

    Asked once, before any worker starts: a branch may move while a run goes on.
    """
    spec = parse_policy(text)
    if spec.kind != "lerobot":
        return str(spec)
    return f"lerobot:{POLICIES.factory(spec, 'find_policy')(spec.target)[1]}"


def _factory(text: str, worker: int) -> tuple[Factory, dict[str, Any]]:
    """Return what makes a policy, and the arguments that its text gives."""
    spec = parse_policy(text)
    if spec.kind == "python":
        factory = import_factory("policy", spec.target)
        takes = "worker" in signature_of(factory).parameters
        return factory, {"worker": worker} if takes else {}
    if spec.serves:
        return POLICIES.factory(spec, "ServedPolicy"), {"command": spec.target}
    if spec.kind == "websocket":
        check_workers(spec, worker + 1)
        host, port = spec.servers[worker]
        return POLICIES.factory(spec), {"host": host, "port": port}
    return POLICIES.factory(spec), dict(spec.given)


def _check_members(text: str, policy: Any) -> None:
    """Refuse what is no `Policy`, so that a slip shows before the first episode."""
    wrong = []
    for name, kind in get_type_hints(Policy).items():
        value = getattr(policy, name, None)
        if kind is bool:
            sound, expected = isinstance(value, bool), "True or False"
        else:
            sound = isinstance(value, tuple | list) and all(one in CAMERAS for one in value)
            expected = f"a tuple of {' and '.join(map(repr, CAMERAS))}, or an empty one"
        if not sound:
            wrong.append(f"{name} {value!r}; expected {expected}")
    for name, value in vars(Policy).items():
        method = inspect.isfunction(value) and not name.startswith("_")
        if method and not callable(getattr(policy, name, None)):
            wrong.append(f"no method {name}()")
    if wrong:
        raise PolicyError(
            f"policy {text!r}: {type(policy).__name__} has {'; '.join(wrong)}",
            "evaluate/policies/policy.py says what a policy must have; docs/systems.md has one.",
        )
