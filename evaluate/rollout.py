"""One rollout: reset, feed the history that the condition prescribes, then the live loop."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.buffer import Buffer, Chunk
from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.draw import even_sample
from robomme_interference_data.errors import PolicyError, RolloutError
from robomme_interference_data.evaluate.agreement import check_episode, check_lesson
from robomme_interference_data.evaluate.ahead import read_ahead
from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.policies.base import Policy, RolloutInfo
from robomme_interference_data.evaluate.rows import PROTOCOL_VERSION, Rollout
from robomme_interference_data.evaluate.systems import check_history, name_system
from robomme_interference_data.evaluate.watchdog import Watchdog
from robomme_interference_data.loader import Split
from robomme_interference_data.retrieval.selector import Selection, Selector
from robomme_interference_data.simulators.base import (
    EpisodeInfo,
    Observation,
    Simulator,
    Status,
)

__all__ = ["ACTION_CHUNK", "Watcher", "base_row", "run_rollout"]

ACTION_CHUNK = 16
"""Actions of a chunk that are executed before the policy is asked again (paper)."""

_FRAMES_AHEAD = 256
"""Frames of the history that are decoded ahead at most: 50 MB of a camera of 256 × 256."""


class Watcher(Protocol):
    """Sees a rollout as it goes, for a video. It wants the front camera at every step."""

    def begin(
        self, buffer: Buffer | None, start: int, stop: int, first: Observation, info: EpisodeInfo
    ) -> None:
        """Take what is known before the first step.

        Args:
            buffer: The buffer that the condition prescribes, or None.
            start: First of its frames that the policy is given.
            stop: Frame after the last one.
            first: The first live observation.
            info: The episode.
        """
        ...

    def step(self, observation: Observation, status: Status, subgoal: str | None) -> None:
        """Take what came of a step."""
        ...


@dataclass
class _Clock:
    """Seconds by part of a rollout."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began


def base_row(config: RunConfig, item: WorkItem) -> dict[str, Any]:
    """Return the columns that are known before a rollout begins: its key."""
    return {
        "system": config.system,
        "simulator": config.simulator,
        "split": config.split_name,
        "revision": config.revision,
        "family": item.episode.family,
        "condition": item.condition,
        "episode_split": item.episode.split,
        "episode": item.episode.index,
        "model_seed": config.model_seed,
        "protocol_version": PROTOCOL_VERSION,
    }


def run_rollout(
    config: RunConfig,
    item: WorkItem,
    *,
    simulator: Simulator,
    policy: Policy,
    split: Split,
    selector: Selector | None = None,
    watcher: Watcher | None = None,
    watchdog: Watchdog | None = None,
) -> Rollout:
    """Run one rollout and return its row.

    The policy never gets what the simulator returns of the demonstration: its history comes from
    the dataset, and under `no-history` there is none (protocol, rules 2 and 6).

    Raises:
        RolloutError: Simulator and dataset speak of different episodes.
        HistoryTooLongError: What retrieval chose exceeds the system's position limit.
        PolicyError: The policy broke, or returned no actions.
        SimulatorCrashError: The simulator broke.
    """
    clock = _Clock()
    guard = nullcontext if watchdog is None else watchdog.guard
    began = time.perf_counter()
    buffer = None if item.k is None else split.load(item.episode, item.k)
    chosen = None
    start, stop = 0, 0 if buffer is None else len(buffer)
    with ExitStack() as stack:
        history = None
        # One that computes in this process holds Python's lock: decoding beside it slows both down.
        if selector is None and getattr(simulator, "remote", False):
            history = stack.enter_context(_history(buffer, start, stop, policy, config))
        with clock.part("reset_s"), guard():
            demonstration, first, info = simulator.reset(
                str(item.episode), demonstration=config.check_lesson
            )
        recorded = split.load(item.episode, split.k_values[0]) if buffer is None else buffer
        check_episode(recorded, demonstration, first, info)
        if config.check_lesson:
            check_lesson(recorded, demonstration, first)
        with clock.part("history_s"):
            if selector is not None and buffer is not None and len(buffer):
                chosen = selector.select(buffer, first.images[selector.camera])
                start, stop = chosen.start, chosen.stop
                check_history(name_system(config.system), stop - start)
        if watcher is not None:
            watcher.begin(buffer, start, stop, first, info)
        with clock.part("history_s"):
            if history is None:
                history = stack.enter_context(_history(buffer, start, stop, policy, config))
            policy.reset(
                RolloutInfo(
                    info.goal,
                    stop - start,
                    config.model_seed,
                    simulator if policy.privileged else None,
                )
            )
            for chunk in history:
                policy.add_history(chunk.frames, chunk.states, stop - start)
    status, steps = _live(policy, simulator, first, info.goal, clock, watcher, guard)
    if status is Status.ERROR:
        raise RolloutError(f"the {config.simulator} simulator reported an error at step {steps}")
    lesson = 0 if buffer is None else _lesson_frames(buffer, start, stop)
    times: dict[str, Any] = {name: round(value, 4) for name, value in clock.seconds.items()}
    return Rollout(
        **base_row(config, item),
        seed=info.seed,
        difficulty=info.difficulty,
        goal=info.goal,
        status=str(status),
        success=status is Status.SUCCESS,
        steps=steps,
        history_frames=stop - start,
        lesson_frames=lesson,
        lesson_share=None if buffer is None else _share(buffer, start, stop),
        **_retrieval_columns(selector, chosen),
        **times,
        wall_s=round(time.perf_counter() - began, 4),
    )


def _history(
    buffer: Buffer | None, start: int, stop: int, policy: Policy, config: RunConfig
) -> AbstractContextManager[Iterator[Chunk]]:
    """Begin to decode what a policy is given of a buffer; give it in chunks, in order."""
    if buffer is None:
        return nullcontext(iter(()))
    chunks = buffer.stream(config.history_chunk, policy.history_cameras, start, stop)
    return read_ahead(chunks, max(1, _FRAMES_AHEAD // config.history_chunk))


def _live(
    policy: Policy,
    simulator: Simulator,
    first: Observation,
    goal: str,
    clock: _Clock,
    watcher: Watcher | None,
    guard: Callable[[], AbstractContextManager[None]],
) -> tuple[Status, int]:
    """Run the live loop; return how it ended and the number of executed steps."""
    seen, steps = [first], 0
    while True:
        with clock.part("policy_s"):
            frames = {name: np.stack([one.images[name] for one in seen]) for name in policy.cameras}
            policy.observe(frames, np.stack([one.state for one in seen]))
            actions = _checked(policy.act(seen[-1], goal))[: MAX_STEPS - steps]
        seen = []
        with guard():
            for number, action in enumerate(actions, 1):
                decides = number == len(actions)
                wanted = policy.every_frame or decides
                with clock.part("simulator_s"):
                    observed, status = simulator.step(action, observe=wanted or watcher is not None)
                steps += 1
                if watcher is not None:
                    watcher.step(observed, status, getattr(policy, "subgoal", None))
                if status is not Status.ONGOING:
                    return status, steps
                if wanted:
                    seen.append(observed)
        if steps >= MAX_STEPS:
            return Status.TIMEOUT, steps


def _checked(actions: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the actions of a chunk that are executed."""
    found = np.asarray(actions)
    if found.ndim != 2 or found.shape[1] != 8 or not len(found):
        raise PolicyError(
            f"the policy returned actions of shape {found.shape}; expected (n, 8) with n ≥ 1",
            "An action is 7 absolute joint targets in rad, then the gripper, −1 closed to 1 open.",
        )
    executed = found[:ACTION_CHUNK].astype(np.float32)
    if not np.isfinite(executed).all():
        raise PolicyError("the policy returned actions that are not finite numbers")
    return executed


def _lesson_frames(buffer: Buffer, start: int, stop: int) -> int:
    return sum(
        max(0, min(stop, s.stop) - max(start, s.start))
        for s in buffer.sessions
        if s.role == "lesson"
    )


def _share(buffer: Buffer, start: int, stop: int) -> float:
    """Return the share of lesson frames in an even sample of a span and the live observation."""
    sample = even_sample(stop - start)
    lesson = [s for s in buffer.sessions if s.role == "lesson"]
    inside = _count(lesson, (start + index for index in sample[:-1]))
    return inside / len(sample)


def _count(sessions: Sequence[Any], indices: Any) -> int:
    return sum(any(s.start <= index < s.stop for s in sessions) for index in indices)


def _retrieval_columns(selector: Selector | None, chosen: Selection | None) -> dict[str, Any]:
    if selector is None:
        return {}
    if chosen is None:
        return {"retrieval_model": selector.name}
    return {
        "retrieval_model": selector.name,
        "retrieval_start": chosen.start,
        "retrieval_stop": chosen.stop,
        "retrieval_selected_lesson_fraction": chosen.lesson_fraction,
        "retrieval_selected_filler_fraction": chosen.filler_fraction,
        "retrieval_selected_query_fraction": chosen.query_fraction,
    }
