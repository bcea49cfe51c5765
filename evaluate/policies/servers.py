"""What is seen to before policy servers are driven: that they are free, and what they should be."""

import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from robomme_interference_data.cli.console import say
from robomme_interference_data.errors import InvalidOptionError, PolicyServerError
from robomme_interference_data.evaluate.systems import System
from robomme_interference_data.storage.cache import default_cache_folder
from robomme_interference_data.storage.files import file_lock

from .registry import make_policy, parse_policy

_THIS_MACHINE = ("localhost", "127.0.0.1", "::1", "0.0.0.0")

_PORTS = range(18000, 19000)
"""Where servers listen that workers start."""


@contextmanager
def hold_servers(text: str, out: Path) -> Iterator[None]:
    """Keep other runs from a policy's servers until the block ends: a server holds one memory.

    The locks lie in this user's cache, and go with the process, however it ends. Where they cannot
    be written, that is said, and the run goes on without.

    Args:
        text: The policy as it is written; one without servers needs none.
        out: The run's folder, for whoever is refused.

    Raises:
        PolicyServerError: Another run drives one of them; says which.
    """
    folder = default_cache_folder().parent / "servers"
    with ExitStack() as stack:
        for host, port in parse_policy(text).servers:
            machine = socket.gethostname() if host in _THIS_MACHINE else host
            lock = folder / f"{machine.replace(':', '_')}_{port}.lock"
            try:
                folder.mkdir(parents=True, exist_ok=True)
                lock.touch()
                holder = lock.read_text(encoding="utf-8", errors="replace")
            except OSError as error:
                say(f"Nothing keeps other runs from the policy server {host}:{port}: {error}")
                continue
            busy = PolicyServerError(
                f"the policy server {host}:{port} is driven by {holder or 'another run'}; two runs "
                "spoil each other, as a server holds one memory",
                "Wait for that run to end, or start another server, on another port.",
            )
            stack.enter_context(file_lock(lock, busy))
            with suppress(OSError):  # such as a full disk: the lock holds all the same
                lock.write_text(f"the run in {out.resolve()} (process {os.getpid()})", "utf-8")
        yield


@contextmanager
def hold_port() -> Iterator[int]:
    """Choose a port for a server on this machine, and keep it from other workers in the block.

    A server listens only when its model is loaded. Were the port free until then, two that load at
    once might get the same, and one of them both rollouts. So its number is taken as the name of
    an abstract socket (Linux): known to whoever could listen there, whatever user or container,
    and gone with the process.

    Raises:
        PolicyServerError: All are taken.
    """
    with ExitStack() as stack:
        for port in _PORTS:
            name = stack.enter_context(socket.socket(socket.AF_UNIX))
            with suppress(OSError), socket.socket() as free:
                free.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as servers do
                free.bind(("", port))
                name.bind(f"\0robomme-interference-{port}")
                break
        else:
            raise PolicyServerError(
                f"none of the ports {_PORTS[0]} to {_PORTS[-1]} can be had on this machine",
                "--serve needs Linux, and a free port there.",
            )
        yield port


def check_metadata(said: Sequence[Mapping[str, Any]], checkpoint: str | None) -> None:
    """Check what servers say of themselves.

    Args:
        said: Metadata of the policy of each server.
        checkpoint: What the user says that they serve, or None.

    Raises:
        PolicyServerError: They say different things, or name another checkpoint than the user.
        InvalidOptionError: Neither they nor the user say which checkpoint they serve.
    """
    first = said[0]
    for other in said:
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
            "Say it, so that this run is never continued on another one: --policy-option "
            "checkpoint=TEXT, such as checkpoint=mme_vla_suite/perceptual-framesamp-modul/79999.",
        )
    if None not in (named, checkpoint) and named != checkpoint:
        raise PolicyServerError(
            f"the policy server {first['server']} serves the checkpoint {named!r}, not "
            f"{checkpoint!r}",
            f"Start it with that one, or leave out --policy-option checkpoint={checkpoint}.",
        )


def check_kind(text: str, options: Sequence[str], system: System) -> None:
    """Check that each server keeps frames if the system's does, and keeps none otherwise.

    It is asked for actions right after a reset; those that keep frames refuse them. What servers of
    a system with a name of one's own do is not known, so they are not asked.

    Raises:
        PolicyServerError: A server is of the other kind, or answers in another way.
    """
    if system.keeps_frames is None:
        return
    for worker, (host, port) in enumerate(parse_policy(text).servers):
        policy: Any = make_policy(text, options, worker=worker)
        try:
            check_keeps(policy.keeps_frames(), f"{host}:{port}", system)
        finally:
            policy.close()


def check_keeps(keeps: bool, server: str, system: System) -> None:
    """Check whether a server keeps frames against whether the system's does.

    Raises:
        PolicyServerError: It is of the other kind.
    """
    if keeps == system.keeps_frames:
        return
    found, wanted = "acts without any frame", "refuses to"
    if keeps:
        found, wanted = "refuses to act without frames", "acts"
    raise PolicyServerError(
        f"the policy server {server} {found}, and that of {system.name} {wanted}: it serves "
        "another kind of model",
        f"Start it with the checkpoint of {system.name} (docs/systems.md has a table), beside "
        "which history_config.txt lies, or give --system a name of your own.",
    )
