"""The rules of the leak probe: which rollouts it plays, and what their differences show.

A rollout is repeated after other rollouts. If its values differ, all plays are repeated in the same
order: a state that survives a reset gives the same differences again, noise does not.
"""

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.schema.conditions import parse_condition
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.episode import Observation
from robomme_interference_data.stats.significance import poisson_binomial

from .plan import WorkItem, shuffle_work

SHORT_STEPS = 72
"""Steps of a short play: four and a half chunks, so that a queue of actions is left over."""

ENOUGH_ROLLOUTS = 120
"""Rollouts from which on a run is probed with a whole rollout, too: 6 plays are 5% of them."""

LEAK_P = 0.01
"""Largest p-value at which plays that are noisy show a leak."""

_SHARE, _FEWEST, _MOST = 0.05, 4, 16
"""Of a noisy system: the share of a run's rollouts in `rounds`, and bounds of its rollouts."""


# --- what is played ----------------------------------------------------------------------------


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


def sequence(items: Sequence[WorkItem], *, clients: int) -> tuple[PlannedPlay, ...]:
    """Return what the probe plays, in this order, with one policy; each time with the same past.

    The first rollout comes with a new policy, and after another rollout, which has the longest
    history and so leaves most behind. Runs of `ENOUGH_ROLLOUTS` or more play that one to its end,
    too: some states are left only then. With several clients of one policy, another client acts
    between the calls of the last play.

    Args:
        items: The planned rollouts, at least one.
        clients: Number of workers that one policy or server serves.
    """
    ordered = shuffle_work(items)
    first = min(ordered, key=_history_rank)
    others = [item for item in ordered if item.episode.family != first.episode.family]
    others = others or [item for item in ordered if item.episode != first.episode] or [*ordered]
    second = max(others, key=_history_rank)
    turns = [PlannedPlay(first), PlannedPlay(second), PlannedPlay(first)]
    if len(items) >= ENOUGH_ROLLOUTS:
        turns += [PlannedPlay(second, whole=True), PlannedPlay(first)]
    if clients > 1:
        turns.append(PlannedPlay(second, beside=first))
    return tuple(turns)


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
    return _rank(item.condition)


def _rank(condition: str) -> tuple[object, ...]:
    return tuple(parse_condition(condition).sort_key)


# --- what is compared --------------------------------------------------------------------------


class Origin(Enum):
    """What gives the values of a rollout."""

    RETRIEVAL = "retrieval step"
    SIMULATOR = "simulator"
    WRITER = "subgoal writer"
    POLICY = "policy"


class Event(NamedTuple):
    """A value in a rollout: what gave it, after how many steps, and a digest of it."""

    part: Origin
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
    """

    most_steps: int = MAX_STEPS
    collects: bool = True
    events: list[Event] = field(default_factory=list)
    first_action: tuple[float, ...] = ()

    def received(self, frames: Sequence[int]) -> None:
        """Add which frames of the history the policy receives."""
        self._add(Origin.RETRIEVAL, 0, np.array(frames, np.int64))

    def observed(self, step: int, observation: Observation) -> None:
        """Add an observation of the simulator."""
        images = [observation.images[name] for name in sorted(observation.images)]
        self._add(Origin.SIMULATOR, step, *images, observation.state)

    def told(self, step: int, subgoal: Subgoal) -> None:
        """Add a subgoal."""
        self._add(Origin.WRITER, step, np.frombuffer(subgoal.grounded.encode(), np.uint8))

    def acted(self, step: int, action: NDArray[np.float32]) -> None:
        """Add an action of the policy."""
        self.first_action = self.first_action or tuple(action.tolist())
        self._add(Origin.POLICY, step, action)

    def ended(self, step: int, status: str) -> None:
        """Add how the simulator ended the rollout."""
        self._add(Origin.SIMULATOR, step, np.frombuffer(status.encode(), np.uint8))

    def _add(self, part: Origin, step: int, *arrays: NDArray[Any]) -> None:
        if not self.collects:
            return
        digest = hashlib.sha256()
        for array in arrays:
            digest.update(f"{array.dtype.str}{array.shape}".encode())
            digest.update(np.ascontiguousarray(array))
        self.events.append(Event(part, step, digest.digest()[:16]))


@dataclass(frozen=True)
class Play:
    """A rollout that the probe played.

    Attributes:
        turn: What was played.
        past: Labels of what the same client played since it was new.
        after: Label of what the probe played just before; None at its beginning.
        events: The values.
        first_action: The first action.
        status: How it ended; None if it was cut short.
    """

    turn: PlannedPlay
    past: tuple[str, ...]
    after: str | None
    events: tuple[Event, ...]
    first_action: tuple[float, ...] = ()
    status: str | None = None

    @property
    def circumstances(self) -> str:
        """What came before it, and what happened beside it, in words."""
        before = f"after {self.past[-1]}" if self.past else "with a new policy"
        beside = self.turn.beside
        return before + (f", while another client plays {beside.key}" if beside else "")


class ProbeVerdict(Enum):
    """What plays show."""

    INDEPENDENT = "independent"
    """All values are the same after any predecessor."""

    LEAK = "leak"
    """Values differ after another predecessor, and never after the same one."""

    NOISE = "nondeterministic"
    """Values differ after the same predecessor, too."""


@dataclass(frozen=True)
class FirstDifference:
    """The first value in which two plays of a rollout differ."""

    event: Event
    first: Play
    second: Play


def judge(plays: Sequence[Play]) -> tuple[ProbeVerdict, FirstDifference | None]:
    """Return what plays show, and the earliest difference that shows it.

    The values of a play follow either from all that its client did since it was new, or, in a
    process or server that outlives its clients, from the play just before. If no two plays with
    the same past differ, and two that do differ were both repeated, a state survives.
    """
    apart = _differences(plays)
    if not apart:
        return ProbeVerdict.INDEPENDENT, None
    for past in (_since_new, _just_before):
        explained = all(past(each.first) != past(each.second) for each in apart)
        times = Counter(map(past, plays))
        repeated = [
            each for each in apart if min(times[past(each.first)], times[past(each.second)]) > 1
        ]
        if explained and repeated:
            return ProbeVerdict.LEAK, min(repeated, key=_step)
    same = [each for each in apart if _since_new(each.first) == _since_new(each.second)]
    return ProbeVerdict.NOISE, min(same or apart, key=_step)


def _since_new(play: Play) -> tuple[object, ...]:
    return play.turn.item, play.turn.beside, play.past


def _just_before(play: Play) -> tuple[object, ...]:
    return play.turn.item, play.turn.beside, play.after


def _step(difference: FirstDifference) -> int:
    return difference.event.step


def _differences(plays: Sequence[Play]) -> list[FirstDifference]:
    """Return the first difference of each two plays of a rollout that differ."""
    found = []
    for first, second in combinations(plays, 2):
        if first.turn.item == second.turn.item:
            event = first_difference(first.events, second.events)
            if event is not None:
                found.append(FirstDifference(event, first, second))
    return found


def first_difference(first: Sequence[Event], second: Sequence[Event]) -> Event | None:
    """Return the first event in which two traces differ, as far as both go; None without one."""
    return next((b for a, b in zip(first, second, strict=False) if a != b), None)


# --- noisy systems -----------------------------------------------------------------------------


def flips(plays: Sequence[Play]) -> tuple[int, int]:
    """Return how many pairs of `rounds` were played after the same rollout, and how many flip."""
    pairs = [pair for same in _same_predecessor(plays) for pair in same]
    return len(pairs), sum(first.status != second.status for first, second in pairs)


def noise_p(repeats: Sequence[Sequence[Play]], plays: Sequence[Play]) -> float:
    """Return the p-value of a leak in a noisy system: the smallest of all tests, corrected.

    Each test supposes that the past has no effect. Then plays of a rollout may change places:

    - the first actions at two places of the `repeats` are rarely closest within either place;
    - of four `plays`, two after a rollout and two after another one, these pairs are the closest
      in at most a third of the rollouts, by their first actions and by their outcomes.

    Args:
        repeats: The plays of a sequence, at least twice.
        plays: The plays of `rounds`.
    """
    places = [*zip(*repeats, strict=True)]
    found = [
        _halves_p([play.first_action for play in (*first, *second)])
        for first, second in combinations(places, 2)
        if first[0].turn.item == second[0].turn.item
    ]
    fours = [same for same in _same_predecessor(plays) if len(same) == 2]
    for distance in (_action_distance, _outcome_distance):
        closest = 0
        for (a, b), (c, d) in fours:
            same = distance(a, b) + distance(c, d)
            others = (distance(a, c) + distance(b, d), distance(a, d) + distance(b, c))
            closest += same < min(others)
        if fours:
            found.append(poisson_binomial(closest, [1 / 3] * len(fours)))
    return min(1.0, len(found) * min(found))


def _halves_p(actions: Sequence[tuple[float, ...]]) -> float:
    """Return the share of divisions into halves that are as close within as the given one."""
    vectors = np.array(actions)
    distances = np.abs(vectors[:, None] - vectors[None]).max(axis=2)
    # Either half of a division names it: here that with the first play.
    count = len(actions)
    chosen = [(0, *others) for others in combinations(range(1, count), count // 2 - 1)]
    halves = np.array([[place in half for place in range(count)] for half in chosen])
    sums = sum(((half @ distances) * half).sum(axis=1) for half in (halves, ~halves))
    # The given one comes first.
    return float(np.mean(sums <= sums[0]))


def _same_predecessor(plays: Sequence[Play]) -> list[list[tuple[Play, Play]]]:
    """Return the pairs of plays after the same rollout, of each rollout."""
    groups: dict[WorkItem, dict[str, list[Play]]] = {}
    for play in plays:
        if play.after is not None:
            groups.setdefault(play.turn.item, {}).setdefault(play.after, []).append(play)
    return [
        [(group[0], group[1]) for group in own.values() if len(group) > 1]
        for own in groups.values()
    ]


def _action_distance(first: Play, second: Play) -> float:
    difference = np.subtract(first.first_action, second.first_action)
    return float(np.abs(difference).max(initial=0.0))


def _outcome_distance(first: Play, second: Play) -> float:
    return float(first.status != second.status)
