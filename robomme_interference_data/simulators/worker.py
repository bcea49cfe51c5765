"""A simulator in a process of its own, so that its crash is not ours."""

import multiprocessing
import pickle
import signal
import time
from contextlib import suppress
from multiprocessing import resource_tracker
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
    is ended and the call raises `SimulatorCrashError`; the next reset starts a fresh one. So it
    does after an exception that interrupts a call, such as `KeyboardInterrupt`, which stays
    itself: no answer is ever taken for that of another call.

    Args:
        name: Name of the simulator.
        episode_s: Seconds that the simulator may take over one episode, all calls together, not
            counting the time between them.
        **options: For the simulator.
    """

    remote = True

    def __init__(self, name: str = "tabletop", episode_s: float = 600.0, **options: Any):
        self._name, self._options = name, options
        self._episode_s = episode_s
        self._left = episode_s
        self._process: Any = None
        self._pipe: Connection | None = None
        self._closed = False

    def reset(
        self, episode_id: str, demonstration: bool = True
    ) -> tuple[Demonstration, Observation, EpisodeInfo]:
        """Start an episode; see `Simulator.reset`."""
        self._left = self._episode_s
        if self._process is None and not self._closed:
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
        """End the worker; further calls but `close` are errors."""
        self._closed = True
        if self._pipe is not None:
            self._pipe.close()  # the worker ends when it reads the end of its pipe
            self._process.join(timeout=5)
            self._end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def _start(self) -> None:
        # Not a fork: the parent may hold threads and locks, of torch or of a video decoder.
        context = multiprocessing.get_context("spawn")
        pipe, theirs = context.Pipe()
        process = context.Process(
            target=_serve, args=(theirs, self._name, self._options), daemon=True
        )
        # Ctrl-C is the parent's to handle: the worker inherits the mask, from its first moment.
        resource_tracker.ensure_running()  # else the start does it, which takes the mask away
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            process.start()
            self._process, self._pipe = process, pipe
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        theirs.close()

    def _call(self, what: str, *arguments: Any) -> Any:
        if self._closed:
            raise SimulatorCrashError(
                f"cannot {what}: the simulator is closed", "Make another one."
            )
        if self._pipe is None:
            raise SimulatorCrashError(
                f"cannot {what}: the simulator's process has ended", "Reset to start another one."
            )
        started, answered = time.monotonic(), False
        try:
            _send(self._pipe, (what, arguments))
            if not self._pipe.poll(max(self._left, 0.0)):
                raise SimulatorCrashError(
                    f"the {self._name} simulator took more than {self._episode_s:g} s over an "
                    f"episode, waiting for {what}; its process was ended"
                )
            worked, result = _receive(self._pipe)
            answered = True
        except (EOFError, OSError) as error:
            self._process.join(timeout=5)
            raise SimulatorCrashError(
                f"the {self._name} simulator's process died during {what}, "
                f"exit code {self._process.exitcode}"
            ) from error
        finally:
            self._left -= time.monotonic() - started
            if not answered:  # what is still to come would be taken for the next call's answer
                self._end()
        if not worked:
            raise result
        return result

    def _end(self) -> None:
        process, pipe = self._process, self._pipe
        self._process = self._pipe = None
        process.kill()
        process.join()
        process.close()
        if pipe is not None:
            pipe.close()


def _serve(pipe: Connection, name: str, options: dict[str, Any]) -> None:
    """Answer calls until the other side closes the pipe."""
    simulator = None
    with suppress(EOFError, OSError):
        while True:
            what, arguments = _receive(pipe)
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
