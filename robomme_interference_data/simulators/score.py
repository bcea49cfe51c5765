"""How often a built-in policy succeeds: the suite's own check that it is solvable and fair."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, cast

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import (
    InterferenceError,
    MotionError,
    SimulatorCrashError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.stats import wilson
from robomme_interference_data.simulators.base import Simulator, Status
from robomme_interference_data.simulators.registry import own_simulator
from robomme_interference_data.workers import run_tasks

__all__ = ["Outcome", "markdown_table", "play_all"]

_BROKEN = (SimulatorCrashError, MotionError)
"""Errors that are one episode's, not the run's."""


class _WithChance(Simulator, Protocol):
    """A simulator that knows how often a guess is right."""

    @property
    def chance(self) -> float: ...


@dataclass(frozen=True)
class Outcome:
    """What came of one episode.

    Attributes:
        episode: Which episode.
        difficulty: `easy`, `medium` or `hard`; empty if the simulator broke.
        status: How it ended; `error` if the simulator broke.
        lesson: Frames of the demonstration.
        steps: Executed steps.
        chance: Probability that a guess is right.
        why: What broke, or empty.
    """

    episode: EpisodeId
    difficulty: str
    status: Status
    lesson: int
    steps: int
    chance: float
    why: str = ""


def play_all(
    policy: str,
    episodes: Sequence[EpisodeId],
    simulator: str = "tabletop",
    workers: int = 1,
    time_limit: float = 600.0,
) -> Iterator[Outcome]:
    """Play episodes with `oracle` or `guess`, without drawing, in worker processes.

    An episode whose worker dies or exceeds its time is played once more, then given as an error.

    Args:
        policy: `oracle` or `guess`.
        episodes: Which episodes.
        simulator: Name of the simulator.
        workers: Worker processes.
        time_limit: Seconds that an episode may take.

    Yields:
        What came of each episode, as they end.

    Raises:
        InterferenceError: The simulator cannot be made, or refuses an episode.
    """
    function = partial(_play, simulator, policy)
    for done in run_tasks(function, episodes, workers=workers, time_limit=time_limit):
        if done.error is None:
            yield done.value
        elif isinstance(done.error, InterferenceError) and not isinstance(done.error, _BROKEN):
            raise done.error
        else:
            why = (str(done.error).splitlines() or [repr(done.error)])[0]
            yield Outcome(done.task, "", Status.ERROR, 0, 0, 0.0, why)


def _play(simulator: str, policy: str, episode: EpisodeId) -> Outcome:
    running = cast(_WithChance, own_simulator(simulator, render=False))
    lesson, _, info = running.reset(str(episode))
    chance, status, steps = running.chance, Status.ONGOING, 0
    while status is Status.ONGOING:
        _, status = running.step(running.act(policy), observe=False)
        steps += 1
    return Outcome(episode, info.difficulty, status, len(lesson), steps, chance)


def markdown_table(outcomes: Iterable[Outcome]) -> str:
    """Return a Markdown table: a row per family, one for all, successes by difficulty."""
    played = list(outcomes)
    rows = [
        "| family | easy | medium | hard | all | 95% interval | chance | errors |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    groups = [(family, [o for o in played if o.episode.family == family]) for family in FAMILIES]
    for name, group in [*groups, ("all", played)]:
        if not group:
            continue
        scored = [o for o in group if o.status is not Status.ERROR]
        cells = [_count(o for o in scored if o.difficulty == d) for d in ("easy", "medium", "hard")]
        won = sum(o.status is Status.SUCCESS for o in scored)
        low, high = wilson(won, len(scored))
        chance = sum(o.chance for o in scored) / max(len(scored), 1)
        rows.append(
            f"| {name} | {' | '.join(cells)} | {won}/{len(scored)} | {low:.1%} – {high:.1%} | "
            f"{chance:.1%} | {len(group) - len(scored)} |"
        )
    return "\n".join(rows)


def _count(outcomes: Iterable[Outcome]) -> str:
    group = list(outcomes)
    return f"{sum(o.status is Status.SUCCESS for o in group)}/{len(group)}"
