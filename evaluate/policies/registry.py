"""Policies by their text, such as `replay:window`; each is imported when it is made."""

import inspect
import shlex
import traceback
from collections.abc import Sequence
from typing import Any, get_type_hints

from robomme_interference_data.errors import InterferenceError, InvalidOptionError, PolicyError
from robomme_interference_data.runtime.specs import (
    Factory,
    Kind,
    Registry,
    bind_options,
    import_factory,
    signature_of,
)
from robomme_interference_data.schema.sampling import Memory

from .policy import Policy

BUILTINS = ("replay", "recall", "oracle", "guess", "follow-subgoals", "noop", "hold", "mean")
"""Policies without learned weights."""

REFERENCES = ("recall", "oracle", "guess", "follow-subgoals", "noop", "hold", "mean")
"""Policies whose results are bounds: with the answer, by chance, or without motion."""

_SERVER = r"(?:[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]):[0-9]{1,5}"


def _addresses(target: str) -> tuple[tuple[str, int], ...]:
    """Return host and port of each server of `//…` or `ws://HOST:PORT,…`; empty for a command."""
    scheme, slashes, servers = target.partition("//")
    if scheme not in ("", "ws:") or not slashes:
        return ()
    pairs = (one.rpartition(":") for one in servers.split(","))
    return tuple((host.strip("[]"), int(port)) for host, _, port in pairs)


def _valid_addresses(target: str) -> bool:
    servers = _addresses(target)
    return len({*servers}) == len(servers) and all(0 < port < 65536 for _, port in servers)


def _memory(target: str) -> str:
    return str(Memory.parse(target))


def _builtin(kind: str, factory: str, memory: bool = False, **given: str) -> Kind:
    factory = f"{__package__}.builtin:{factory}"
    if memory:
        form = f"{kind}, {kind}:framesamp:N or {kind}:window:N"
        return Kind(form, factory, r"(?P<memory>.+)", default="full", spelled=_memory)
    return Kind(kind, factory, given=given)


POLICIES = Registry(
    "policy",
    {
        "replay": _builtin("replay", "ReplayPolicy", memory=True),
        "recall": _builtin("recall", "Recall", memory=True),
        "oracle": _builtin("oracle", "Privileged", name="oracle"),
        "guess": _builtin("guess", "Privileged", name="guess"),
        "follow-subgoals": _builtin("follow-subgoals", "FollowSubgoals"),
        "noop": _builtin("noop", "Noop"),
        "hold": Kind("hold", f"{__package__}.baselines:Hold"),
        "mean": Kind("mean", f"{__package__}.baselines:Mean"),
        "answers": Kind(
            "answers:folder of a run of questions, or answers:file.csv",
            f"{__package__}.answers:ActOutAnswers",
            r"(?P<path>.+)",
            no_effect=("path",),
        ),
        "websocket": Kind(
            "websocket://host:port, with commas between several servers, each once, or websocket "
            'with serve="COMMAND with {port}"',
            f"{__package__}.websocket:WebsocketPolicy",
            rf"//{_SERVER}(?:,{_SERVER})*|(?!//).*\{{port\}}.*",
            extra="evaluate",
            no_effect=("server", "connect_s", "response_s"),
            valid=_valid_addresses,
        ),
        "vla-eval": Kind(
            "vla-eval:ws://host:port, with commas between several servers, each once",
            "robomme_interference_data.evaluate.vla_eval.policy:VlaEvalPolicy",
            rf"ws://{_SERVER}(?:,{_SERVER})*",
            extra="vla-eval",
            no_effect=("server", "connect_s", "response_s"),
            valid=_valid_addresses,
        ),
        "lerobot": Kind(
            "lerobot:namespace/name[@revision] or lerobot:folder",
            f"{__package__}.lerobot:LeRobotPolicy",
            r"(?P<path>.+)",
            extra="build",
            no_effect=("source", "device"),
            on_hub=True,
        ),
        "python": Kind("python:module:factory", "", r"[A-Za-z_][\w.]*:[A-Za-z_]\w*"),
    },
)


def server_addresses(text: str) -> tuple[tuple[str, int], ...]:
    """Return host and port of each server that a policy names, in order."""
    spec = POLICIES.parse(text)
    return _addresses(spec.target) if spec.kind in ("websocket", "vla-eval") else ()


def policy_memory(text: str) -> str | None:
    """Return the rule by which a policy keeps frames, `framesamp:32`; None if it declares none."""
    memory = POLICIES.parse(text).given.get("memory")
    return None if memory is None else str(Memory.parse(memory))


def starts_server(text: str) -> bool:
    """Whether each worker starts a server, with the command in the policy's text."""
    return POLICIES.parse(text).kind == "websocket" and not server_addresses(text)


def one_memory(text: str) -> bool:
    """Whether each server of a policy is known to hold the memory of one rollout."""
    return POLICIES.parse(text).kind == "websocket"


def check_workers(text: str, workers: int) -> None:
    """Refuse more workers than servers that hold the memory of one rollout each."""
    servers = server_addresses(text)
    if 0 < len(servers) < workers:
        own = ", or let each worker start its own (serve)" if one_memory(text) else ""
        raise InvalidOptionError(
            f"{workers} workers need {workers} policy servers, as each holds one memory; {text} "
            f"names {len(servers)}",
            f"Set workers={len(servers)}, or start more servers{own}.",
        )


def make_policy(text: str, options: Sequence[str] = (), *, worker: int = 0) -> Policy:
    """Make the policy of a worker in this process; most servers are connected at first use."""
    factory, given = _factory(text, worker)
    bound = bind_options(f"policy {text!r}", factory, given, options)
    try:
        policy = factory(**given, **bound)
    except InterferenceError:
        raise
    except Exception as error:
        trace = error.__traceback__ and error.__traceback__.tb_next
        raise PolicyError(
            f"policy {text!r}: its factory raised {type(error).__name__}: {error}",
            "".join(traceback.format_exception(type(error), error, trace)).rstrip(),
        ) from error
    check_members(f"policy {text!r}", policy)
    return policy  # type: ignore[no-any-return]


def policy_options(text: str, options: Sequence[str] = ()) -> dict[str, Any]:
    """Return all options that a policy is made with, defaults included."""
    factory, given = _factory(text, 0)
    return bind_options(f"policy {text!r}", factory, given, options)


def with_server(text: str, serve: str | None) -> str:
    """Return a policy's text, with the command with which each worker starts its server."""
    if serve is None:
        if starts_server(text):
            raise InvalidOptionError.expected("policy", text, POLICIES.kinds["websocket"].form)
        return text
    if text != "websocket":
        raise InvalidOptionError(
            f"serve starts the server of a policy, but {text} has no server to start",
            'Set policy="websocket" with it, or leave it out.',
        )
    try:
        words = shlex.split(serve)
    except ValueError:  # an unclosed quote
        words = []
    if not any("{port}" in word for word in words):
        raise InvalidOptionError.expected(
            "serve", serve, "a command with {port}, the port that the server must listen at"
        )
    return f"websocket:{serve}"


def _factory(text: str, worker: int) -> tuple[Factory, dict[str, Any]]:
    """Return what makes a policy, and the arguments that its text gives."""
    spec = POLICIES.parse(text)
    if spec.kind == "python":
        factory = import_factory(f"policy {str(spec)!r}", spec.target)
        takes_worker = "worker" in signature_of(factory).parameters
        return factory, {"worker": worker} if takes_worker else {}
    if starts_server(text):
        return POLICIES.factory(spec, "ServedPolicy"), {"command": spec.target}
    if servers := server_addresses(text):
        if one_memory(text):
            check_workers(text, worker + 1)
        host, port = servers[worker % len(servers)]
        return POLICIES.factory(spec), {"host": host, "port": port}
    return POLICIES.factory(spec), dict(spec.given)


def check_members(what: str, policy: Any) -> None:
    """Compare a policy with the protocol, so that a slip shows before the first episode."""
    wrong = []
    for name, kind in get_type_hints(Policy).items():
        value = getattr(policy, name, None)
        if kind is bool:
            valid, expected = isinstance(value, bool), "True or False"
        else:
            valid = isinstance(value, tuple | list) and all(isinstance(one, str) for one in value)
            expected = "a tuple of names of cameras, such as ('front', 'wrist'), or an empty one"
        if not valid:
            wrong.append(f"{name} {value!r}; expected {expected}")
    for name, value in vars(Policy).items():
        method = inspect.isfunction(value) and not name.startswith("_")
        if method and not callable(getattr(policy, name, None)):
            wrong.append(f"no method {name}()")
    if wrong:
        raise PolicyError(
            f"{what}: {type(policy).__name__} has {'; '.join(wrong)}",
            "Subclass robomme_interference_data.evaluate.Policy: docs/how-to/your-own-policy.md.",
        )
