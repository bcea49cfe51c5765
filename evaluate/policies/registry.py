"""Policies by what is written on the command line; each is imported when it is made."""

import inspect
import re
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, get_type_hints

from robomme_interference_data.errors import (
    InvalidOptionError,
    PolicyError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.evaluate.specs import bind_options, signature_of
from robomme_interference_data.lazy import load_extra
from robomme_interference_data.simulators.base import CAMERAS

from .policy import Policy

BUILTINS = ("replay", "recall", "oracle", "guess", "obey", "hold")
"""Policies without learned weights."""

_SERVER = r"(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):[0-9]{1,5}"
_KINDS = {
    **{name: ("", name) for name in BUILTINS},
    **{
        name: (r"[a-z]+", f"{name}, {name}:framesamp or {name}:window")
        for name in ("replay", "recall")
    },
    "websocket": (
        rf"//{_SERVER}(?:,{_SERVER})*|(?!//).*\{{port\}}.*",
        "websocket://host:port, with commas between several servers, each once, or websocket with "
        "--serve 'COMMAND with {port}'",
    ),
    "lerobot": (r".+", "lerobot:namespace/name[@revision] or lerobot:folder"),
    "python": (r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", "python:module:factory"),
}
"""What follows each kind, and how that is told."""


@dataclass(frozen=True)
class PolicySpec:
    """A policy as it is written.

    Attributes:
        kind: `websocket`, `lerobot`, `python`, or a built-in's name.
        target: What follows it; of `replay` and `recall` the memory rule, of other built-ins
            nothing; of `websocket` servers, or the command that starts one.
    """

    kind: str
    target: str = ""

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

    def __str__(self) -> str:
        return f"{self.kind}:{self.target}" if self.target else self.kind


def parse_policy(text: str) -> PolicySpec:
    """Read a policy as it is written; `replay` alone stands for `replay:full`, and so on.

    Raises:
        UnknownNameError: There is no such policy.
        InvalidOptionError: What follows the kind is not as it should be.
    """
    kind, colon, target = text.partition(":")
    if kind not in _KINDS:
        forms = ", ".join(form for _, form in _KINDS.values())
        raise UnknownNameError(
            f"there is no policy {text!r}; expected {forms}", nearest(kind, _KINDS, more="")
        )
    if text in ("replay", "recall"):
        target = "full"
    pattern, form = _KINDS[kind]
    spec = PolicySpec(kind, target)
    if not re.fullmatch(pattern, target, re.DOTALL) or bool(colon) > bool(target):
        raise InvalidOptionError.expected("policy", text, form)
    servers = spec.servers
    if len(set(servers)) < len(servers) or not all(0 < port < 65536 for _, port in servers):
        raise InvalidOptionError.expected("policy", text, form)
    return spec


def check_workers(spec: PolicySpec, workers: int) -> None:
    """Refuse more workers than there are servers: a server holds the memory of one rollout."""
    if spec.kind == "websocket" and not spec.serves and len(spec.servers) < workers:
        raise InvalidOptionError(
            f"{workers} workers need {workers} policy servers; {spec} names {len(spec.servers)}",
            f"Take --workers {len(spec.servers)}, start more, or have each worker start its own: "
            "--serve.",
        )


def make_policy(text: str, options: Sequence[str] = (), *, worker: int = 0) -> Policy:
    """Make a policy in this process. No server is reached before the first rollout.

    Args:
        text: The policy as it is written, see `parse_policy`.
        options: Its options, each `NAME=VALUE`: see `WebsocketPolicy` and `LeRobotPolicy`; a
            factory takes what it takes.
        worker: Number of this worker, from 0: with several servers, the one that it uses. A
            `python:` factory that takes `worker` is given it.

    Raises:
        UnknownNameError: There is no such policy or factory.
        InvalidOptionError: The policy is not written as it should be, or does not take an option.
        MissingExtraError: Its libraries are not installed.
        PolicyError: A module cannot be imported, what a factory returned is no policy, or a model
            does not fit the simulators.
    """
    factory, fixed = _factory(text, worker)
    policy = factory(**fixed, **bind_options(text, factory, fixed, options))
    _check_members(text, policy)
    return policy


def policy_options(text: str, options: Sequence[str] = ()) -> dict[str, Any]:
    """Return all options that a policy is made with, defaults included; see `make_policy`."""
    factory, fixed = _factory(text, 0)
    return bind_options(text, factory, fixed, options)


def served_policy(text: str, serve: str | None) -> str:
    """Return a policy as it is written, and with it the command that serves it, if there is one.

    Args:
        text: The policy as it is written.
        serve: The command with which each worker starts its server, `{port}` in it.

    Raises:
        InvalidOptionError: There is no place for the port, or the policy has no server to start.
    """
    if serve is None:
        if parse_policy(text).serves:
            raise InvalidOptionError.expected("policy", text, _KINDS["websocket"][1])
        return text
    if text != "websocket":
        raise InvalidOptionError(
            f"--serve starts the server of a policy, and {text} has none to start",
            "Give --policy websocket with it, or leave it out.",
        )
    try:
        whole = shlex.split(serve)
    except ValueError:  # a quote is not closed
        whole = []
    if not any("{port}" in word for word in whole):
        raise InvalidOptionError.expected(
            "--serve", serve, "a command with {port}, the port that it is to listen at"
        )
    return f"websocket:{serve}"


def pin_policy(text: str) -> str:
    """Return the one text of a policy: a model on the Hub has its commit.

    Asked once, before any worker starts: a branch may move while a run goes on.

    Raises:
        UnknownNameError, InvalidOptionError: The policy is not written as it should be.
        HubError: The Hub does not know the model, or cannot be reached.
    """
    spec = parse_policy(text)
    if spec.kind != "lerobot":
        return str(spec)
    return f"lerobot:{_load('lerobot', 'find_policy', 'build')(spec.target)[1]}"


def _factory(text: str, worker: int) -> tuple[Callable[..., Policy], dict[str, Any]]:
    """Return what makes a policy, and the arguments that its text gives."""
    spec = parse_policy(text)
    if spec.kind == "python":
        factory = _own_factory(spec.target)
        takes = "worker" in signature_of(factory).parameters
        return factory, {"worker": worker} if takes else {}
    if spec.kind == "lerobot":
        return _load("lerobot", "LeRobotPolicy", "build"), {"path": spec.target}
    if spec.kind == "websocket":
        return _server(spec, worker)
    if spec.kind in ("replay", "recall"):
        name = {"replay": "ReplayPolicy", "recall": "Recall"}[spec.kind]
        return _load("builtin", name), {"memory": spec.target}
    if spec.kind in ("hold", "obey"):
        return _load("builtin", spec.kind.capitalize()), {}
    return _load("builtin", "Privileged"), {"name": spec.kind}


def _server(spec: PolicySpec, worker: int) -> tuple[Callable[..., Policy], dict[str, Any]]:
    if spec.serves:
        return _load("served", "ServedPolicy"), {"command": spec.target}
    check_workers(spec, worker + 1)
    host, port = spec.servers[worker]
    return _load("websocket", "WebsocketPolicy"), {"host": host, "port": port}


def _load(module: str, name: str, extra: str = "evaluate") -> Callable[..., Any]:
    return load_extra(f"{__package__}.{module}", name, "this policy", extra)


def _own_factory(target: str) -> Callable[..., Policy]:
    module, _, name = target.partition(":")
    if module == "__main__":
        raise InvalidOptionError(
            f"policy 'python:{target}': worker processes run another program, and find no such "
            "function in it",
            "Put the function into a module, a .py file beside the script or on PYTHONPATH, and "
            "write python:MODULE:FUNCTION.",
        )
    try:
        loaded = import_module(module)
    except Exception as error:
        raise PolicyError(
            f"importing {module} failed: {type(error).__name__}: {error}",
            "Install it, or run with PYTHONPATH set to the folder that it is in.",
        ) from error
    factory: Any = getattr(loaded, name, None)
    if not callable(factory):
        known = [key for key, value in vars(loaded).items() if callable(value)]
        raise UnknownNameError.among("function", name, f"module {module!r}", known)
    return factory  # type: ignore[no-any-return]


def _check_members(text: str, policy: Any) -> None:
    """Refuse what is no `Policy`, so that a slip is told before the first episode."""
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
