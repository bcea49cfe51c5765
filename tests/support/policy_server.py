"""A policy server on the loopback interface: the protocol from the other side, without a model.

It keeps the account of a memory as the released servers do: frames are counted on from the last
reset, `exec_start_idx` above 0 sets the length of the history, actions are refused while the
memory is empty or has more frames than positions, an error goes out as a traceback in a text frame
and then close code 1011, its metadata is empty, and while it works it answers nothing else, pings
included. Beyond them it holds clients to the order of calls. It answers with actions that hold the
arm where it is, float64 `(20, 8)`.
"""

import asyncio
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from typing import Any

import msgpack
import numpy as np
from websockets.asyncio.server import Request, Response, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.protocol import State

CHUNK = 20
"""Actions in an answer, more than are executed, as the released servers give them."""

LIVE = 16
"""Most frames that may come between two answers."""

POSITIONS = 4096


def encode(value: Any) -> Any:
    """Lay out NumPy values for msgpack; written apart from the client's code, to check it."""
    if isinstance(value, np.ndarray):
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic):
        return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}
    raise TypeError(type(value))


def decode(entries: dict[Any, Any]) -> Any:
    if b"__ndarray__" in entries:
        return np.frombuffer(entries[b"data"], entries[b"dtype"]).reshape(entries[b"shape"])
    if b"__npgeneric__" in entries:
        return np.dtype(entries[b"dtype"]).type(entries[b"data"])
    return entries


class Memory:
    """What a server knows of the rollout that runs.

    Attributes:
        frames: Front images since the last reset, in order, if `keep`.
        states: Their states.
        count: How many there were.
        exec_start_idx: Number of history frames.
        calls: Every call since the server was started, as in the log.
    """

    def __init__(self, keep: bool = True):
        self.keep = keep
        self.calls: list[dict[str, Any]] = []
        self._is_reset = False
        self._clear()

    def _clear(self) -> None:
        self.frames: list[np.ndarray] = []
        self.states: list[np.ndarray] = []
        self.count = self.exec_start_idx = self._fresh = self._answers = 0

    def reset(self) -> None:
        self._clear()
        self._is_reset = True

    def add_buffer(self, message: dict[str, Any]) -> None:
        images, states, start = message["images"], message["state"], message["exec_start_idx"]
        assert self._is_reset, "reset first"
        assert images.dtype == np.uint8 and images.ndim == 5, (images.dtype, images.shape)
        assert images.shape[1] == 1 and images.shape[4] == 3, images.shape
        assert states.dtype == np.float32 and states.shape == (len(images), 8), states.shape
        assert len(images) > 0, "no frames"
        if start > 0:
            assert not self._answers, "history after the first answer"
            assert self.exec_start_idx in (0, start), "another length of the history"
            assert self.exec_start_idx == start or not self.count, "history after other frames"
            self.exec_start_idx = start
        self.count += len(images)
        self._fresh += len(images)
        if self.keep:
            self.frames += [image[0].copy() for image in images]
            self.states += [state.copy() for state in states]

    def infer(self, message: dict[str, Any]) -> dict[str, Any]:
        assert self.count > 0, "history feats is empty, add buffer first"
        assert self.count <= POSITIONS, f"index {self.count - 1} is out of bounds"
        live = self.count - self.exec_start_idx
        if not self._answers:
            assert live == 1, f"{live} live frames before the first answer"
        else:
            assert 0 < self._fresh <= LIVE, f"{self._fresh} frames since the last answer"
        return self.answer(message)

    def answer(self, message: dict[str, Any]) -> dict[str, Any]:
        image, wrist = message["observation/image"], message["observation/wrist_image"]
        state, prompt = message["observation/state"], message["prompt"]
        for picture in (image, wrist):
            assert picture.dtype == np.uint8 and picture.shape[2:] == (3,), picture.shape
        assert state.dtype == np.float32 and state.shape == (8,), (state.dtype, state.shape)
        assert isinstance(prompt, str) and prompt, prompt
        self._answers += 1
        self._fresh = 0
        actions = np.tile(state.astype(np.float64), (CHUNK, 1))
        actions[:, 7] = 1.0 if state[7] > 0.02 else -1.0  # 0 to 0.04 m open; -1 closes
        return {"state": state, "actions": actions, "infer_time_ms": 1.0}


class Memoryless(Memory):
    """What a server without a memory knows of it: such a one takes frames, and keeps none."""

    def add_buffer(self, message: dict[str, Any]) -> None:
        pass

    def infer(self, message: dict[str, Any]) -> dict[str, Any]:
        return self.answer(message)


class RetraceMemory(Memory):
    """A server that retraces, and whose reset may clear nothing."""

    def __init__(self, clears: bool):
        self.clears, self.path = clears, list[np.ndarray]()
        super().__init__()

    def reset(self) -> None:
        super().reset()
        if self.clears:
            self.path.clear()

    def add_buffer(self, message: dict[str, Any]) -> None:
        super().add_buffer(message)
        if message["exec_start_idx"] > 0:
            self.path += list(message["state"])

    def answer(self, message: dict[str, Any]) -> dict[str, Any]:
        answer = super().answer(message)
        chunk, self.path[:16] = self.path[:16], []
        return answer | ({"actions": np.stack(chunk).astype(np.float64)} if chunk else {})


_WORDS = ("prompt", "simple_subgoal", "grounded_subgoal")


class PolicyServer:
    """Serves one memory.

    Attributes:
        memory: The memory.
        port: The port, once the server runs.
        api_key: Refuse clients without this key with 401.
        before: Called with each message before it is handled; it may raise, sleep, or return a
            `str` or `bytes` that is sent instead of an answer, `CLOSE`, or `COMPILE`, which works
            for so long that the server's keepalive closes the connection; give it short `options`.
        status: Status that all requests are answered with; None to serve them.
        connections: How many there were; `/healthz` is none.
        options: For websockets' `serve`.
    """

    CLOSE, COMPILE = object(), object()

    def __init__(self, memory: Memory | None = None, *, port: int = 0):
        self.memory = memory if memory is not None else Memory()
        self.metadata: dict[str, Any] = {}
        self.port = port
        self.api_key: str | None = None
        self.before: Callable[[dict[str, Any]], Any] = lambda message: None
        self.status: HTTPStatus | None = None
        self.connections = 0
        self._opened = list[ServerConnection]()
        self.options: dict[str, Any] = {"compression": None, "max_size": None}
        self._started = threading.Event()

    @property
    def calls(self) -> list[dict[str, Any]]:
        return self.memory.calls

    @property
    def url(self) -> str:
        return f"websocket://127.0.0.1:{self.port}"

    async def serve(self, on_start: Callable[[], None]) -> None:
        async with serve(
            self._handle, "127.0.0.1", self.port, process_request=self._process, **self.options
        ) as server:
            self.port = server.sockets[0].getsockname()[1]
            self._stop = asyncio.get_running_loop().create_future()
            on_start()
            await self._stop

    @contextmanager
    def running(self) -> Iterator["PolicyServer"]:
        """Serve in a thread of this process."""
        self._started.clear()
        thread = threading.Thread(
            target=lambda: asyncio.run(self.serve(self._started.set)), daemon=True
        )
        thread.start()
        assert self._started.wait(30)
        try:
            yield self
        finally:
            loop = self._stop.get_loop()
            loop.call_soon_threadsafe(self._stop.set_result, None)
            thread.join(30)
            assert not thread.is_alive()

    def close_connections(self) -> None:
        """Close each connection with code 1000, as a server that shuts down does."""
        for opened in self._opened:
            asyncio.run_coroutine_threadsafe(opened.close(), self._stop.get_loop()).result(30)

    def _process(self, connection: ServerConnection, request: Request) -> Response | None:
        key = request.headers.get("Authorization")
        if self.api_key is not None and key != f"Api-Key {self.api_key}":
            return connection.respond(HTTPStatus.UNAUTHORIZED, "no\n")
        if self.status is not None:
            return connection.respond(self.status, "no\n")
        return connection.respond(HTTPStatus.OK, "OK\n") if request.path == "/healthz" else None

    async def _handle(self, connection: ServerConnection) -> None:
        self.connections += 1
        self._opened.append(connection)
        await connection.send(msgpack.packb(self.metadata, default=encode))
        while True:
            try:
                data = await connection.recv()
                message = msgpack.unpackb(data, object_hook=decode)
                answer = self._answer(message)
                if answer is self.COMPILE:
                    while connection.state is State.OPEN:
                        time.sleep(0.12)
                        await asyncio.sleep(0)  # here its keepalive wakes up
                    self._call(message)
                    return
                if answer is self.CLOSE:
                    connection.transport.abort()
                    return
                await connection.send(answer)
            except ConnectionClosed:
                return
            except Exception:
                await connection.send(traceback.format_exc())
                await connection.close(1011, "Internal server error.")
                return

    def _answer(self, message: dict[str, Any]) -> Any:
        answer = self.before(message)
        return msgpack.packb(self._call(message), default=encode) if answer is None else answer

    def _call(self, message: dict[str, Any]) -> dict[str, Any]:
        if message.get("reset", False):
            self.memory.calls.append({"call": "reset"})
            self.memory.reset()
            return {"reset_finished": True, "reset_time_ms": 0.5}
        if message.get("add_buffer", False):
            start = message["exec_start_idx"]
            frames = len(message["images"])
            call = {"call": "add_buffer", "frames": frames, "exec_start_idx": start}
            self.memory.calls.append(call)
            self.memory.add_buffer(message)
            return {"add_buffer_finished": True, "add_buffer_time_ms": np.float64(0.5)}
        self.memory.calls.append(
            {"call": "infer"} | {name: message[name] for name in _WORDS if name in message}
        )
        return self.memory.infer(message)
