"""The leak probe: before a run, find out whether a state survives a reset.

A policy that carries one rollout into the next changes results as interference does. The probe
plays a few rollouts, with the workers and policies of the run, again after other ones. It writes
nothing: a run begins only without a leak.

`plays.py` has what is played, `trace.py` what of it is compared, `judgment.py` and `noise.py` what
follows, and `result.py` what is recorded.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from robomme_interference_data.constants import STATE
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import (
    InterferenceError,
    LeakError,
    WorkerRetiredError,
    counted,
    first_line,
    named,
)
from robomme_interference_data.evaluate.policies.registry import server_addresses
from robomme_interference_data.evaluate.rollout.agreement import STATE_TOLERANCE
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.worker import WORTH_REPEATING, RunContext
from robomme_interference_data.runtime.executor import WorkerPool

from .judgment import FirstDifference, ProbeVerdict, judge
from .noise import LEAK_P, flips, noise_p
from .plays import PlannedPlay, ProbeTask, rounds, sequence
from .result import BROKEN, INDEPENDENT, NONDETERMINISTIC, Probe
from .trace import Component, Event, Play, digest_of

_REPEATS, _MORE_REPEATS = 3, 4
"""How often all plays are repeated, in the same order and with a new policy, once two differ; and
how often again, once they are known to be noisy: see `noise_p`."""

_PAGE = "docs/how-to/your-own-policy.md"


def probe_run(
    run: RunContext[RunConfig],
    buffer_set: BufferSet,
    items: Sequence[WorkItem],
    pool: WorkerPool,
    note: Callable[[str], None],
) -> Probe:
    """Play rollouts of a run again after other ones, and return what differs.

    Args:
        run: The run.
        buffer_set: Its buffer set.
        items: Its planned rollouts.
        pool: Its workers.
        note: Shows a line.

    Raises:
        LeakError: A policy, simulator or subgoal writer keeps a state.
        WorkerRetiredError: No worker is left, such as without its server.
    """
    clients = 2 if _shares_policy(run.config) else 1
    planned = sequence(items, lambda item: _moves(buffer_set, item), clients=clients)
    rollouts = tuple(dict.fromkeys(play.item.key for play in planned))
    found = Probe(INDEPENDENT, rollouts, len(planned), clients)
    note(f"probing for a state that survives a reset: {counted(len(planned), 'short rollout')}")
    try:
        first = _play(run, pool, planned)
        _, difference = judge(first)
        if difference is None:
            return found
        component = difference.event.component.value
        note(f"the {component} differs: {counted(_REPEATS * len(planned), 'more short rollout')}")
        repeats = _repeat(run, pool, planned, first[-1], _REPEATS)
        difference = _judged(chain(*repeats)) or difference  # the first plays alone may differ
        more = rounds(items)
        note(f"the {component} is not deterministic: {counted(len(more), 'whole rollout')}")
        repeats += _repeat(run, pool, planned, repeats[-1][-1], _MORE_REPEATS)
        plays = _play(run, pool, more, fresh=False)
        _judged(plays)
        _check_unbroken(chain(*repeats))
    except _BrokenError as error:
        return replace(found, verdict=BROKEN, error=str(error))
    p_value, (pairs, flipped) = noise_p(repeats, plays), flips(plays)
    event = difference.event
    if p_value < LEAK_P:
        raise _leak(
            event,
            "First actions or outcomes depend on the rollouts before, more than by noise (p = "
            f"{p_value:.2g}).",
        )
    return replace(
        found,
        verdict=NONDETERMINISTIC,
        plays=(1 + len(repeats)) * len(planned) + len(plays),
        component=event.component.value,
        step=event.step,
        pairs=pairs,
        flips=flipped,
        p_value=p_value,
        digest=digest_of(first),
    )


def _moves(buffer_set: BufferSet, item: WorkItem) -> bool:
    """Whether the robot moves in the lesson of a rollout."""
    query = buffer_set.query(item.episode)
    number = query.record.episode_index
    states = query.dataset.read_vectors(number, STATE, 0, query.lesson_frames)
    return bool(np.abs(states - states[:1]).max(initial=0.0) > STATE_TOLERANCE)


def _judged(plays: Iterable[Play]) -> FirstDifference | None:
    """Return the first difference of plays, None without one; raise if a state survives."""
    plays = [*plays]
    verdict, difference = judge(plays)
    if verdict is ProbeVerdict.LEAK and difference is not None:
        raise _leak(difference.event, _evidence(difference))
    _check_unbroken(plays)
    return difference


def _check_unbroken(plays: Iterable[Play]) -> None:
    """Raise if a play broke: unless a state broke it, the rollout may break at any time."""
    for play in plays:
        if play.error is not None:
            raise _BrokenError(play.error)


def _evidence(difference: FirstDifference) -> str:
    """Return what shows that a state survives."""
    event, plays = difference.event, (difference.first, difference.second)
    first, second = sorted(plays, key=lambda play: play.error is not None)
    if second.error is not None:
        return (
            f"{first.planned.item} breaks {second.circumstances}, and not {first.circumstances}; "
            f"repeated, it does so again: {second.error}"
        )
    return (
        f"{first.planned.item} has another {_VALUES[event.component]} at step {event.step} "
        f"{second.circumstances} than {first.circumstances}; repeated, both are the same."
    )


_VALUES = {
    Component.RETRIEVAL: "history",
    Component.SIMULATOR: "observation",
    Component.WRITER: "subgoal",
    Component.POLICY: "action",
}


def _leak(event: Event, evidence: str) -> LeakError:
    component = event.component.value
    return LeakError.of(
        component,
        event.step,
        f"the {component} keeps a state from one rollout to the next. {evidence}",
        f"Let its reset clear what is left: see {_PAGE}. {named('no_probe')} runs all the "
        "same, and is recorded.",
    )


def _repeat(
    run: RunContext[RunConfig],
    pool: WorkerPool,
    planned: tuple[PlannedPlay, ...],
    after: Play,
    times: int,
) -> list[list[Play]]:
    """Play a sequence several times, each time with a new policy; `after` was played before."""
    repeats = list[list[Play]]()
    for _ in range(times):
        plays = _play(run, pool, planned, after=after)
        repeats.append(plays)
        after = plays[-1]
    return repeats


def _shares_policy(config: RunConfig) -> bool:
    """Whether a policy or a server acts for several workers."""
    if config.policies is not None:
        return config.workers > config.policies
    return 0 < len(server_addresses(config.policy)) < config.workers


class _BrokenError(Exception):
    """A rollout of the probe broke, as others of the run will, or not."""


def _play(
    run: RunContext[RunConfig],
    pool: WorkerPool,
    planned: tuple[PlannedPlay, ...],
    *,
    after: Play | None = None,
    fresh: bool = True,
) -> list[Play]:
    """Let one worker play, beginning with a new policy or not; `after` is the last play before."""
    limit = run.config.rollout_timeout_s * len(planned)
    tasks = [ProbeTask(run, planned, fresh)]
    (outcome,) = pool.run(tasks, time_limit=limit, again=WORTH_REPEATING)
    if isinstance(outcome.error, WorkerRetiredError):
        raise outcome.error
    if outcome.error is not None:
        error = outcome.error
        text = error.message if isinstance(error, InterferenceError) else first_line(error)
        raise _BrokenError(text)
    first, *rest = outcome.value
    if after is not None:
        first = replace(first, after=after.planned.label)
    return [first, *rest]
