"""What a policy says of itself, and what of it can change a result."""

import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing, redirect_stdout, suppress
from functools import partial
from typing import Any, cast

import numpy as np

from robomme_interference_data.cli.console import say
from robomme_interference_data.errors import InterferenceError, PolicyError, PolicyServerError
from robomme_interference_data.evaluate.systems import System
from robomme_interference_data.runtime.executor import Executor, Worker
from robomme_interference_data.schema.conditions import NO_HISTORY

from .policy import Policy
from .registry import (
    BUILTINS,
    check_workers,
    make_policy,
    parse_policy,
    policy_options,
)
from .servers import check_keeps, check_metadata

_WITHOUT_EFFECT = {
    "websocket": ("server", "connect_s", "response_s"),
    "lerobot": ("source", "device"),
}
"""Options, and what policies say of themselves, that no result depends on, by kind of policy:
where they run, or lie, and how long they are waited for."""


def describe_policy(
    text: str, options: Sequence[str] = (), *, workers: int = 1
) -> tuple[Policy, dict[str, Any]]:
    """Make a policy once, ask what it is, and release it; of several servers ask each.

    Returns:
        The policy, closed, for its attributes; and what it says of itself, as plain values:
        nothing, of a server that workers start, see `describe_served`.

    Raises:
        InterferenceError: It cannot be made, a server cannot be reached, servers say different
            things of themselves, nobody says which checkpoint they serve, or it does not say what
            it is.
    """
    spec = parse_policy(text)
    check_workers(spec, workers)
    if spec.serves:
        with closing(make_policy(text, options)) as policy:
            return policy, {}
    with redirect_stdout(sys.stderr):  # stdout is for the rows
        policies = [
            make_policy(text, options, worker=worker) for worker in range(len(spec.servers) or 1)
        ]
        said = [_metadata(text, policy) for policy in policies]
    policy, metadata = policies[0], dict(said[0])
    if spec.kind == "websocket":
        check_metadata(said, policy_options(text, options)["checkpoint"])
        metadata["server"] = ", ".join(one["server"] for one in said)
    if policy.privileged:
        metadata["privileged"] = True
        if spec.kind not in BUILTINS:
            say(
                f"The policy {text} is privileged: it gets the simulator itself, under every "
                f"condition, {NO_HISTORY} too; run.json says so."
            )
    return policy, metadata


def describe_served(
    text: str, options: Sequence[str], system: System, executor: Executor
) -> dict[str, Any]:
    """Have a worker start the policy's server, and return what that says of itself.

    Raises:
        PolicyServerError: It ends, cannot be reached, or is not what the system's is.
        InvalidOptionError: It cannot be started, or nobody says which checkpoint it serves.
    """
    ask = partial(_ask_served, text, tuple(options))
    (outcome,) = executor.run(ask, [system.keeps_frames is not None], attempts=1)
    if isinstance(outcome.error, InterferenceError):
        raise outcome.error
    if outcome.error is not None:
        raise PolicyServerError(f"the policy's server cannot be started: {outcome.error}")
    said, keeps = outcome.value
    check_metadata([said], policy_options(text, options)["checkpoint"])
    if keeps is not None:
        check_keeps(keeps, said["server"], system)
    return dict(said)


def _ask_served(
    text: str, options: Sequence[str], kind: bool, worker: Worker
) -> tuple[dict[str, Any], bool | None]:
    """Return what a server says of itself, and whether it keeps frames, if that is asked."""
    with closing(make_policy(text, options)) as policy:
        keeps = cast("Any", policy).keeps_frames() if kind else None
        return _metadata(text, policy), keeps


def _metadata(text: str, policy: Policy) -> dict[str, Any]:
    try:
        said = policy.metadata()
    finally:
        policy.close()
    try:
        if isinstance(said, Mapping):
            return dict(plain(said))
        why = f"returned a {type(said).__name__}"
    except ValueError as error:
        why = f"holds {error}, a number that JSON, and so run.json, does not have"
    raise PolicyError(
        f"policy {text!r}: metadata() {why}",
        'Expected a dict that says which policy this is, such as {"policy": "mine"}.',
    )


def policy_identity(text: str, options: Sequence[str], said: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a policy can change a result, as plain values.

    Where a server listens or a checkpoint lies is no part of it, nor is the device: what a
    server says of itself, and the digest of a checkpoint's files, are. Nor are objects of the
    policy's own among its options' defaults.
    """
    kind = parse_policy(text).kind
    without = _WITHOUT_EFFECT.get(kind, ())
    taken = {}
    for name, value in sorted(policy_options(text, options).items()):
        with suppress(TypeError, ValueError):
            json.dumps(value)
            taken[name] = plain(value)
    return {
        "policy": kind if without else text,
        "policy_options": {name: value for name, value in taken.items() if name not in without},
        "policy_metadata": {name: value for name, value in said.items() if name not in without},
    }


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it: long arrays become a word on their shape.

    Raises:
        ValueError: It holds NaN or an infinity.
    """
    if isinstance(value, Mapping):
        return {plain(str(key)): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist()) if value.size <= 32 else f"{value.dtype} array {value.shape}"
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(str(value))
    if value is None or isinstance(value, bool | int | float):
        return value
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else repr(value)
    return str(text).encode("utf-8", "backslashreplace").decode()
