"""Policies by their text, such as `replay:window`; each is imported when it is made."""

import inspect
import traceback
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from typing import Any, get_type_hints

from robomme_interference_data.errors import InterferenceError, InvalidOptionError, PolicyError
from robomme_interference_data.runtime.specs import (
    Factory,
    Registry,
    bind_options,
    import_factory,
    signature_of,
)
from robomme_interference_data.schema.other_states import OTHER_STATES, OtherStates
from robomme_interference_data.schema.sampling import MEMORY_FORM, Memory

from .kinds import KINDS, PolicyKind, Role, ServerAddress, addresses
from .policy import Policy

POLICIES = Registry("policy", KINDS)
"""The kinds of policies."""


def policy_kind(text: str) -> PolicyKind:
    """Return what the kind of a policy declares."""
    return POLICIES.kinds[POLICIES.parse(text).kind]


def policy_memory(text: str) -> str | None:
    """Return the memory of a policy, such as `framesamp:32`; None if its text has none."""
    return POLICIES.parse(text).arguments.get("memory")


def server_addresses(text: str) -> tuple[ServerAddress, ...]:
    """Return the address of each server that a policy names, in order."""
    spec = POLICIES.parse(text)
    return addresses(spec.target) if POLICIES.kinds[spec.kind].server is not None else ()


def starts_server(text: str) -> bool:
    """Whether each worker starts a server, with the command in the policy's text."""
    return policy_kind(text).server is not None and not server_addresses(text)


def one_client(text: str) -> bool:
    """Whether each server of a policy is known to hold the memory of one rollout."""
    server = policy_kind(text).server
    return server is not None and server.one_client


def check_workers(text: str, workers: int) -> None:
    """Refuse more workers than servers that hold the memory of one rollout each."""
    servers = server_addresses(text)
    # Without addresses each worker starts its own server.
    if 0 < len(servers) < workers:
        server = policy_kind(text).server
        startable = server is not None and server.starter is not None
        own = ", or let each worker start its own (websocket:COMMAND)" if startable else ""
        raise InvalidOptionError(
            f"{workers} workers need {workers} policy servers, as each holds one memory; {text} "
            f"names {len(servers)}",
            f"Set workers={len(servers)}, or start more servers{own}.",
        )


def make_policy(text: str, options: Sequence[str] = (), *, worker: int = 0) -> Policy:
    """Make the policy of a worker in this process; most servers are connected at first use."""
    factory, arguments = _factory(text, worker)
    bound = bind_options(f"policy {text!r}", factory, arguments, options)
    try:
        policy = factory(**arguments, **bound)
    except InterferenceError:
        raise
    except Exception as error:
        # Without the frame of this function, the traceback shows the user's code only.
        trace = error.__traceback__ and error.__traceback__.tb_next
        raise PolicyError(
            f"policy {text!r}: its factory raised {type(error).__name__}: {error}",
            "".join(traceback.format_exception(type(error), error, trace)).rstrip(),
        ) from error
    check_members(f"policy {text!r}", policy)
    return policy  # type: ignore[no-any-return]


def policy_options(text: str, options: Sequence[str] = ()) -> dict[str, Any]:
    """Return all options that a policy is made with, defaults included."""
    factory, arguments = _factory(text, 0)
    return bind_options(f"policy {text!r}", factory, arguments, options)


def _factory(text: str, worker: int) -> tuple[Factory, dict[str, Any]]:
    """Return what makes a policy, and the arguments that its text gives."""
    spec = POLICIES.parse(text)
    kind = POLICIES.kinds[spec.kind]
    if kind.role is Role.OWN:
        factory = import_factory(f"policy {str(spec)!r}", spec.target)
        # A policy of the user may choose a server or a GPU by its worker's number.
        takes_worker = "worker" in signature_of(factory).parameters
        return factory, {"worker": worker} if takes_worker else {}
    if kind.server is not None and starts_server(text):
        return POLICIES.factory(spec, kind.server.starter), {"command": spec.target}
    if servers := server_addresses(text):
        if one_client(text):
            check_workers(text, worker + 1)
        return POLICIES.factory(spec), servers[worker % len(servers)]._asdict()
    return POLICIES.factory(spec), dict(spec.arguments)


def check_members(what: str, policy: Any) -> None:
    """Compare a policy with the protocol, so that a slip shows before the first episode."""
    wrong = []
    declared = get_type_hints(Policy)
    for name, kind in declared.items():
        value = getattr(policy, name, _MISSING)
        valid, expected = _EXPECTED[kind]
        if not valid(value):
            shown = f"no {name}" if value is _MISSING else f"{name} {value!r}"
            wrong.append(f"{shown}; expected {expected}")
    for name, value in vars(Policy).items():
        method = inspect.isfunction(value) and not name.startswith("_")
        if method and not callable(getattr(policy, name, None)):
            wrong.append(f"no method {name}()")
    # A subclass has defaults: what a misspelled attribute declares would have no effect.
    own = _own_attributes(type(policy))
    for name in sorted(own - declared.keys()):
        for near in get_close_matches(name, sorted(declared.keys() - own), n=1, cutoff=0.8):
            wrong.append(f"an attribute {name}, which declares nothing; did you mean {near!r}?")
    if wrong:
        raise PolicyError(
            f"{what}: {type(policy).__name__} has {'; '.join(wrong)}",
            "Subclass robomme_interference_data.evaluate.Policy: docs/how-to/your-own-policy.md.",
        )


_MISSING = object()


def _is_names(value: Any) -> bool:
    return isinstance(value, tuple | list) and all(isinstance(name, str) for name in value)


def _is_memory(value: Any) -> bool:
    if not isinstance(value, str):
        return value is None
    try:
        Memory.parse(value)
    except InterferenceError:
        return False
    return True


_EXPECTED: dict[Any, tuple[Callable[[Any], bool], str]] = {
    bool: (lambda value: isinstance(value, bool), "True or False"),
    tuple[str, ...]: (
        _is_names,
        "a tuple of names of cameras, such as ('front', 'wrist'), or an empty one",
    ),
    OtherStates: (
        lambda value: value in OTHER_STATES,
        ", ".join(OTHER_STATES[:-1]) + f" or {OTHER_STATES[-1]}",
    ),
    str | None: (_is_memory, f"{MEMORY_FORM}, or None"),
}
"""Type of an attribute of `Policy` to the check of its value, and what that expects."""


def _own_attributes(policy_class: type) -> set[str]:
    """Return the public attributes, without methods, that the user's classes define."""
    return {
        name
        for base in policy_class.__mro__
        if base.__module__ != Policy.__module__
        for name, value in vars(base).items()
        if not name.startswith("_") and not inspect.isroutine(value)
    }
