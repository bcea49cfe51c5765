"""What the leak probe plays: which rollouts, and in which order."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from robomme_interference_data.evaluate.run.config import RunConfig
from robomme_interference_data.evaluate.run.plan import WorkItem, shuffle_work
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.schema.conditions import parse_condition

SHORT_STEPS = 72
"""Steps of a short play: four and a half chunks, so that a queue of actions is left over."""

ENOUGH_ROLLOUTS = 120
"""Rollouts from which on a run is probed with a whole rollout, too: 6 plays are 5% of them."""

_SHARE, _FEWEST, _MOST = 0.05, 4, 16
"""Of a noisy system: the share of a run's rollouts in `rounds`, and bounds of its rollouts."""


@dataclass(frozen=True)
class PlannedPlay:
    """A rollout that the probe plays.

    Attributes:
        item: The rollout.
        whole: Whether it is played to its end, and not for `SHORT_STEPS` steps only.
        beside: The rollout whose calls another client of the same policy makes in between.
    """

    item: WorkItem
    whole: bool = False
    beside: WorkItem | None = None

    @property
    def label(self) -> str:
        """The rollout, and how it is played."""
        beside = f", beside {self.beside.key}" if self.beside else ""
        return self.item.key + ("" if self.whole else f" ({SHORT_STEPS} steps{beside})")


def sequence(
    items: Sequence[WorkItem], moves: Callable[[WorkItem], bool], *, clients: int
) -> tuple[PlannedPlay, ...]:
    """Return what the probe plays, in this order, with one policy; each time with the same past.

    The first rollout comes with a new policy, and after another rollout, which has the longest
    history and so leaves most behind; a history of a robot that stands still may leave nothing that
    shows. Runs of `ENOUGH_ROLLOUTS` or more play that one to its end,
    too: some states are left only then. With several clients of one policy, another client acts
    between the calls of the last play.

    Args:
        items: The planned rollouts, at least one.
        moves: Whether the robot moves in the lesson of a rollout.
        clients: Number of workers that one policy or server serves.
    """
    ordered = shuffle_work(items)
    most = max(map(_history_rank, ordered))
    longest = [item for item in ordered if _history_rank(item) == most]
    second = next(filter(moves, longest), longest[0])
    others = [item for item in ordered if item.episode.family != second.episode.family]
    others = others or [item for item in ordered if item.episode != second.episode] or [*ordered]
    first = min(others, key=_history_rank)
    planned = [PlannedPlay(first), PlannedPlay(second), PlannedPlay(first)]
    if len(items) >= ENOUGH_ROLLOUTS:
        planned += [PlannedPlay(second, whole=True), PlannedPlay(first)]
    if clients > 1:
        planned.append(PlannedPlay(second, beside=first))
    return tuple(planned)


def rounds(items: Sequence[WorkItem]) -> tuple[PlannedPlay, ...]:
    """Return what is played of a noisy system, to the end: rollouts in order, twice, and backward.

    Backward twice, too: so most are played twice after the same rollout, and twice after another.
    """
    ordered = sorted(items, key=lambda item: hashlib.sha256(item.key.encode()).digest())
    count = min(max(_FEWEST, int(len(items) * _SHARE) // 4), _MOST)
    forward = [PlannedPlay(item, whole=True) for item in ordered[:count]]
    backward = forward[::-1]
    return (*forward, *forward, *backward, *backward)


def _history_rank(item: WorkItem) -> tuple[object, ...]:
    return tuple(parse_condition(item.condition).sort_key)


@dataclass(frozen=True)
class ProbeTask:
    """Rollouts that a worker plays for the leak probe, one after the other; it returns `Play`s.

    Attributes:
        run: Their run.
        planned: What to play.
        fresh: Whether to begin with a policy, simulator and subgoal writer that played nothing.
    """

    run: RunContext[RunConfig]
    planned: tuple[PlannedPlay, ...]
    fresh: bool
