"""One rollout: reset the episode, hand over the history of the condition, run the live loop."""

import hashlib
import time
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ACTION_CHUNK
from robomme_interference_data.data.buffer import Buffer, Chunk
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import InvalidOptionError, PolicyError, RunError
from robomme_interference_data.evaluate.policies.policy import Policy, RolloutInfo
from robomme_interference_data.evaluate.probe.trace import Component, Trace
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.history import HistoryReader, history_columns
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.row import Rollout, model_columns
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.evaluate.systems import check_history, name_system
from robomme_interference_data.runtime.executor import Worker
from robomme_interference_data.schema.evidence import evidence_among
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.sampling import Memory
from robomme_interference_data.schema.shifts import NO_SHIFT
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.base import Simulator
from robomme_interference_data.simulators.episode import ACTION_SIZE, Observation, action_array

from .agreement import check_episode, check_lesson

if TYPE_CHECKING:
    from robomme_interference_data.evaluate.language.subgoal_writers import SubgoalWriter
    from robomme_interference_data.retrieval.selector import Selector

    from .clips import Clip

_FRAMES_AHEAD = 256
"""Maximum history frames that are decoded ahead: 50 MB of a camera of 256 × 256."""


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
    run: RunContext[RunConfig],
    item: WorkItem,
    *,
    simulator: Simulator,
    policy: Policy,
    buffer_set: BufferSet,
    selector: "Selector | None" = None,
    writer: "SubgoalWriter | None" = None,
    history: HistoryReader | None = None,
    clip: "Clip | None" = None,
    worker: Worker | None = None,
    answer: int | None = None,
    predecessor: str | None = None,
    trace: Trace | None = None,
) -> Rollout:
    """Run one rollout and return its row.

    `answer` is what the policy `answers` carries out, `predecessor` the column of the row; `trace`
    collects values, and may end the rollout early.

    The policy never sees the simulator's own playback: its history comes from the dataset.
    """
    config, clock, began = run.config, _Clock(), time.perf_counter()
    worker = worker or Worker(0)  # no time limit
    reader = history or HistoryReader(buffer_set.datasets)
    # `load` fetches the videos of these cameras. What retrieval selects is unknown before the
    # first live observation, so its frames are fetched when they are decoded.
    cameras = policy.history_cameras if selector is None else ()
    buffer = buffer_set.load(item.episode, item.condition, cameras=cameras)
    received: Sequence[int] = range(len(buffer))
    trace = trace or Trace(collects=False)
    limit = worker.limit(config.simulator_timeout_s, "the simulator's reset")
    with trace.errors_of(Component.SIMULATOR):
        with clock.part("reset_s"), limit:
            demonstration, first, info = simulator.reset(
                str(item.episode), demonstration=config.check_lesson
            )
        check_episode(buffer.query, demonstration, first, info)
        if config.check_lesson:
            # Under a shift the first live observation differs from the recorded one.
            check_lesson(buffer.query, demonstration, first, views=config.shift == NO_SHIFT)
    trace.observed(0, first)
    if selector is not None and len(buffer):
        with clock.part("history_s"):
            camera = buffer.query.dataset.camera(selector.camera)
            received = selector.select(buffer, first.images[camera]).tolist()
        check_history(name_system(run.system), {item.condition: len(received)})
    trace.received(received)
    if clip is not None:
        clip.begin(buffer_set, buffer, received, first, info)
    rollout_info = RolloutInfo(info.goal, len(received), config.model_seed)
    if policy.privileged:
        evidence = buffer.evidence and evidence_among(buffer.evidence, received)
        rollout_info = replace(
            rollout_info,
            simulator=simulator,
            evidence=evidence,
            first_counts=buffer.query.first_counts,
            answer=answer,
        )
    with (
        clock.part("history_s"),
        _decode(reader, buffer, received, policy, config) as chunks,
        trace.errors_of(Component.POLICY),
    ):
        policy.reset(rollout_info)
        for chunk in chunks:
            policy.add_history(chunk.frames, chunk.states, len(received))
    if writer is not None:
        from robomme_interference_data.evaluate.language.images import HistoryFrames

        with clock.part("model_s"):
            frames = HistoryFrames(buffer, received, reader)
            writer.start(frames, rollout_info, simulator)
    live = _Live(run.config, policy, simulator, writer, clock, clip, worker, trace)
    try:
        status = live.run(first, info.goal)
        if status is Status.ERROR:
            raise RunError(
                f"the {config.simulator} simulator reported an error at step {live.steps}"
            )
    except Exception as error:
        # The executor hands this on with the error: columns of the error's row.
        vars(error)["progress"] = {
            "steps": live.steps,
            "actions_sha256": live.sent.hexdigest(),
            "predecessor": predecessor,
            **_model_columns(writer),
        }
        raise
    memory = None if run.facts.memory is None else Memory.parse(run.facts.memory)
    times: dict[str, Any] = {name: round(value, 4) for name, value in clock.items()}
    return run.row(
        item,
        status,
        seed=info.seed,
        difficulty=info.difficulty,
        ability=buffer.query.record.ability,
        goal=info.goal,
        steps=live.steps,
        actions_sha256=live.sent.hexdigest(),
        predecessor=predecessor,
        **history_columns(buffer, received, memory, retrieved=selector is not None),
        **_model_columns(writer),
        # A simulator of the user need not be a subclass.
        **(simulator.columns() if isinstance(simulator, Simulator) else {}),
        **times,
        wall_s=round(time.perf_counter() - began, 4),
    )


@dataclass
class _Live:
    """The live loop of one rollout; `steps` counts the executed actions, `sent` digests them."""

    config: RunConfig
    policy: Policy
    simulator: Simulator
    writer: "SubgoalWriter | None"
    clock: _Clock
    clip: "Clip | None"
    worker: Worker
    trace: Trace
    steps: int = 0
    sent: Any = field(default_factory=hashlib.sha256)

    def run(self, first: Observation, goal: str) -> Status:
        """Return the final status; a timeout after the most steps of the trace."""
        seen, most_steps = [first], self.trace.most_steps
        written: int | None = None  # steps before the current subgoal was written
        subgoal: Subgoal | None = None
        watches = self.writer is not None and self.writer.every_frame
        every_frame = self.policy.every_frame or watches
        actions: NDArray[np.float32] = np.empty((0, ACTION_SIZE), np.float32)
        while True:
            # A policy of single actions gets subgoals as often as one of whole chunks.
            needs_subgoal = (
                written is None or len(actions) > 1 or self.steps - written >= ACTION_CHUNK
            )
            if self.writer is not None:
                with self.clock.part("model_s"):
                    self.writer.watch(seen)
                    if needs_subgoal:
                        subgoal, written = self.writer.next(seen[-1], self.steps), self.steps
                        self.trace.told(self.steps, subgoal)
                seen[-1] = replace(seen[-1], subgoal=subgoal)
            with self.trace.errors_of(Component.POLICY, self.steps):
                actions = self._decide(seen, goal)[: most_steps - self.steps]
            seen = []
            with self.worker.limit(self.config.simulator_timeout_s, "the simulator's steps"):
                for number, action in enumerate(actions, 1):
                    needed = every_frame or number == len(actions)
                    drawn = needed or self.clip is not None
                    self.sent.update(action.astype("<f4").tobytes())
                    self.trace.acted(self.steps, action)
                    with (
                        self.clock.part("simulator_s"),
                        self.trace.errors_of(Component.SIMULATOR, self.steps),
                    ):
                        observed, status = self.simulator.step(action, observe=drawn)
                    self.steps += 1
                    if self.clip is not None:
                        self.clip.step(observed, status, subgoal)
                    if status is not Status.ONGOING:
                        self.trace.ended(self.steps, status)
                        return status
                    if self.steps >= most_steps:
                        return Status.TIMEOUT
                    if needed:
                        self.trace.observed(self.steps, observed)
                        seen.append(observed)

    def _decide(self, seen: Sequence[Observation], goal: str) -> NDArray[np.float32]:
        """Hand over the new observations, and return the next actions."""
        policy = self.policy
        watched = seen if policy.every_frame else seen[-1:]
        with self.clock.part("policy_s"):
            frames = {
                name: np.stack([observation.images[name] for observation in watched])
                for name in policy.cameras
            }
            policy.observe(frames, np.stack([observation.state for observation in watched]))
            size = getattr(self.simulator, "action_size", ACTION_SIZE)
            return _checked(policy.act(seen[-1], goal), size, len(seen[-1].state))


def _checked(actions: Any, size: int, state_size: int) -> NDArray[np.float32]:
    """Return the actions of a chunk that are executed, `(n, size) float32`, n from 1 to 16."""
    try:
        checked = action_array(actions, chunk=True, size=size, state_size=state_size)
    except InvalidOptionError as error:
        raise PolicyError(f"the policy's answer: {error.message}", error.hint) from None
    return checked[:ACTION_CHUNK]


def _model_columns(writer: "SubgoalWriter | None") -> dict[str, Any]:
    if writer is None:
        return {}
    turns = writer.turns
    return model_columns(
        sum(turn.calls for turn in turns),
        [turn.tokens for turn in turns],
        sum(turn.fault is not None for turn in turns),
    )


def _decode(
    reader: HistoryReader,
    buffer: Buffer,
    received: Sequence[int],
    policy: Policy,
    config: RunConfig,
) -> AbstractContextManager[Iterator[Chunk]]:
    """Start to decode the history frames of a policy; give them in chunks, in order."""
    size, cameras = config.history_chunk, tuple(policy.history_cameras)
    stream = reader.stream(buffer, size, cameras, received, policy.other_states)
    return read_ahead(stream, max(1, _FRAMES_AHEAD // size))


@contextmanager
def read_ahead[T](items: Generator[T], depth: int) -> Iterator[Iterator[T]]:
    """Read up to `depth` items of a stream ahead in a thread; yield the items in order.

    An exception in the stream is raised in place of its item. The stream is closed at the end of
    the block, even if it was not read to its end. No item may be None.
    """
    pool = ThreadPoolExecutor(1, "read-ahead")  # one thread: a stream is made in its order
    made = deque(pool.submit(next, items, None) for _ in range(depth))

    def in_order() -> Iterator[T]:
        while (item := made.popleft().result()) is not None:
            made.append(pool.submit(next, items, None))
            yield item

    try:
        yield in_order()
    finally:
        pool.shutdown(cancel_futures=True)
        items.close()
