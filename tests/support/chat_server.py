"""A chat endpoint on loopback, as OpenAI has it: real HTTP, with a fault now and then.

    with ChatServer(answer=lambda seen: "A") as server:
        model = MODELS.make(f"openai:{server.url}#tiny")

`answer` gets what was asked, `Seen`: the words, and the images as they came. `faults` are used up
one a question, in order, before it: `SLOW` (`slow_s` seconds), `BUSY` (429, `Retry-After: 0.01`),
`BUSY_SOME_TIME` (429 alone), `BUSY_FOR_AN_HOUR` (429, `Retry-After: 3600`), `BROKEN` (500),
`GARBAGE` (no JSON), `EMPTY` (JSON that is no answer), `CLOSED` (no answer at all), `REFUSED` (no
words), `GONE` (404, as for another model), `LOCKED` (401), `UNCOUNTED` (tells no tokens), `DRIPS`
and `DRIPS_HEADERS` (a byte every 20 ms), `ENDLESS` (blanks as fast as they are read).
"""

import base64
import io
import json
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from PIL import Image

SLOW, BUSY, BUSY_SOME_TIME, BUSY_FOR_AN_HOUR = "slow", "busy", "busy some time", "busy for an hour"
BROKEN, GARBAGE, EMPTY, CLOSED, REFUSED = "broken", "garbage", "empty", "closed", "refused"
GONE, LOCKED, UNCOUNTED = "gone", "locked", "uncounted"
DRIPS, DRIPS_HEADERS, ENDLESS, DEEP = "drips", "drips headers", "endless", "deep"
BRACKETS = b"[" * 8_000_000


@dataclass(frozen=True)
class Seen:
    """What was asked: the request's body, its words, images and the bytes of its videos."""

    body: dict[str, Any]
    text: str
    images: list[NDArray[np.uint8]]
    videos: list[bytes]

    @classmethod
    def of(cls, body: dict[str, Any]) -> Self:
        text, images, videos = "", [], []
        for message in body["messages"]:
            content = message["content"]
            parts = [{"type": "text", "text": content}] if isinstance(content, str) else content
            for part in parts:
                if part["type"] == "text":
                    text += part["text"]
                elif part["type"] == "image_url":
                    data = _data(part["image_url"]["url"], "image/png")
                    images.append(np.asarray(Image.open(io.BytesIO(data)).convert("RGB")))
                else:
                    videos.append(_data(part["video_url"]["url"], "video/mp4"))
        return cls(body, text, images, videos)


def _data(url: str, kind: str) -> bytes:
    head = f"data:{kind};base64,"
    assert url.startswith(head)
    return base64.b64decode(url.removeprefix(head), validate=True)


class ChatServer:
    """Serves one model in threads of this process; `seen` are all requests, in order."""

    def __init__(
        self,
        answer: Callable[[Seen], str] = lambda seen: "go on",
        *,
        model: str = "tiny",
        faults: Sequence[str] = (),
        slow_s: float = 0.3,
    ):
        self.answer, self.model, self.slow_s = answer, model, slow_s
        self.faults = list(faults)
        self.seen: list[Seen] = []
        self.connections = 0
        self._lock = threading.Lock()
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def setup(self) -> None:
                outer.connections += 1
                super().setup()

            def do_GET(self) -> None:
                if self.path != "/v1/models":
                    self._send(404, {"error": {"message": "no such page"}})
                    return
                if outer.faults[:1] == [DEEP]:
                    self._send(200, BRACKETS)
                    return
                models = [{"id": outer.model, "object": "model"}]
                self._send(200, {"object": "list", "data": models})

            def do_POST(self) -> None:
                size = int(self.headers["Content-Length"])
                outer._answer(self, json.loads(self.rfile.read(size)))

            def _send(self, status: int, body: Any, **headers: str) -> None:
                data = body if isinstance(body, bytes) else json.dumps(body).encode()
                self.send_response(status)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(data)))
                for name, value in headers.items():
                    self.send_header(name.replace("_", "-"), value)
                self.end_headers()
                with suppress(OSError):  # the client did not wait
                    self.wfile.write(data)

            def log_message(self, *_: object) -> None: ...

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.daemon_threads = True

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self._server.server_port}/v1"

    def __enter__(self) -> Self:
        threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def _answer(self, handler: Any, body: dict[str, Any]) -> None:
        with self._lock:
            self.seen.append(Seen.of(body))
            fault = self.faults.pop(0) if self.faults else None
        if body["model"] != self.model:
            fault = GONE
        if fault == SLOW:
            time.sleep(self.slow_s)
        if fault == CLOSED:
            handler.close_connection = True
            return
        if fault in (DRIPS, DRIPS_HEADERS, ENDLESS):
            handler.close_connection = True
            with suppress(OSError):  # the client has gone
                handler.wfile.write(b"HTTP/1.1 200 OK\r\n")
                if fault != DRIPS_HEADERS:
                    handler.wfile.write(b"Content-Type: application/json\r\n\r\n")
                while fault == ENDLESS:
                    handler.wfile.write(b" " * (1 << 20))
                while True:
                    handler.wfile.write(b" ")
                    time.sleep(0.02)
            return
        failed = {
            BUSY: (429, {"error": {"message": "too many"}}, {"Retry_After": "0.01"}),
            BUSY_SOME_TIME: (429, {"error": {"message": "too many"}}, {}),
            BUSY_FOR_AN_HOUR: (429, {"error": {"message": "too many"}}, {"Retry_After": "3600"}),
            LOCKED: (401, {"error": {"message": "who are you"}}, {}),
            BROKEN: (500, {"error": {"message": "out of memory"}}, {}),
            GARBAGE: (200, b"<html>busy</html>", {}),
            DEEP: (200, BRACKETS, {}),
            EMPTY: (200, {"object": "chat.completion", "choices": []}, {}),
            GONE: (404, {"error": {"message": "no such model"}}, {}),
        }
        if fault in failed:
            status, answer, headers = failed[fault]
            handler._send(status, answer, **headers)
            return
        text = None if fault == REFUSED else self.answer(self.seen[-1])
        message = {"role": "assistant", "content": text}
        choice = {"index": 0, "finish_reason": "stop", "message": message}
        completion = {"id": "1", "object": "chat.completion", "created": 0, "model": self.model}
        usage = {"prompt_tokens": 100, "completion_tokens": 5, "total_tokens": 105}
        completion |= {"choices": [choice], "usage": {} if fault == UNCOUNTED else usage}
        handler._send(200, completion)
