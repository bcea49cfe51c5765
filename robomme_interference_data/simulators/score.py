"""How often a built-in policy succeeds: the suite's own check that it is solvable and fair."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import SimulatorCrashError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.intervals import wilson
from robomme_interference_data.simulators.base import Status
from robomme_interference_data.simulators.pool import map_episodes
from robomme_interference_data.simulators.worker import RemoteSimulator

__all__ = ["Outcome", "markdown_table", "play_all"]


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
    """

    episode: EpisodeId
    difficulty: str
    status: Status
    lesson: int
    steps: int
    chance: float


def play_all(
    policy: str, episodes: Sequence[EpisodeId], simulator: str = "tabletop", workers: int = 1
) -> Iterator[Outcome]:
    """Play episodes with `oracle` or `guess`, without drawing, and yield what came of each."""

    def play(remote: RemoteSimulator, episode: EpisodeId) -> Outcome:
        lesson, _, info = remote.reset(str(episode))
        chance, status, steps = remote.chance, Status.ONGOING, 0
        while status is Status.ONGOING:
            _, status = remote.step(remote.act(policy))
            steps += 1
        return Outcome(episode, info.difficulty, status, len(lesson), steps, chance)

    for episode, result in map_episodes(play, episodes, simulator, workers, render=False):
        if isinstance(result, SimulatorCrashError):
            yield Outcome(episode, "", Status.ERROR, 0, 0, 0.0)
        else:
            yield result


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
