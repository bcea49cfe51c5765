"""Policies by what is written on the command line; each is imported when it is made."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from robomme_interference_data.errors import (
    InvalidOptionError,
    MissingExtraError,
    PolicyError,
    UnknownNameError,
    nearest,
)
from robomme_interference_data.evaluate.policies.base import Policy
from robomme_interference_data.evaluate.policies.options import bind_options, signature_of
from robomme_interference_data.simulators.base import CAMERAS

__all__ = [
    "BUILTINS",
    "FORMS",
    "PolicySpec",
    "check_workers",
    "make_policy",
    "parse_policy",
    "pin_policy",
    "policy_factory",
]

BUILTINS = ("oracle", "guess", "hold", "replay")
"""Policies without learned weights, known by name alone."""

FORMS = {
    "websocket": "websocket://host:port, with commas between several servers",
    "lerobot": "lerobot:namespace/name[@revision] or lerobot:folder",
    "python": "python:module:factory",
}
"""How the other kinds are written."""

# What a policy has: see `Policy`.
_CAMERAS = ("cameras", "history_cameras")
_FLAGS = ("wants_history", "privileged", "every_frame")
_METHODS = ("reset", "add_history", "observe", "act", "metadata", "close")

_HOST_PORT = re.compile(r"(?P<host>[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):(?P<port>[0-9]{1,5})")
_FACTORY = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


@dataclass(frozen=True)
class PolicySpec:
    """A policy as it is written.

    Attributes:
        kind: `websocket`, `lerobot`, `python`, or a built-in's name.
        target: What follows the kind; empty for a built-in.
    """

    kind: str
    target: str = ""

    @property
    def servers(self) -> tuple[tuple[str, int], ...]:
        """Host and port of each server, in order; empty unless the kind is `websocket`."""
        if self.kind != "websocket":
            return ()
        found = [_HOST_PORT.fullmatch(part) for part in self.target.split(",")]
        return tuple((match["host"].strip("[]"), int(match["port"])) for match in found if match)

    def __str__(self) -> str:
        if self.kind in BUILTINS:
            return self.kind
        return f"{self.kind}:{'//' if self.kind == 'websocket' else ''}{self.target}"


def parse_policy(text: str) -> PolicySpec:
    """Read a policy as it is written, `str(parse_policy(text)) == text`.

    Args:
        text: `oracle`, `guess`, `hold`, `replay`, or one of `FORMS`.

    Raises:
        UnknownNameError: There is no such policy.
        InvalidOptionError: What follows the kind is not as it should be.
    """
    kind, _, target = text.partition(":")
    if text in BUILTINS:
        return PolicySpec(text)
    if kind in BUILTINS:
        raise InvalidOptionError(
            f"policy {text!r}: nothing may follow {kind}", f"Write {kind}; its options are apart."
        )
    if kind not in FORMS:
        forms = ", ".join([*BUILTINS, *FORMS.values()])
        near = nearest(kind, [*BUILTINS, *FORMS])
        raise UnknownNameError(
            f"there is no policy {text!r}",
            f"{near + ' ' if near.startswith('Did') else ''}Expected {forms}.",
        )
    if kind == "websocket":
        _check_servers(text, target)
        target = target.removeprefix("//")
    elif not target or (kind == "python" and not _FACTORY.fullmatch(target)):
        raise InvalidOptionError(f"policy {text!r} is not complete", f"Expected {FORMS[kind]}.")
    return PolicySpec(kind, target)


def _check_servers(text: str, target: str) -> None:
    if not target.startswith("//"):
        raise InvalidOptionError(f"policy {text!r} names no server", f"Expected {_EXAMPLE}.")
    servers = target.removeprefix("//").split(",")
    for server in servers:
        match = _HOST_PORT.fullmatch(server)
        if not match or not 0 < int(match["port"]) < 65536:
            raise InvalidOptionError(
                f"policy {text!r}: {server!r} is not host:port", f"Expected {_EXAMPLE}."
            )
        if servers.count(server) > 1:
            raise InvalidOptionError(
                f"policy {text!r} names the server {server} twice",
                "A server holds one memory: start one server for each worker.",
            )


_EXAMPLE = "websocket://localhost:8013 or websocket://gpu1:8013,gpu2:8013"


def check_workers(spec: PolicySpec, workers: int) -> None:
    """Refuse more workers than there are servers: a server holds the memory of one rollout.

    Raises:
        InvalidOptionError: There are fewer servers than workers.
    """
    if spec.kind == "websocket" and len(spec.servers) < workers:
        raise InvalidOptionError(
            f"{workers} workers need {workers} policy servers; {spec} names {len(spec.servers)}",
            f"Start more servers, one for each worker, or take --workers {len(spec.servers)}.",
        )


def make_policy(text: str, *, worker: int = 0, **options: Any) -> Policy:
    """Make a policy in this process. No server is reached before the first rollout.

    Args:
        text: As for `parse_policy`.
        worker: Number of this worker, from 0: with several servers, the one that it uses. A
            `python:` factory that takes `worker` is given it.
        **options: For the policy: `replay` takes `memory`; see `WebsocketPolicy` and
            `LeRobotPolicy`; a factory takes what it takes.

    Raises:
        UnknownNameError: There is no such policy, module or factory.
        InvalidOptionError: The policy is not written as it should be, or does not take an option.
        MissingExtraError: Its libraries are not installed.
        PolicyError: What a factory returned is no policy, or a model does not fit the simulators.
    """
    factory, fixed = policy_factory(text, worker)
    bind_options(text, factory, fixed, options)
    policy = factory(**fixed, **options)
    _check_protocol(text, policy)
    return policy


def policy_factory(text: str, worker: int = 0) -> tuple[Callable[..., Policy], dict[str, Any]]:
    """Return what makes a policy, and the arguments that its text gives; see `make_policy`."""
    spec = parse_policy(text)
    fixed: dict[str, Any] = {}
    if spec.kind == "websocket":
        check_workers(spec, worker + 1)
        fixed["host"], fixed["port"] = spec.servers[worker]
        factory = _load("websocket", "WebsocketPolicy", "evaluate")
    elif spec.kind == "lerobot":
        fixed["path"] = spec.target
        factory = _load("lerobot", "LeRobotPolicy", "build")
    elif spec.kind == "python":
        factory = _load_factory(spec.target)
        if "worker" in signature_of(factory).parameters:
            fixed["worker"] = worker
    elif spec.kind == "replay":
        factory = _load("replay", "ReplayPolicy", "evaluate")
    else:
        fixed["name"] = spec.kind
        factory = _load("builtin", "make_builtin", "evaluate")
    return factory, fixed


def pin_policy(text: str) -> str:
    """Return a policy with the commit of its model, if it is one on the Hub; else as it is.

    Asked once, before any worker starts: a branch may move while a run goes on.

    Raises:
        UnknownNameError, InvalidOptionError: The policy is not written as it should be.
        HubError: The Hub does not know the model, or cannot be reached.
    """
    spec = parse_policy(text)
    if spec.kind != "lerobot":
        return text
    return f"lerobot:{_load('lerobot_files', 'pin_model', 'build')(spec.target)}"


def _load(module: str, name: str, extra: str) -> Callable[..., Policy]:
    try:
        loaded = import_module(f"{__package__}.{module}")
    except ImportError as error:
        missing = error.name or ""
        if missing.startswith(__package__ or "") or isinstance(error, MissingExtraError):
            raise
        raise MissingExtraError(
            f"this policy needs {missing or 'a library'}, which is not installed",
            f"pip install 'robomme-interference-data[{extra}]'",
        ) from error
    return getattr(loaded, name)


def _load_factory(target: str) -> Callable[..., Policy]:
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
    except ModuleNotFoundError as error:
        if not error.name or not (module == error.name or module.startswith(f"{error.name}.")):
            raise PolicyError(f"importing {module} failed: {error}") from error
        raise UnknownNameError(
            f"there is no module {module!r} for the policy 'python:{target}'",
            "Install it, or run with PYTHONPATH set to the folder that it is in.",
        ) from error
    factory = getattr(loaded, name, None)
    if not callable(factory):
        near = nearest(name, [key for key, value in vars(loaded).items() if callable(value)])
        raise UnknownNameError(f"module {module!r} has no function {name!r}", near)
    return factory


def _check_protocol(text: str, policy: Any) -> None:
    """Refuse what is no `Policy`, so that a slip is told before the first episode."""
    missing = [name for name in (*_CAMERAS, *_FLAGS) if not hasattr(policy, name)]
    missing += [f"{name}()" for name in _METHODS if not callable(getattr(policy, name, None))]
    if missing:
        raise PolicyError(
            f"policy {text!r}: {type(policy).__name__} has no {', '.join(missing)}",
            "evaluate/policies/base.py says what a policy must have; docs/systems.md has one.",
        )
    for name in _CAMERAS:
        wanted = getattr(policy, name)
        if not isinstance(wanted, tuple | list) or not all(one in CAMERAS for one in wanted):
            raise PolicyError(
                f"policy {text!r}: its {name} are {wanted!r}",
                f"Expected a tuple of {' and '.join(map(repr, CAMERAS))}, or an empty one.",
            )
    for name in _FLAGS:
        if not isinstance(getattr(policy, name), bool):
            raise PolicyError(
                f"policy {text!r}: its {name} is {getattr(policy, name)!r}",
                "Expected True or False.",
            )
