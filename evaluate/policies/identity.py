"""What policies and their servers report of themselves, and what of it can change a result."""

import json
import logging
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, redirect_stdout, suppress
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    PolicyError,
    PolicyServerError,
    named,
)
from robomme_interference_data.evaluate.run.identity import plain
from robomme_interference_data.evaluate.systems import System
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.schema.sampling import MEMORY_FORM, Memory
from robomme_interference_data.storage.text import indented_json

from .kinds import Role
from .policy import Policy
from .registry import (
    POLICIES,
    check_workers,
    make_policy,
    one_client,
    policy_kind,
    policy_options,
    server_addresses,
    starts_server,
)
from .server_lock import lock_server

logger = logging.getLogger(__name__)

MAX_METADATA = 1 << 16
"""Most letters of a policy's metadata in JSON: `run.json` holds it once for each start of a run."""


@contextmanager
def lock_servers(text: str, out: Path) -> Iterator[None]:
    """Keep other runs from a policy's servers in the block; `out` is this run's folder."""
    holder = f"the run in {out.resolve()}"
    with ExitStack() as stack:
        for server in server_addresses(text):
            stack.enter_context(lock_server(server.host, server.port, holder))
        yield


def describe_policy(
    text: str, options: Sequence[str] = (), *, workers: int = 1
) -> tuple[Policy, dict[str, Any]]:
    """Make a policy, for its attributes, and close it; return it with its metadata.

    All servers are asked for metadata; of one that workers start, the metadata is empty.
    """
    if one_client(text):
        check_workers(text, workers)
    if starts_server(text):
        with closing(make_policy(text, options)) as policy:
            return policy, {}
    with redirect_stdout(sys.stderr):  # stdout is for the rows
        policies, reports = [], []
        for worker in range(len(server_addresses(text)) or 1):
            policies.append(make_policy(text, options, worker=worker))
            with closing(policies[-1]):
                reports.append(policy_metadata(text, policies[-1]))
    policy, metadata = policies[0], dict(reports[0])
    if server_addresses(text):
        # Of a vla-eval server this is known only after its hello.
        if metadata.get("one_client"):
            check_workers(text, workers)
        check_metadata(reports, policy_options(text, options)["checkpoint"])
        metadata["server"] = ", ".join(reported["server"] for reported in reports)
    if policy.privileged:
        metadata["privileged"] = True
        if policy_kind(text).role is Role.OWN:
            logger.warning(
                "The policy %s is privileged: it gets the simulator under every condition, also "
                "under %s; run.json records this.",
                text,
                NO_HISTORY,
            )
    return policy, metadata


def policy_metadata(text: str, policy: Policy) -> dict[str, Any]:
    """Return a policy's metadata as plain values."""
    metadata = policy.metadata()
    try:
        if isinstance(metadata, Mapping):
            recorded = dict(plain(metadata))
            length = len(indented_json(recorded))
            if length <= MAX_METADATA:
                return recorded
            fault = f"holds {length:,} letters of JSON; expected at most {MAX_METADATA:,}"
        else:
            fault = f"returned a {type(metadata).__name__}"
    except ValueError as error:
        fault = f"holds {error}, a number that JSON, and so run.json, does not have"
    raise PolicyError(
        f"policy {text!r}: metadata() {fault}",
        'Expected a dict that identifies the policy, such as {"policy": "mine"}.',
    )


def declared_memory(policy: Policy, metadata: Mapping[str, Any]) -> str | None:
    """Return the memory that a policy declares, or its server in the metadata; None if unknown.

    A server declares it as `{"capabilities": {"memory": "framesamp:32"}}`.

    Raises:
        PolicyServerError: A server declares something else.
    """
    declared = metadata.get("server_metadata", {}).get("capabilities", {})
    if not isinstance(declared, Mapping) or {*declared} - {"memory"}:
        fault = f"the capabilities {declared}"
    elif (memory := declared.get("memory", policy.memory)) is None:
        return None
    else:
        with suppress(InterferenceError, AttributeError):  # not text
            return str(Memory.parse(memory))
        fault = f"the memory {memory!r}"
    raise PolicyServerError(
        f"the policy server {metadata.get('server', '')} declares {fault}; expected "
        f'{{"memory": RULE}}, where RULE is {MEMORY_FORM}, or null if it keeps no frames',
        "Correct the metadata that it sends: see docs/reference/policies.md.",
    )


def check_metadata(reports: Sequence[Mapping[str, Any]], checkpoint: str | None) -> None:
    """Check that servers report the same model, and the checkpoint that the user names, if any."""
    first = reports[0]
    for report in reports:
        if report["server_metadata"] != first["server_metadata"]:
            raise PolicyServerError(
                f"the policy servers {first['server']} and {report['server']} serve different "
                f"models: one reports {first['server_metadata']}, the other "
                f"{report['server_metadata']}",
                "Start all of them with the same checkpoint and seed.",
            )
    reported = first["server_metadata"].get("checkpoint")
    if reported is None and checkpoint is None:
        raise InvalidOptionError(
            f"the policy server {first['server']} does not report which checkpoint it serves: its "
            f"metadata is {first['server_metadata']}",
            "Name it, so that this run never continues with another one: set the policy's option "
            "checkpoint=TEXT, such as checkpoint=mme_vla_suite/perceptual-framesamp-modul/79999.",
        )
    if None not in (reported, checkpoint) and reported != checkpoint:
        raise PolicyServerError(
            f"the policy server {first['server']} serves the checkpoint {reported!r}, not "
            f"{checkpoint!r}",
            f"Start it with that one, or leave out the policy's option checkpoint={checkpoint}.",
        )


def check_servers_memory(text: str, options: Sequence[str], system: System) -> None:
    """Check that each server keeps frames exactly if those of the system do.

    Servers that keep frames refuse to act right after a reset. Systems of the user are not checked:
    what their servers do is unknown.
    """
    if system.keeps_frames is None:
        return
    for worker, server in enumerate(server_addresses(text)):
        policy: Any = make_policy(text, options, worker=worker)
        with closing(policy):
            check_memory_kind(policy.keeps_frames(), f"{server.host}:{server.port}", system)


def check_memory_kind(keeps: bool, server: str, system: System) -> None:
    """Check that a server keeps frames if the system's do, and keeps none otherwise."""
    if keeps == system.keeps_frames:
        return
    actual, expected = "acts without any frame", "refuses to"
    if keeps:
        actual, expected = "refuses to act without frames", "acts"
    raise PolicyServerError(
        f"the policy server {server} {actual}, and that of {system.name} {expected}: it serves "
        "another kind of model",
        f"Start it with the checkpoint of {system.name} (docs/how-to/official-simulator.md lists "
        "them) and the history_config.txt beside it, or set "
        f"{named('system')} to a name of your own.",
    )


def policy_identity(
    text: str, options: Sequence[str], metadata: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what of a policy can change a result, as plain values.

    Addresses of servers, paths of checkpoints and devices are left out; a server's metadata and the
    digest of a checkpoint's files are included. Defaults that JSON does not have are left out.
    """
    spec = POLICIES.parse(text)
    values = {}
    for name, value in policy_options(text, options).items():
        with suppress(TypeError, ValueError):
            json.dumps(value)
            values[name] = plain(value)
    return {
        "policy": spec.kind if POLICIES.kinds[spec.kind].not_in_identity else text,
        "policy_options": POLICIES.identity(spec, values),
        "policy_metadata": POLICIES.identity(spec, metadata),
    }
