"""An HTTP client whose limits cover a whole answer: its time, and its size."""

import socket
import threading
from contextlib import suppress
from typing import Any
from weakref import WeakSet

import httpx

MAX_BYTES = 16 << 20
"""Bytes of an answer at most; those to a question have a few thousand."""


class AnswerTooLongError(httpx.RequestError):
    """An answer has more bytes than `MAX_BYTES`."""


class BoundedClient(httpx.Client):
    """An HTTP client for one thread, with limits that a server cannot stretch.

    The read timeout of `httpx` starts anew with each byte: a server that sends one now and then,
    or never ends its answer, would keep a client forever.
    """

    def __init__(self, answer_s: float):
        super().__init__(follow_redirects=True, headers={"Accept-Encoding": "identity"})
        self._answer_s = answer_s
        self._streams: WeakSet[Any] = WeakSet()

    def send(self, request: httpx.Request, **options: Any) -> httpx.Response:  # type: ignore[override]
        """Send a request and read its answer, uncompressed, within the limits."""
        expired = threading.Event()

        def expire() -> None:
            expired.set()
            for stream in self._streams:
                with suppress(OSError):  # already closed
                    # Not the method of a TLS socket, which another thread may not call.
                    socket.socket.shutdown(stream.get_extra_info("socket"), socket.SHUT_RDWR)

        request.extensions = {**request.extensions, "trace": self._keep_stream}
        timer = threading.Timer(self._answer_s, expire)
        timer.daemon = True
        timer.start()
        try:
            response = _read(super().send(request, **{**options, "stream": True}))
        except httpx.TransportError:
            if not expired.is_set():
                raise
        finally:
            timer.cancel()
        if expired.is_set():  # an ended connection may also have been taken for the answer's end
            raise httpx.ReadTimeout("no whole answer in time", request=request)
        return response

    def _keep_stream(self, event: str, info: dict[str, Any]) -> None:
        """Keep the connections that are opened, to end them: see httpx's `trace` extension."""
        if event.endswith((".connect_tcp.complete", ".start_tls.complete")):
            self._streams.add(info["return_value"])


def _read(response: httpx.Response) -> httpx.Response:
    """Return a streamed response as one that was read."""
    content = bytearray()
    try:
        for chunk in response.iter_raw():
            content += chunk
            if len(content) > MAX_BYTES:
                raise AnswerTooLongError(f"an answer of more than {MAX_BYTES} bytes")
    finally:
        response.close()
    headers = [(k, v) for k, v in response.headers.multi_items() if k != "content-encoding"]
    return httpx.Response(
        response.status_code,
        headers=headers,
        content=bytes(content),
        request=response.request,
        extensions=response.extensions,
        history=response.history,
    )
