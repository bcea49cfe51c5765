"""What the leak probe compares: the values of a rollout, as digests."""

import hashlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.errors import InterferenceError, first_line
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.episode import Observation

from .plays import PlannedPlay


class Component(Enum):
    """What gives the values of a rollout."""

    RETRIEVAL = "retrieval step"
    SIMULATOR = "simulator"
    WRITER = "subgoal writer"
    POLICY = "policy"


class Event(NamedTuple):
    """A value in a rollout: what gave it, after how many steps, and a digest of it."""

    component: Component
    step: int
    digest: bytes


@dataclass
class Trace:
    """Collects the values of a rollout, in order.

    Attributes:
        most_steps: After so many steps the rollout ends.
        collects: Whether it collects anything: digests of images take time.
        events: The values.
        first_action: The first action; empty before it.
        error: The exception that ended the rollout, in a line, if a component raised it.
    """

    most_steps: int = MAX_STEPS
    collects: bool = True
    events: list[Event] = field(default_factory=list)
    first_action: tuple[float, ...] = ()
    error: str | None = None

    def received(self, frames: Sequence[int]) -> None:
        """Add which frames of the history the policy receives."""
        self._add(Component.RETRIEVAL, 0, np.array(frames, np.int64))

    def observed(self, step: int, observation: Observation) -> None:
        """Add an observation of the simulator."""
        images = [observation.images[name] for name in sorted(observation.images)]
        self._add(Component.SIMULATOR, step, *images, observation.state)

    def told(self, step: int, subgoal: Subgoal) -> None:
        """Add a subgoal."""
        self._add(Component.WRITER, step, _bytes(subgoal.grounded))

    def acted(self, step: int, action: NDArray[np.float32]) -> None:
        """Add an action of the policy."""
        self.first_action = self.first_action or tuple(action.tolist())
        self._add(Component.POLICY, step, action)

    def ended(self, step: int, status: str) -> None:
        """Add how the simulator ended the rollout."""
        self._add(Component.SIMULATOR, step, _bytes(status))

    @contextmanager
    def errors_of(self, component: Component, step: int = 0) -> Iterator[None]:
        """Add an exception of the block, which is a value of a component like others."""
        try:
            yield
        except Exception as error:
            if isinstance(error, InterferenceError):
                self.error = error.message
            else:
                self.error = first_line(error)
            self._add(component, step, _bytes(self.error))
            raise

    def _add(self, component: Component, step: int, *arrays: NDArray[Any]) -> None:
        if not self.collects:
            return
        digest = hashlib.sha256()
        for array in arrays:
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array))
        self.events.append(Event(component, step, digest.digest()[:16]))


@dataclass(frozen=True)
class Play:
    """A rollout that the probe played.

    Attributes:
        planned: What was played.
        past: Labels of what the same client played since it was new.
        after: Label of what the probe played just before; None at its beginning.
        events: The values.
        first_action: The first action.
        status: How it ended; None if it was cut short or broke.
        error: Why it broke, although nothing breaks it with a new policy; None if it did not.
    """

    planned: PlannedPlay
    past: tuple[str, ...]
    after: str | None
    events: tuple[Event, ...]
    first_action: tuple[float, ...] = ()
    status: str | None = None
    error: str | None = None

    @property
    def circumstances(self) -> str:
        """What came before it, and what happened beside it, in words."""
        before = f"after {self.past[-1]}" if self.past else "with a new policy"
        beside = self.planned.beside
        return before + (f", while another client plays {beside.key}" if beside else "")


def digest_of(plays: Sequence[Play]) -> str:
    """Return a digest of all values of plays."""
    events = (event for play in plays for event in play.events)
    return hashlib.sha256(b"".join(event.digest for event in events)).hexdigest()


def _bytes(text: str) -> NDArray[np.uint8]:
    # An error may quote a file name, which may hold what is no UTF-8.
    return np.frombuffer(text.encode(errors="backslashreplace"), np.uint8)
