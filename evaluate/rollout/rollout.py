"""One rollout: reset, feed the history that the condition prescribes, then the live loop."""

import time
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION_CHUNK, MAX_STEPS
from robomme_interference_data.data.buffer import Buffer, Chunk
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import InvalidOptionError, PolicyError, RunError
from robomme_interference_data.evaluate.policies.policy import Policy, RolloutInfo
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.kind import Run, stored_count
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.subgoals.writer import History, SubgoalWriter
from robomme_interference_data.evaluate.systems import check_history, name_system
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.evidence import among
from robomme_interference_data.schema.rollouts import Rollout, Status
from robomme_interference_data.schema.sampling import (
    MEMORIES,
    even_sample,
    evidence_kept,
    lesson_frames,
    lesson_share,
)
from robomme_interference_data.schema.shifts import NO_SHIFT
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import (
    ACTION_SIZE,
    Observation,
    Simulator,
    action_array,
)

from .clips import Clip
from .recording_check import check_episode, check_lesson

if TYPE_CHECKING:
    from robomme_interference_data.retrieval.selector import Selector

_FRAMES_AHEAD = 256
"""Frames of the history that are decoded ahead at most: 50 MB of a camera of 256 × 256."""


class _Clock(dict[str, float]):
    """Seconds by part of a rollout."""

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        began = time.perf_counter()
        try:
            yield
        finally:
            self[name] = self.get(name, 0.0) + time.perf_counter() - began


def run_rollout(
    run: Run[RunConfig],
    item: WorkItem,
    *,
    simulator: Simulator,
    policy: Policy,
    buffer_set: BufferSet,
    selector: "Selector | None" = None,
    writer: SubgoalWriter | None = None,
    clip: Clip | None = None,
    worker: Worker | None = None,
) -> Rollout:
    """Run one rollout and return its row.

    The policy never gets what the simulator returns of the demonstration: its history comes from
    the dataset, and is what the condition says (protocol, rules 2 and 6).
    """
    config, clock, began = run.config, _Clock(), time.perf_counter()
    worker = worker or Worker(0)  # no time limit
    cameras = policy.history_cameras if selector is None else ()  # until it is known which part
    buffer = buffer_set.load(item.episode, item.condition, cameras=cameras)
    given: Sequence[int] = range(len(buffer))
    with ExitStack() as stack:
        history = None
        # One that computes in this process holds Python's lock: decoding beside it slows both down.
        if selector is None and getattr(simulator, "remote", False):
            history = stack.enter_context(_decode(buffer, given, policy, run))
        with clock.part("reset_s"), worker.limit(config.simulator_timeout, "the simulator's reset"):
            demonstration, first, info = simulator.reset(
                str(item.episode), demonstration=config.check_lesson
            )
        check_episode(buffer.query, demonstration, first, info)
        if config.check_lesson:
            # Under a shift the first live view is to differ from the recorded one.
            check_lesson(buffer.query, demonstration, first, views=config.shift == NO_SHIFT)
        with clock.part("history_s"):
            if selector is not None and len(buffer):
                given = selector.select(buffer, first.images[selector.camera]).tolist()
                check_history(name_system(run.system), {item.condition: len(given)})
        if clip is not None:
            clip.begin(buffer, given, first, info)
        with clock.part("history_s"):
            if history is None:
                history = stack.enter_context(_decode(buffer, given, policy, run))
            own: tuple[Any, ...] = ()
            if policy.privileged:
                own = simulator, buffer.evidence and among(buffer.evidence, given)
            told = RolloutInfo(info.goal, len(given), config.model_seed, *own)
            policy.reset(told)
            for chunk in history:
                policy.add_history(chunk.frames, chunk.states, len(given))
        if writer is not None:
            with clock.part("model_s"):
                writer.start(History(buffer, given), told, simulator)
    live = _Live(run.config, policy, simulator, writer, clock, clip, worker)
    status, steps = live.run(first, info.goal)
    if status is Status.ERROR:
        raise RunError(f"the {config.simulator} simulator reported an error at step {steps}")
    times: dict[str, Any] = {name: round(value, 4) for name, value in clock.items()}
    return run.row(
        item,
        seed=info.seed,
        difficulty=info.difficulty,
        goal=info.goal,
        status=str(status),
        success=status is Status.SUCCESS,
        steps=steps,
        history_frames=len(given),
        lesson_frames=lesson_frames(buffer.sessions, given),
        lesson_share=lesson_share(buffer.sessions, given) if given else None,
        evidence_kept=_evidence_kept(run.system, buffer, given),
        **retrieval_columns(selector, buffer, given),
        **_model_columns(writer),
        **times,
        wall_s=round(time.perf_counter() - began, 4),
    )


@dataclass(frozen=True)
class _Live:
    """The live loop of one rollout."""

    config: RunConfig
    policy: Policy
    simulator: Simulator
    writer: SubgoalWriter | None
    clock: _Clock
    clip: Clip | None
    worker: Worker

    def run(self, first: Observation, goal: str) -> tuple[Status, int]:
        """Return how the rollout ended, and the number of executed steps."""
        seen, steps = [first], 0
        told: int | None = None  # steps before the subgoal that stands
        subgoal: Subgoal | None = None
        watches = self.writer is not None and self.writer.every_frame
        every_frame = self.policy.every_frame or watches
        actions: NDArray[np.float32] = np.empty((0, ACTION_SIZE), np.float32)
        while True:
            # A policy that gives single actions is told as often as one that gives whole chunks.
            due = told is None or len(actions) > 1 or steps - told >= ACTION_CHUNK
            if self.writer is not None:
                with self.clock.part("model_s"):
                    self.writer.watch(seen)
                    if due:
                        subgoal, told = self.writer.next(seen[-1], steps), steps
                seen[-1] = replace(seen[-1], subgoal=subgoal)
            actions = self._decide(seen, goal)[: MAX_STEPS - steps]
            seen = []
            with self.worker.limit(self.config.simulator_timeout, "the simulator's steps"):
                for number, action in enumerate(actions, 1):
                    wanted = every_frame or number == len(actions)
                    drawn = wanted or self.clip is not None
                    with self.clock.part("simulator_s"):
                        observed, status = self.simulator.step(action, observe=drawn)
                    steps += 1
                    if self.clip is not None:
                        self.clip.step(observed, status, subgoal)
                    if status is not Status.ONGOING:
                        return status, steps
                    if steps >= MAX_STEPS:
                        return Status.TIMEOUT, steps
                    if wanted:
                        seen.append(observed)

    def _decide(self, seen: Sequence[Observation], goal: str) -> NDArray[np.float32]:
        """Hand over what was seen, and return the next actions."""
        policy = self.policy
        watched = seen if policy.every_frame else seen[-1:]
        with self.clock.part("policy_s"):
            frames = {
                name: np.stack([one.images[name] for one in watched]) for name in policy.cameras
            }
            policy.observe(frames, np.stack([one.state for one in watched]))
            return _checked(policy.act(seen[-1], goal))


def _checked(actions: Any) -> NDArray[np.float32]:
    """Return the actions of a chunk that are executed, `(n, 8) float32`, n from 1 to 16."""
    try:
        return action_array(actions, chunk=True)[:ACTION_CHUNK]
    except InvalidOptionError as error:
        raise PolicyError(f"the policy's answer: {error.message}", error.hint) from None


def retrieval_columns(
    selector: "Selector | None", buffer: Buffer, given: Sequence[int]
) -> dict[str, Any]:
    """Return what a row says of the retrieval step: which, and what it chose of a buffer."""
    columns: dict[str, Any] = {"retrieval_model": selector.name} if selector else {}
    if selector is not None and len(buffer):
        columns |= {"retrieval_start": given[0], "retrieval_stop": given[-1] + 1}
        frames, share = len(even_sample(len(given))), lesson_share(buffer.sessions, given)
        filler = (frames - 1 - round(share * frames)) / frames
        for part, fraction in {"lesson": share, "filler": filler, "query": 1 / frames}.items():
            columns[f"retrieval_selected_{part}_fraction"] = fraction
    return columns


def _model_columns(writer: SubgoalWriter | None) -> dict[str, Any]:
    if writer is None:
        return {}
    counts = [turn.tokens for turn in writer.turns if turn.tokens is not None]
    tokens = stored_count(sum(counts)) if counts else None
    wrong = sum(turn.fault is not None for turn in writer.turns)
    return {
        "model_calls": sum(turn.calls for turn in writer.turns),
        "model_tokens": tokens,
        "model_faults": wrong + (bool(counts) and tokens is None),
    }


def _evidence_kept(system: str, buffer: Buffer, given: Sequence[int]) -> float | None:
    """Return the share of the evidence that the memory of a system holds at the first step."""
    memory = name_system(system).sampling
    if memory is None or buffer.evidence is None:
        return None
    kept = [given[place] for place in MEMORIES[memory](len(given))]
    return evidence_kept(buffer.evidence, kept)


def _decode(
    buffer: Buffer, given: Sequence[int], policy: Policy, run: Run[RunConfig]
) -> AbstractContextManager[Iterator[Chunk]]:
    """Begin to decode what a policy is given of a buffer; give it in chunks, in order."""
    size, cameras = run.config.history_chunk, tuple(policy.history_cameras)
    return read_ahead(buffer.stream(size, cameras, given), max(1, _FRAMES_AHEAD // size))


@contextmanager
def read_ahead[T](items: Generator[T], depth: int) -> Iterator[Iterator[T]]:
    """Make the first items of a stream at once, and the next ones while the others are used.

    What it gives yields the items in order; an error in making one is raised where that item
    would have come. The stream is closed at the end, read to its end or not.
    No item is None; at most `depth` items, 1 or more, wait in memory.
    """
    pool = ThreadPoolExecutor(1, "read-ahead")  # one thread: a stream is made in its order
    made = deque(pool.submit(next, items, None) for _ in range(depth))

    def given() -> Iterator[T]:
        while (item := made.popleft().result()) is not None:
            made.append(pool.submit(next, items, None))
            yield item

    try:
        yield given()
    finally:
        pool.shutdown(cancel_futures=True)
        items.close()
