"""An HTTP server on loopback that records its requests and injects faults."""

import gzip
import json
import re
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.client import HTTPMessage
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self
from urllib.parse import urlsplit

_SQUEEZED = 1024
"""Bytes from which an answer is worth compressing."""


@dataclass
class Request:
    """A request, the status of its answer (0 for none), and the bytes sent of the answer's body."""

    method: str
    target: str
    headers: HTTPMessage = field(repr=False)
    body: bytes = field(default=b"", repr=False)
    status: int = 0
    sent: int = 0

    @property
    def path(self) -> str:
        return urlsplit(self.target).path

    @property
    def host(self) -> str:
        """The name that the client knows this machine by."""
        return self.headers.get("Host", "").split(":")[0]

    @property
    def token(self) -> str | None:
        given = self.headers.get("Authorization")
        return given and given.removeprefix("Bearer ")

    def json(self) -> Any:
        return json.loads(self.body)


@dataclass
class Answer:
    """An answer: a file's bytes or JSON, which is compressed if `plain`."""

    body: bytes
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    plain: bool = False

    @classmethod
    def json(cls, value: Any, status: int = 200, headers: dict[str, str] | None = None) -> Self:
        headers = {"Content-Type": "application/json", **(headers or {})}
        return cls(json.dumps(value).encode(), status, headers, plain=True)

    def fit(self, request: HTTPMessage) -> None:
        """Keep only the requested end, or compress the body if the client accepts it."""
        span = re.fullmatch(r"bytes=(\d+)-", request.get("Range", ""))
        size = len(self.body)
        if span and self.status == 200:
            start = int(span[1])
            self.status, self.body = 206, self.body[start:]
            self.headers["Content-Range"] = f"bytes {start}-{size - 1}/{size}"
        elif self.plain and size >= _SQUEEZED and "gzip" in request.get("Accept-Encoding", ""):
            self.body = gzip.compress(self.body, 1)
            self.headers["Content-Encoding"] = "gzip"


@dataclass
class Fault:
    """What goes wrong with requests.

    Attributes:
        method, path: The requests' method, and a regular expression found in their path.
        times, after: The number of requests, and of those that succeed before.
        status: Answer this instead, such as 503.
        drop: Close the connection after so many bytes of the request's body, or of the answer's.
        lost: Handle the request, and close the connection instead of answering.
        cut: Omit so many bytes at the end of the answer.
        wrong: Change the last byte of the answer.
        call: Called just before, such as for a commit by somebody else.
    """

    method: str
    path: str
    times: int = 1
    after: int = 0
    status: int | None = None
    drop: int | None = None
    lost: bool = False
    cut: int | None = None
    wrong: bool = False
    call: Callable[[], object] | None = None

    def meets(self, request: Request) -> bool:
        """Whether this goes wrong with a request; counts."""
        if request.method != self.method or not re.search(self.path, request.path):
            return False
        self.after -= 1
        if self.after >= 0 or self.times <= 0:
            return False
        self.times -= 1
        return True

    def spoil(self, answer: Answer) -> None:
        """Change the body of an answer."""
        if self.cut is not None:
            answer.body = answer.body[: -self.cut]
        if self.wrong:
            answer.body = answer.body[:-1] + bytes([answer.body[-1] ^ 1])


_NONE = Fault("", "")


class LoopbackServer(ABC):
    """Answers requests one at a time, however many come; `answer` says what.

    Attributes:
        asked: Every request so far.
        down: Answer 503 to everything.
        latency: Seconds that every answer takes longer.
    """

    def __init__(self) -> None:
        self.asked: list[Request] = []
        self.down = False
        self.latency = 0.0
        self._faults: list[Fault] = []
        self._lock = threading.RLock()
        self._server = _Threads(("127.0.0.1", 0), _handler(self))

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self._server.server_address[1]}"

    @property
    def elsewhere(self) -> str:
        """The same under another hostname."""
        return f"http://localhost:{self._server.server_address[1]}"

    @property
    def requests(self) -> list[str]:
        """Every request so far, as `GET /api/datasets/…`."""
        return [f"{one.method} {one.path}" for one in self.asked]

    @property
    def received(self) -> int:
        """Bytes of all requests' bodies so far."""
        return sum(len(one.body) for one in self.asked)

    def fault(self, method: str, path: str, **what: Any) -> Fault:
        """Let something go wrong; see `Fault`."""
        self._faults.append(Fault(method, path, **what))
        return self._faults[-1]

    @abstractmethod
    def answer(self, request: Request) -> Answer:
        """Return what is answered."""

    @contextmanager
    def running(self) -> Iterator[Self]:
        thread = threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self._server.shutdown()
            self._server.server_close()
            thread.join()

    def begin(self, request: Request) -> Fault:
        """Note a request, and return what goes wrong with it."""
        with self._lock:
            self.asked.append(request)
            return next((fault for fault in self._faults if fault.meets(request)), _NONE)

    def finish(self, request: Request, fault: Fault) -> Answer:
        """Return the answer to a request whose body has come."""
        time.sleep(self.latency)
        if fault.status is not None or self.down:
            answer = Answer.json({"error": "something went wrong"}, fault.status or 503)
        else:
            if fault.call is not None:
                fault.call()
            with self._lock:
                answer = self.answer(request)
            fault.spoil(answer)
        answer.fit(request.headers)
        return answer


class _Threads(ThreadingHTTPServer):
    request_queue_size = 128


def _handler(server: LoopbackServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True

        def do_GET(self) -> None:
            request = Request(self.command, self.path, self.headers)
            fault = server.begin(request)
            length = int(self.headers.get("Content-Length", 0))
            if fault.drop is not None and length:
                request.body = self.rfile.read(min(fault.drop, length))
                return self.hang_up()
            request.body = self.rfile.read(length)
            answer = server.finish(request, fault)
            if fault.lost:
                return self.hang_up()
            body = answer.body if self.command != "HEAD" else b""
            body = body[: fault.drop]  # all of it, if none is dropped
            request.status, request.sent = answer.status, len(body)
            self.send_response(answer.status)
            for name, text in {**answer.headers, "Content-Length": str(len(answer.body))}.items():
                self.send_header(name, text)
            self.end_headers()
            self.wfile.write(body)
            if fault.drop is not None:
                self.hang_up()

        do_HEAD = do_POST = do_PUT = do_DELETE = do_GET

        def hang_up(self) -> None:
            self.close_connection = True
            self.connection.shutdown(socket.SHUT_RDWR)

        def log_message(self, *_: Any) -> None:
            pass

    return Handler
