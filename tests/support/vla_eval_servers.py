"""Servers of vla-eval for tests, in a thread or by `python -m support.vla_eval_servers NAME PORT`.

All of them are served by vla-eval itself.
"""

import asyncio
import os
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from support.policy_calls import info, observation, section
from vla_eval.model_servers import mme_vla
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve, serve_async
from vla_eval.specs import IMAGE_RGB, RAW
from websockets.exceptions import ConnectionClosedOK

from robomme_interference_data.evaluate.policies.registry import make_policy

ALL = {"send_state": True, "send_wrist_image": True, "send_video_history": True}
"""What a server with a memory asks for."""

NOTES = "VLA_EVAL_NOTES"
"""Environment variable: a folder for files that servers write."""


class Blind(PredictModelServer):
    """Holds the pose that it sees: it did not ask for histories."""

    params: ClassVar[dict[str, Any]] = {"send_state": True}

    def __init__(self) -> None:
        super().__init__(chunk_size=None)

    def get_observation_params(self) -> dict[str, Any]:
        return self.params

    def get_action_spec(self) -> dict[str, Any]:
        return {"actions": RAW}

    def get_observation_spec(self) -> dict[str, Any]:
        return {"agentview": IMAGE_RGB, "state": RAW}

    def predict(self, obs: Any, ctx: Any) -> Any:
        return {"actions": pose(obs["states"])}


class Remembering(Blind):
    """Repeats the lesson's pose that the simulator of `worlds` asks for, out of its memory."""

    params: ClassVar = ALL

    def __init__(self) -> None:
        super().__init__()
        self.memory = dict[str, Any]()

    def predict(self, obs: Any, ctx: Any) -> Any:
        if obs.get("episode_restart"):
            self.memory[ctx.session_id] = obs.get("state_history")
            history = obs.get("video_history", []), obs.get("wrist_video_history", [])
            assert {len(one) for one in history} == {len(obs.get("state_history", []))}
        states = self.memory[ctx.session_id]
        return {"actions": pose(obs["states"] if states is None else states[3])}


class OneQueue(Remembering):
    """Keeps one queue of actions for all clients, each of which empties it when an episode starts.

    vla-eval's LeRobot server with `use_select_action` does so. Alone, a client gets the same
    actions as from `Remembering`; beside others it gets some that were made for another's episode.
    """

    def __init__(self) -> None:
        super().__init__()
        self.queue = deque[Any]()

    async def on_episode_start(self, config: Any, ctx: Any) -> None:
        self.queue.clear()
        await super().on_episode_start(config, ctx)

    def predict(self, obs: Any, ctx: Any) -> Any:
        made = super().predict(obs, ctx)  # keeps the history
        if not self.queue:
            self.queue.extend([made] * 4)
        return self.queue.popleft()


class Refusing(Remembering):
    """Raises at the goals of one family."""

    def predict(self, obs: Any, ctx: Any) -> Any:
        if "VideoRepick" in obs["task_description"]:
            raise RuntimeError("this goal is odd")
        return super().predict(obs, ctx)


class Batching(Remembering):
    """Answers several sessions at once, and counts them in the file `batches` of `NOTES`."""

    def __init__(self) -> None:
        super().__init__()
        self.max_batch_size, self.max_wait_time = 2, 0.05

    def predict_batch(self, obs_batch: Any, ctx_batch: Any) -> Any:
        with Path(os.environ[NOTES], "batches").open("a") as file:
            file.write(f"{len(obs_batch)}\n")
        return [self.predict(*pair) for pair in zip(obs_batch, ctx_batch, strict=True)]


class Dying(Remembering):
    """Kills its process at its 20th observation, once: a file in `NOTES` keeps it alive then."""

    def predict(self, obs: Any, ctx: Any) -> Any:
        died = Path(os.environ[NOTES], "died")
        if ctx.step == 20 and not died.exists():
            died.touch()
            os._exit(3)
        return super().predict(obs, ctx)


class Leaving(Remembering):
    """Closes the connection after its third answer, with code 1000, in the n-th episodes.

    It succeeds at its fifth answer. A client that continues on a new connection gets answers
    without the history, and fails.
    """

    def __init__(self, *episodes: int):
        super().__init__()
        self.episodes, self.started = episodes, 0

    async def on_episode_start(self, config: Any, ctx: Any) -> None:
        self.started += 1
        await super().on_episode_start(config, ctx)

    async def on_observation(self, obs: Any, ctx: Any) -> None:
        self.memory.setdefault(ctx.session_id, None)
        await super().on_observation(obs, ctx)
        if ctx.step == 2 and self.started in self.episodes:
            raise ConnectionClosedOK(None, None)  # at which vla-eval closes the connection

    def predict(self, obs: Any, ctx: Any) -> Any:
        remembered = super().predict(obs, ctx)
        return remembered if ctx.step >= 4 else {"actions": pose(obs["states"])}


class Reloading(Leaving):
    """Serves another model after it closed a connection."""

    def get_observation_params(self) -> dict[str, Any]:
        return self.params | {"checkpoint": self.started}


class Full(Leaving):
    """Cannot start the n-th episodes, and answers their observations all the same."""

    async def on_episode_start(self, config: Any, ctx: Any) -> None:
        await super().on_episode_start(config, ctx)
        if self.started in self.episodes:
            raise MemoryError("full")

    async def on_observation(self, obs: Any, ctx: Any) -> None:
        self.memory.setdefault(ctx.session_id, None)
        await Remembering.on_observation(self, obs, ctx)


class Noting(Blind):
    """Notes what happens, as (session, event, content), and answers what a function returns."""

    def __init__(
        self,
        params: dict[str, Any] | None = None,
        *,
        answer: Callable[[Any], Any] = lambda obs: np.zeros(8),
        actions: dict[str, Any] | None = None,
        observations: dict[str, Any] | None = None,
        chunk_size: int | None = None,
    ):
        super().__init__()
        self.params = params or {}  # type: ignore[misc]
        self.answer, self.chunk_size = answer, chunk_size
        self.actions, self.observations = actions or {}, observations or {}
        self.events = list[tuple[str, str, Any]]()

    def get_action_spec(self) -> dict[str, Any]:
        return self.actions

    def get_observation_spec(self) -> dict[str, Any]:
        return self.observations

    async def on_episode_start(self, config: Any, ctx: Any) -> None:
        self.events.append((ctx.session_id, "start", config))
        await super().on_episode_start(config, ctx)

    async def on_observation(self, obs: Any, ctx: Any) -> None:
        self.events.append((ctx.session_id, "observation", obs))
        await super().on_observation(obs, ctx)

    async def on_episode_end(self, result: Any, ctx: Any) -> None:
        self.events.append((ctx.session_id, "end", result))
        await super().on_episode_end(result, ctx)

    def predict(self, obs: Any, ctx: Any) -> Any:
        return {"actions": self.answer(obs)}


class MmeVlaModelServer(mme_vla.MmeVlaModelServer):  # type: ignore[misc]
    """vla-eval's own server without its weights: notes what its policy gets."""

    def __init__(self, use_history: bool = True):
        PredictModelServer.__init__(self, chunk_size=10)
        self.use_history, self.state_dim, self.image_resolution = use_history, 8, 224
        self.image_key, self.wrist_image_key, self.state_key = "image", "wrist", "state"
        self._state_warned, self._policy = False, self
        self.calls = list[tuple[str, Any]]()

    def reset(self) -> None:
        self.calls.append(("reset", None))

    def add_buffer(self, given: Any) -> None:
        self.calls.append(("add_buffer", given))

    def infer(self, given: Any) -> Any:
        self.calls.append(("infer", given))
        return {"actions": np.zeros((10, 8))}


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


@contextmanager
def running(server: Any, port: int | None = None) -> Iterator[int]:
    """Serve in a thread of this process; gives the port."""
    port = port or free_port()
    loop = asyncio.new_event_loop()
    task = loop.create_task(serve_async(server, "127.0.0.1", port))

    def run() -> None:
        with suppress(asyncio.CancelledError):
            loop.run_until_complete(task)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield port
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(20)
        loop.close()


@contextmanager
def connected(server: Any, *options: str) -> Iterator[Any]:
    """A policy that asks a server in a thread."""
    with running(server) as port, closing(made(port, *options)) as policy:
        yield policy


def made(port: int, *options: str) -> Any:
    return make_policy(
        f"vla-eval:ws://127.0.0.1:{port}", ("checkpoint=mine/1", "connect_s=20", *options)
    )


def play(policy: Any, history: int = 0, live: int = 1) -> list[Any]:
    """A rollout: the history in chunks of two frames, then live observations; the actions."""
    policy.reset(info(history))
    for start in range(0, history, 2):
        frames, states = section(start, min(start + 2, history))
        policy.add_history(frames, states, history)
        for array in (*frames.values(), states):
            array[:] = 0  # callers reuse their arrays
    return [policy.act(observation(history + one), "pick") for one in range(live)]


@contextmanager
def serving(name: str, port: int | None = None) -> Iterator[str]:
    """A server of this file in a process of its own; gives its address."""
    port = port or free_port()
    command = [sys.executable, "-m", "support.vla_eval_servers", name, str(port)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as server:
        try:
            end = time.monotonic() + 60
            while True:
                try:
                    with urllib.request.urlopen(f"http://127.0.0.1:{port}/health"):
                        break
                except OSError:
                    assert time.monotonic() < end and server.poll() is None
                    time.sleep(0.1)
            yield f"ws://127.0.0.1:{port}"
        finally:
            server.kill()


def pose(state: Any) -> Any:
    return np.append(np.asarray(state)[:7], 1.0).astype(np.float32)


if __name__ == "__main__":
    serve(globals()[sys.argv[1]](), "127.0.0.1", int(sys.argv[2]))
