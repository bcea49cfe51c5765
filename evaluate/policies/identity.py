"""What a policy and its servers report of themselves, and what of it can change a result."""

import json
import logging
import math
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any

import numpy as np

from robomme_interference_data.errors import InvalidOptionError, PolicyError, PolicyServerError
from robomme_interference_data.evaluate.systems import System
from robomme_interference_data.schema.conditions import NO_HISTORY

from .policy import Policy
from .registry import BUILTINS, POLICIES, check_workers, make_policy, parse_policy, policy_options
from .server_lock import lock_server

logger = logging.getLogger(__name__)


@contextmanager
def hold_servers(text: str, out: Path) -> Iterator[None]:
    """Keep other runs from a policy's servers until the block ends; see `lock_server`."""
    with ExitStack() as stack:
        for host, port in parse_policy(text).servers:
            stack.enter_context(lock_server(host, port, f"the run in {out.resolve()}"))
        yield


def describe_policy(
    text: str, options: Sequence[str] = (), *, workers: int = 1
) -> tuple[Policy, dict[str, Any]]:
    """Make a policy once, ask what it is, and release it; of several servers ask each."""
    spec = parse_policy(text)
    check_workers(spec, workers)
    if spec.serves:
        with closing(make_policy(text, options)) as policy:
            return policy, {}
    with redirect_stdout(sys.stderr):  # stdout is for the rows
        policies, every = [], []
        for worker in range(len(spec.servers) or 1):
            policies.append(make_policy(text, options, worker=worker))
            with closing(policies[-1]):
                every.append(policy_metadata(text, policies[-1]))
    policy, metadata = policies[0], dict(every[0])
    if spec.kind == "websocket":
        _check_metadata(every, policy_options(text, options)["checkpoint"])
        metadata["server"] = ", ".join(one["server"] for one in every)
    if policy.privileged:
        metadata["privileged"] = True
        if spec.kind not in BUILTINS:
            logger.warning(
                "The policy %s is privileged: it gets the simulator itself, under every "
                "condition, %s too; run.json says so.",
                text,
                NO_HISTORY,
            )
    return policy, metadata


def check_served(
    text: str,
    options: Sequence[str],
    system: System,
    metadata: Mapping[str, Any],
    keeps: bool | None,
) -> None:
    """Check the metadata of a server that a worker started, and whether it keeps frames."""
    _check_metadata([metadata], policy_options(text, options)["checkpoint"])
    if keeps is not None:
        _check_keeps(keeps, metadata["server"], system)


def policy_metadata(text: str, policy: Policy) -> dict[str, Any]:
    """Return a policy's metadata as plain values."""
    metadata = policy.metadata()
    try:
        if isinstance(metadata, Mapping):
            return dict(plain(metadata))
        why = f"returned a {type(metadata).__name__}"
    except ValueError as error:
        why = f"holds {error}, a number that JSON, and so run.json, does not have"
    raise PolicyError(
        f"policy {text!r}: metadata() {why}",
        'Expected a dict that says which policy this is, such as {"policy": "mine"}.',
    )


def _check_metadata(every: Sequence[Mapping[str, Any]], checkpoint: str | None) -> None:
    """Check that servers report the same, and the checkpoint that the user names, if any."""
    first = every[0]
    for other in every:
        if other["server_metadata"] != first["server_metadata"]:
            raise PolicyServerError(
                f"the policy servers {first['server']} and {other['server']} serve different "
                f"models: one says {first['server_metadata']}, the other "
                f"{other['server_metadata']}",
                "Start all of them with the same checkpoint and seed.",
            )
    named = first["server_metadata"].get("checkpoint")
    if named is None and checkpoint is None:
        raise InvalidOptionError(
            f"the policy server {first['server']} does not say which checkpoint it serves: its "
            f"metadata is {first['server_metadata']}",
            "Name it, so that this run is never continued on another one: the policy's option "
            "checkpoint=TEXT, such as checkpoint=mme_vla_suite/perceptual-framesamp-modul/79999.",
        )
    if None not in (named, checkpoint) and named != checkpoint:
        raise PolicyServerError(
            f"the policy server {first['server']} serves the checkpoint {named!r}, not "
            f"{checkpoint!r}",
            f"Start it with that one, or leave out the policy's option checkpoint={checkpoint}.",
        )


def check_kind(text: str, options: Sequence[str], system: System) -> None:
    """Check that each server keeps frames if the system's does, and keeps none otherwise.

    It is asked for actions right after a reset; those that keep frames refuse them. What servers of
    a system with a name of one's own do is not known, so they are not asked.
    """
    if system.keeps_frames is None:
        return
    for worker, (host, port) in enumerate(parse_policy(text).servers):
        policy: Any = make_policy(text, options, worker=worker)
        with closing(policy):
            _check_keeps(policy.keeps_frames(), f"{host}:{port}", system)


def _check_keeps(keeps: bool, server: str, system: System) -> None:
    if keeps == system.keeps_frames:
        return
    found, expected = "acts without any frame", "refuses to"
    if keeps:
        found, expected = "refuses to act without frames", "acts"
    raise PolicyServerError(
        f"the policy server {server} {found}, and that of {system.name} {expected}: it serves "
        "another kind of model",
        f"Start it with the checkpoint of {system.name} (docs/systems.md has a table), beside "
        "which history_config.txt lies, or give the system a name of your own.",
    )


def policy_identity(
    text: str, options: Sequence[str], metadata: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what of a policy can change a result, as plain values.

    Where a server listens or a checkpoint lies is no part of it, nor is the device: a server's
    metadata, and the digest of a checkpoint's files, are. Nor are objects of the policy's own
    among its options' defaults.
    """
    spec = parse_policy(text)
    values = {}
    for name, value in policy_options(text, options).items():
        with suppress(TypeError, ValueError):
            json.dumps(value)
            values[name] = plain(value)
    return {
        "policy": spec.kind if POLICIES.kinds[spec.kind].no_effect else text,
        "policy_options": POLICIES.identity(spec, values),
        "policy_metadata": POLICIES.identity(spec, metadata),
    }


def plain(value: Any) -> Any:
    """Return a value as JSON can hold it; `ValueError` for NaN or an infinity in it.

    Long arrays become a word on their shape.
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
    big = isinstance(value, int) and value.bit_length() > 63  # more than a file of ours can hold
    if value is None or (isinstance(value, bool | int | float) and not big):
        return value
    if big:
        text = hex(value)
    else:
        text = os.fspath(value) if isinstance(value, str | os.PathLike) else repr(value)
    return str(text).encode("utf-8", "backslashreplace").decode()
