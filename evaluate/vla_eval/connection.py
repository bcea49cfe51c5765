"""The messages of vla-eval, on the connection that all policy servers have.

vla-eval's own `Connection` is not used: when it breaks in the middle of an episode it connects
again, to a server that has forgotten the episode.
"""

from typing import Any

from vla_eval.protocol.image_codec import is_encoded_image
from vla_eval.protocol.messages import (
    Message,
    MessageType,
    make_hello_payload,
    pack_message,
    unpack_message,
)

from robomme_interference_data.errors import FormatError, PolicyServerError
from robomme_interference_data.evaluate.policies.connection import ServerConnection
from robomme_interference_data.evaluate.policies.wire import check_items

from .checks import actions_of, fault_of


class VlaEvalConnection(ServerConnection):
    """A connection to a server of vla-eval, which keeps its clients apart by their connections.

    Every call raises `PolicyServerError` if the server reports an error, or sends anything but the
    answer to the last message.
    """

    guide = "docs/how-to/connect-a-policy.md"

    def _greet(self, seconds: float) -> dict[str, Any]:
        self._seq, self._unsent = 0, list[bytes]()
        return self.hello(seconds)

    def hello(self, seconds: float | None = None) -> dict[str, Any]:
        """Return what the server declares; it answers this at any time."""
        hello = self._ask(MessageType.HELLO, make_hello_payload(), MessageType.HELLO, seconds)
        if "model_server" not in hello:
            raise self._other("its hello names no model server")
        return hello

    def start_episode(self, task: dict[str, Any]) -> None:
        """Start an episode; the message has no answer, and goes with the next one that has."""
        self._add(MessageType.EPISODE_START, {"task": task})

    def end_episode(self) -> None:
        """End the episode, with the next message; closing the connection ends it too."""
        self._add(MessageType.EPISODE_END, {})

    def act(self, observation: dict[str, Any]) -> Any:
        """Return the actions for an observation."""
        return actions_of(self._ask(MessageType.OBSERVATION, observation, MessageType.ACTION))

    def _add(self, kind: MessageType, payload: dict[str, Any]) -> None:
        self._seq += 1
        self._unsent.append(pack_message(Message(kind, payload, self._seq)))

    def _ask(
        self,
        kind: MessageType,
        payload: dict[str, Any],
        expected: MessageType,
        seconds: float | None = None,
    ) -> dict[str, Any]:
        """Send a message, after those without answers; return the payload of its answer."""
        self._add(kind, payload)
        messages, self._unsent = self._unsent, []
        answer = self._exchange(messages, seconds or self._response_s, self._read)
        fault = fault_of(answer, expected, self._seq)
        if fault is not None:
            raise self._failed(*fault)
        content: dict[str, Any] = answer.payload
        return content

    def _read(self, data: str | bytes) -> Message:
        try:
            if isinstance(data, str):
                raise ValueError(f"it sends the text {data!r:.200}")
            # Answers are actions; an image of a few bytes can be huge once it is decoded.
            check_items(data, forbidden=is_encoded_image)
            answer = unpack_message(data)
            if not isinstance(answer.payload, dict):
                raise ValueError(f"it sends a {type(answer.payload).__name__}")
        except FormatError as error:
            raise self._other(error.message) from error
        except ValueError as error:
            raise self._other(error) from error
        return answer

    def _other(self, reason: object) -> PolicyServerError:
        """Close the connection; return the error of what is no server of vla-eval."""
        return self._failed(
            f"is no server of vla-eval: {reason}",
            f"Check host and port; {self.guide} describes which servers fit.",
        )
