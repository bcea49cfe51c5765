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

from robomme_interference_data.errors import (
    InterferenceError,
    LeakError,
    ServerDiedError,
    ServerKeepaliveError,
    SimulatorCrashError,
    WorkerRetiredError,
    counted,
    first_line,
    named,
)
from robomme_interference_data.evaluate.policies.registry import server_addresses
from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.runtime.executor import WorkerPool

from .judgment import FirstDifference, ProbeVerdict, judge
from .noise import LEAK_P, flips, noise_p
from .plays import PlannedPlay, ProbeTask, rounds, sequence
from .result import BROKEN, INDEPENDENT, NONDETERMINISTIC, Probe
from .trace import Component, Event, Play

_REPEATS = 3
"""How often all plays are repeated, in the same order and with a new policy, once two differ."""

_PAGE = "docs/how-to/your-own-policy.md"


def probe_run(
    run: RunContext[RunConfig],
    items: Sequence[WorkItem],
    pool: WorkerPool,
    note: Callable[[str], None],
) -> Probe:
    """Play rollouts of a run again after other ones, and return what differs.

    Args:
        run: The run.
        items: Its planned rollouts.
        pool: Its workers.
        note: Shows a line.

    Raises:
        LeakError: A policy, simulator or subgoal writer keeps a state.
        WorkerRetiredError: No worker is left, such as without its server.
    """
    clients = 2 if _shares_policy(run.config) else 1
    planned = sequence(items, clients=clients)
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
        repeats = _repeat(run, pool, planned, first)
        difference = _judged(chain(*repeats)) or difference  # the first plays alone may differ
        more = rounds(items)
        note(f"the {component} is not deterministic: {counted(len(more), 'whole rollout')}")
        repeats += _repeat(run, pool, planned, repeats[-1])
        plays = _play(run, pool, more, fresh=False)
        _judged(plays)
    except _BrokenError as error:
        return replace(found, verdict=BROKEN, error=str(error))
    p_value, (pairs, flipped) = noise_p(repeats, plays), flips(plays)
    event = difference.event
    if p_value < LEAK_P:
        raise _leak(
            event,
            "First actions or outcomes depend on the rollout before, more than by noise (p = "
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
    )


def _judged(plays: Iterable[Play]) -> FirstDifference | None:
    """Return the first difference of plays, None without one; raise if a state survives."""
    verdict, difference = judge([*plays])
    if verdict is ProbeVerdict.LEAK and difference is not None:
        event, first, second = difference.event, difference.first, difference.second
        raise _leak(
            event,
            f"{first.planned.item} has another {_VALUES[event.component]} at step {event.step} "
            f"{second.circumstances} than {first.circumstances}; repeated, both are the same.",
        )
    return difference


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
    run: RunContext[RunConfig], pool: WorkerPool, planned: tuple[PlannedPlay, ...], last: list[Play]
) -> list[list[Play]]:
    """Play a sequence several times, each time with a new policy; `last` was played before."""
    repeats = [last]
    for _ in range(_REPEATS):
        repeats.append(_play(run, pool, planned, after=repeats[-1][-1]))
    return repeats[1:]


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
    again = (SimulatorCrashError, ServerKeepaliveError, ServerDiedError)
    (outcome,) = pool.run([ProbeTask(run, planned, fresh)], time_limit=limit, again=again)
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
