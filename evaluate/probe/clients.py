"""Two clients of one policy that act in turns, for the leak probe.

Workers that share a policy or a server do so at the same time. The probe makes it repeatable: the
calls of a rollout are recorded, and another client repeats them between the calls of this one.
"""

from itertools import cycle
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.evaluate.policies.policy import Frames, Policy, RolloutInfo
from robomme_interference_data.simulators.episode import Observation

Calls = list[tuple[str, tuple[Any, ...]]]
"""Methods of a policy and their arguments, in order."""


class Wrapper(Policy):
    """A policy that passes all calls to another one, whose attributes it has."""

    def __init__(self, policy: Policy):
        self.policy = policy
        for name in Policy.__annotations__:
            setattr(self, name, getattr(policy, name))

    def reset(self, info: RolloutInfo) -> None:
        """Call `reset`."""
        self.call("reset", info)

    def add_history(self, frames: Frames, states: NDArray[np.float32], exec_start_idx: int) -> None:
        """Call `add_history`."""
        self.call("add_history", frames, states, exec_start_idx)

    def observe(self, frames: Frames, states: NDArray[np.float32]) -> None:
        """Call `observe`."""
        self.call("observe", frames, states)

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        """Call `act`."""
        actions: NDArray[np.float32] = self.call("act", observation, goal)
        return actions

    def metadata(self) -> dict[str, Any]:
        """Return the policy's metadata."""
        return self.policy.metadata()

    def call(self, method: str, *arguments: Any) -> Any:
        """Call a method of the policy."""
        return getattr(self.policy, method)(*arguments)


class Recorder(Wrapper):
    """Records all calls; `calls` is emptied at a reset."""

    def __init__(self, policy: Policy, calls: Calls):
        super().__init__(policy)
        self.calls = calls

    def call(self, method: str, *arguments: Any) -> Any:
        """Record a call, and make it."""
        if method == "reset":
            self.calls.clear()
        self.calls.append((method, arguments))
        return super().call(method, *arguments)


class Interleaved(Wrapper):
    """Before each call, `other` makes the next one of `calls`, which it repeats from the start."""

    def __init__(self, policy: Policy, other: Policy, calls: Calls):
        super().__init__(policy)
        self.other, self.calls = other, cycle(calls)

    def call(self, method: str, *arguments: Any) -> Any:
        """Make the other client's call, then this one."""
        name, given = next(self.calls)
        getattr(self.other, name)(*given)
        return super().call(method, *arguments)
