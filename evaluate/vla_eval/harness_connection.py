"""The connection of `vla-eval run` during an episode: as strict as this project's own client.

vla-eval's `Connection` connects again whenever it is closed, also in the middle of an episode,
though the server has forgotten the episode then: it would act without the history, and its failures
would count. And an answer to an earlier observation is carried out, after a warning. A benchmark
gets no connection to check, so the two methods that vla-eval's runner calls are replaced.
"""

import logging
from collections.abc import Collection
from typing import Any

from vla_eval.connection import Connection
from vla_eval.protocol.messages import MessageType
from vla_eval.types import Action, Observation

from robomme_interference_data.errors import PolicyError, PolicyServerError

from .checks import WRISTS, check_hello, fault_of

logger = logging.getLogger(__name__)

_replaced = {name: getattr(Connection, name) for name in ("start_episode", "act")}


class CheckedConnections:
    """Checks the connections of vla-eval in this process, from `begin` to `end`.

    Args:
        cameras: Cameras whose images are sent.
    """

    def __init__(self, cameras: Collection[str]):
        self._cameras = cameras
        self._hello: dict[str, Any] | None = None  # what the server declared at first

    def begin(self) -> None:
        """Begin to check."""

        async def start_episode(connection: Connection, config: dict[str, Any]) -> None:
            await _replaced["start_episode"](connection, config)  # connects again if it must
            self._check_server(connection)

        Connection.start_episode, Connection.act = start_episode, _act

    def end(self) -> None:
        """Leave connections alone: another benchmark has rules of its own."""
        for name, method in _replaced.items():
            setattr(Connection, name, method)

    def _check_server(self, connection: Connection) -> None:
        """Check the server of an episode that starts.

        Raises:
            SystemExit: Before the first episode, the server does not fit: every other exception
                would become an error of each episode.
            PolicyServerError: The server is not that of the first episode. As this is a
                `ConnectionError`, vla-eval ends the benchmark, and keeps its results so far.
        """
        server, hello = connection.url, connection.server_info
        if self._hello is None:
            try:
                check_hello(server, hello)
                self._check_cameras(server, hello)
            except PolicyServerError as error:
                raise SystemExit(f"Error: {error}") from error
            self._hello = hello
        elif hello != self._hello:
            changed = PolicyServerError.changed(server, hello, self._hello)
            logger.error("%s", changed)  # vla-eval logs no reason
            raise changed

    def _check_cameras(self, server: str, hello: dict[str, Any]) -> None:
        """Check that a server that declares the wrist camera gets it: some would see a black one.

        vla-eval sends it only to servers that ask for it in their `observation_params`.
        """
        declared = [name for name in WRISTS if name in hello.get("observation_spec", {})]
        if declared and "wrist" not in self._cameras:
            raise PolicyServerError(
                f"policy server {server} declares the observation {declared[0]}, which is not "
                "sent, as it does not ask for it",
                "Add `send_wrist_image: true` to `params`.",
            )


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
