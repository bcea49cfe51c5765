"""The connection of `vla-eval run` during an episode: as strict as this project's own client.

vla-eval's `Connection` connects again whenever it is closed, also in the middle of an episode,
though the server has forgotten the episode then: it would act without the history, and its failures
would count. And an answer to an earlier observation is carried out, after a warning. The benchmark
gets no connection to check, so the two methods that its runner calls are replaced.
"""

import logging
from typing import Any
from weakref import WeakKeyDictionary

from vla_eval.connection import Connection
from vla_eval.protocol.messages import MessageType
from vla_eval.types import Action, Observation

from robomme_interference_data.errors import PolicyError, PolicyServerError

from .checks import check_hello, fault_of

logger = logging.getLogger(__name__)

_replaced = {name: getattr(Connection, name) for name in ("start_episode", "act")}

_hellos: "WeakKeyDictionary[Connection, dict[str, Any]]" = WeakKeyDictionary()
"""What the server of a connection declared before its first episode."""


def check_connections() -> None:
    """Check all connections of vla-eval in this process from now on."""
    Connection.start_episode, Connection.act = _start_episode, _act


def leave_connections() -> None:
    """Check no connections anymore: another benchmark has rules of its own."""
    for name, method in _replaced.items():
        setattr(Connection, name, method)


async def _start_episode(connection: Connection, config: dict[str, Any]) -> None:
    """Start an episode, connecting again if the connection was lost: no memory is lost here.

    Raises:
        SystemExit: Before the first episode: the server does not fit. vla-eval would make every
            other exception an error of each episode.
        PolicyServerError: The server is another one than before the first episode. As this is a
            `ConnectionError`, vla-eval ends the benchmark, and keeps its results so far.
    """
    await _replaced["start_episode"](connection, config)
    hello = connection.server_info
    first = _hellos.get(connection)
    if first is None:
        try:
            check_hello(connection.url, hello)
        except PolicyServerError as error:
            raise SystemExit(f"Error: {error}") from error
        _hellos[connection] = hello
    elif hello != first:
        changed = PolicyServerError.changed(connection.url, hello, first)
        logger.error("%s", changed)  # vla-eval logs no reason
        raise changed


async def _act(connection: Connection, observation: Observation) -> Action:
    """Return the answer to an observation.

    Raises:
        ConnectionClosed: The connection was lost since the last answer.
        PolicyError: The server reports an error, or answers something else.
    """
    while not connection.is_connected:
        await connection.recv()  # raises the reason, after messages that came before it
    try:
        seq = await connection.send(MessageType.OBSERVATION, observation)
        answer = await connection.recv(timeout=connection.timeout)
        fault = fault_of(answer, MessageType.ACTION, seq)
        if fault is not None:
            what, hint = fault
            raise PolicyError(f"policy server {connection.url} {what}", hint)
    except Exception:
        # An unread answer would be taken for that of the next message.
        await connection.close()
        raise
    return answer.payload
