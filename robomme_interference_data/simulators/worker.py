"""A simulator in a process of its own, so that its crash is not ours."""

import multiprocessing
import pickle
import time
from multiprocessing.connection import Connection
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import SimulatorCrashError
from robomme_interference_data.simulators.base import (
    Demonstration,
    EpisodeInfo,
    Observation,
    Status,
)
from robomme_interference_data.simulators.registry import make_simulator

__all__ = ["RemoteSimulator"]


class RemoteSimulator:
    """The same as `make_simulator(name, **options)`, in a worker process.

    The process starts with the first reset. When it dies, or takes too long over an episode, it
    is ended and the call raises `SimulatorCrashError`; the next reset starts a fresh one.

    Args:
        name: Name of the simulator.
        episode_s: Seconds that the simulator may take over one episode, all calls together, not
            counting the time between them.
        **options: For the simulator.
    """

    def __init__(self, name: str = "tabletop", episode_s: float = 600.0, **options: Any):
        self._name, self._options = name, options
        self._episode_s = episode_s
        self._left = episode_s
        self._process: Any = None
        self._pipe: Connection | None = None

    def reset(
        self, episode_id: str, demonstration: bool = True
    ) -> tuple[Demonstration, Observation, EpisodeInfo]:
        """Start an episode; see `Simulator.reset`."""
        self._left = self._episode_s
        if self._process is None:
            self._start()
        result: tuple[Demonstration, Observation, EpisodeInfo] = self._call(
            "reset", episode_id, demonstration
        )
        return result

    def step(self, action: NDArray[np.float32], observe: bool = True) -> tuple[Observation, Status]:
        """Execute one action; see `Simulator.step`."""
        result: tuple[Observation, Status] = self._call("step", action, observe)
        return result

    def act(self, policy: str) -> NDArray[np.float32]:
        """Return the next action of a built-in policy; see `Simulator.act`."""
        result: NDArray[np.float32] = self._call("act", policy)
        return result

    @property
    def chance(self) -> float:
        """Probability that a guess at the hidden answer of the present episode is right."""
        result: float = self._call("chance")
        return result

    @property
    def pid(self) -> int | None:
        """The worker's process id, or None if there is none."""
        return None if self._process is None else self._process.pid

    def close(self) -> None:
        """End the worker."""
        process, pipe = self._process, self._pipe
        self._process = self._pipe = None
        if pipe is not None:
            pipe.close()  # the worker ends when it reads the end of its pipe
        if process is not None:
            process.join(timeout=5)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _start(self) -> None:
        # Not a fork: the parent may hold threads and locks, of torch or of a video decoder.
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, self._name, self._options), daemon=True
        )
        self._process.start()
        theirs.close()

    def _call(self, what: str, *arguments: Any) -> Any:
        if self._pipe is None:
            raise SimulatorCrashError(
                f"cannot {what}: the simulator's process has ended", "Reset to start another one."
            )
        started = time.monotonic()
        try:
            _send(self._pipe, (what, arguments))
            if not self._pipe.poll(max(self._left, 0.0)):
                self._end()
                raise SimulatorCrashError(
                    f"the {self._name} simulator took more than {self._episode_s:g} s over an "
                    f"episode, waiting for {what}; its process was ended"
                )
            worked, result = _receive(self._pipe)
        except (EOFError, ConnectionError) as error:
            self._process.join(timeout=5)
            code = self._process.exitcode
            self._end()
            raise SimulatorCrashError(
                f"the {self._name} simulator's process died during {what}, exit code {code}"
            ) from error
        finally:
            self._left -= time.monotonic() - started
        if not worked:
            raise result
        return result

    def _end(self) -> None:
        if self._process is not None and self._process.is_alive():
            self._process.kill()
        self.close()


def _serve(pipe: Connection, name: str, options: dict[str, Any]) -> None:
    """Answer calls until the other side closes the pipe."""
    simulator = None
    while True:
        try:
            what, arguments = _receive(pipe)
        except (EOFError, ConnectionError):
            break
        try:
            simulator = simulator or make_simulator(name, **options)
            asked = getattr(simulator, what)
            answer = True, asked(*arguments) if callable(asked) else asked
        except Exception as error:
            answer = False, error
        _send(pipe, answer)
    if simulator is not None:
        simulator.close()


def _send(pipe: Connection, value: Any) -> None:
    """Send a value, the memory of its arrays without a copy."""
    buffers: list[pickle.PickleBuffer] = []
    head = pickle.dumps(value, protocol=5, buffer_callback=buffers.append)
    pipe.send_bytes(pickle.dumps((head, [buffer.raw().nbytes for buffer in buffers])))
    for buffer in buffers:
        pipe.send_bytes(buffer.raw())


def _receive(pipe: Connection) -> Any:
    head, sizes = pickle.loads(pipe.recv_bytes())
    buffers = []
    for size in sizes:
        buffer = bytearray(size)
        pipe.recv_bytes_into(buffer)
        buffers.append(buffer)
    return pickle.loads(head, buffers=buffers)
