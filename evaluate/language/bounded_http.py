"""An HTTP client that limits the time and the size of a whole answer."""

from typing import Any
from weakref import WeakSet

import httpx

from robomme_interference_data.evaluate.deadline import shutdown_after

MAX_BYTES = 16 << 20
"""Maximum bytes of an answer; a usual one has a few thousand."""


class AnswerTooLongError(httpx.RequestError):
    """An answer has more bytes than `MAX_BYTES`."""


class BoundedClient(httpx.Client):
    """An HTTP client for one thread whose limits a server cannot extend.

    Args:
        answer_s: Maximum seconds from a request to the last byte of its answer.
    """

    def __init__(self, answer_s: float):
        super().__init__(follow_redirects=True, headers={"Accept-Encoding": "identity"})
        self._answer_s = answer_s
        self._streams: WeakSet[Any] = WeakSet()

    def send(self, request: httpx.Request, **options: Any) -> httpx.Response:  # type: ignore[override]
        """Send a request and read its answer, uncompressed, within the limits."""
        request.extensions = {**request.extensions, "trace": self._keep_stream}
        with shutdown_after(self._answer_s, self._sockets) as expired:
            try:
                response = _read(super().send(request, **options | {"stream": True}))
            except httpx.TransportError:
                if not expired.is_set():
                    raise
        if expired.is_set():  # a shut down connection may look like the end of the answer
            raise httpx.ReadTimeout("no whole answer in time", request=request)
        return response

    def _sockets(self) -> list[Any]:
        return [stream.get_extra_info("socket") for stream in self._streams]

    def _keep_stream(self, event: str, info: dict[str, Any]) -> None:
        """Remember connections as they open; see httpx's `trace` extension."""
        if event.endswith((".connect_tcp.complete", ".start_tls.complete")):
            self._streams.add(info["return_value"])


def _read(response: httpx.Response) -> httpx.Response:
    """Read a streamed response."""
    content = bytearray()
    try:
        for chunk in response.iter_raw():
            content += chunk
            if len(content) > MAX_BYTES:
                raise AnswerTooLongError(f"an answer of more than {MAX_BYTES} bytes")
    finally:
        response.close()
    # A server may compress all the same; without this header httpx does not decompress the answer,
    # whose size would then be unlimited.
    headers = [(k, v) for k, v in response.headers.multi_items() if k != "content-encoding"]
    return httpx.Response(
        response.status_code,
        headers=headers,
        content=bytes(content),
        request=response.request,
        extensions=response.extensions,
        history=response.history,
    )
