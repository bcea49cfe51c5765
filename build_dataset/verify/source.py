"""Check recorded episodes before a build: read all frames of all of them, and collect problems.

Reading goes through the sources, and the rules of frames and datasets, as in a build.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field

from robomme_interference_data.build_dataset.alike import Look, differences, in_dataset
from robomme_interference_data.build_dataset.dataset.plan import PlannedEpisode
from robomme_interference_data.build_dataset.sources import Source
from robomme_interference_data.errors import (
    SAME_FOR_ALL,
    InterferenceError,
    first_line,
    named,
    naming_options,
    option_names,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Executor, Outcome, Worker

from .source_episode import CheckedEpisode, EpisodeProblem, check_episode


@dataclass(frozen=True)
class Problem:
    """What is wrong with a source.

    Attributes:
        source: The source as it was given, such as `frames:mine`.
        episode: The episode; None for the source as a whole.
        frame: Number of the recorded frame, from 0; None if it is not about one.
        what: What is wrong.
        hint: What to do; None if there is nothing to add.
    """

    source: str
    episode: str | None
    frame: int | None
    what: str
    hint: str | None = None

    def __str__(self) -> str:
        parts = [self.source]
        if self.episode is not None:
            parts.append(self.episode)
        if self.frame is not None:
            parts.append(f"frame {self.frame}")
        # Many messages of sources begin with the episode themselves.
        what = self.what.removeprefix(f"{self.episode}: ")
        return f"{', '.join(parts)}: {what}"


@dataclass(frozen=True)
class SourceReport:
    """The episodes of sources, and everything that is wrong with them.

    Attributes:
        problems: The problems, by episode and frame.
        episodes: Number of episodes, those with problems included.
        frames: Number of frames that could be read.
        with_demonstration: Number of episodes with demonstration frames and a live observation
            after them.
        exact: Number of episodes whose frames were never lossily compressed.
        looks: What can be in one dataset, with the number of its episodes; most frequent first.
    """

    problems: list[Problem]
    episodes: int
    frames: int
    with_demonstration: int
    exact: int
    looks: list[tuple[Look, int]]


@dataclass(frozen=True)
class CheckTask:
    """Reads episodes one by one, as a task of an executor.

    Attributes:
        sources: The sources.
        cameras: Cameras to read; None for all.
        fps: Frames per second of recordings that do not state them.
        option_names: How errors name settings, also in another process.
    """

    sources: tuple[Source, ...]
    cameras: tuple[str, ...] | None
    fps: float | None
    option_names: Mapping[str, str] = field(default_factory=option_names)

    def __call__(self, task: tuple[int, PlannedEpisode], worker: Worker) -> CheckedEpisode:
        """Read an episode, which comes with its number, to its end or to what cannot be read."""
        _, (source, episode) = task
        with naming_options(self.option_names):
            return check_episode(self.sources[source], episode, self.cameras, self.fps)

    def close(self) -> None:
        """Close the sources."""
        for source in self.sources:
            source.close()


def check_sources(
    names: Sequence[str],
    task: CheckTask,
    episodes: Sequence[PlannedEpisode],
    executor: Executor,
    advance: Callable[[int], object] = lambda count: None,
) -> SourceReport:
    """Read episodes of sources, and return everything that is wrong with them.

    Args:
        names: The sources as they were given.
        task: What reads an episode.
        episodes: The episodes, in canonical order.
        executor: What runs the task.
        advance: Called with the number of episodes that were read.

    Raises:
        InvalidOptionError, MissingExtraError, SimulatorError: No episode can be read so.
    """
    checked = dict[int, CheckedEpisode]()
    limit = max((source.time_limit_s for source in task.sources), default=None)
    with closing(executor.run(task, enumerate(episodes), time_limit=limit)) as outcomes:
        for outcome in outcomes:
            advance(1)
            if isinstance(outcome.error, SAME_FOR_ALL):
                raise outcome.error
            number, _ = outcome.task
            checked[number] = outcome.value if outcome.error is None else _lost(outcome)
    read = [checked[number] for number in range(len(episodes))]
    problems = [
        Problem(names[source], str(episode.id), problem.frame, problem.what, problem.hint)
        for (source, episode), found in zip(episodes, read, strict=True)
        for problem in found.problems
    ]
    looks = {
        number: (str(episodes[number].episode.id), found.look)
        for number, found in enumerate(read)
        if found.look is not None
    }
    groups = _groups(looks)
    problems += _twice(names, episodes)
    problems += _unlike(names, episodes, looks, groups)
    return SourceReport(
        problems=problems,
        episodes=len(episodes),
        frames=sum(found.frames for found in read),
        with_demonstration=sum(0 < (found.lesson or 0) < found.frames for found in read),
        exact=sum(found.exact for found in read),
        looks=[(looks[group[0]][1], len(group)) for group in groups],
    )


def _lost(outcome: Outcome) -> CheckedEpisode:
    """Return what is known of an episode whose worker died, or that took too long."""
    error = outcome.error
    assert error is not None
    hint = error.hint if isinstance(error, InterferenceError) else None
    return CheckedEpisode(0, None, None, False, (EpisodeProblem(None, first_line(error), hint),))


def _twice(names: Sequence[str], episodes: Sequence[PlannedEpisode]) -> Iterator[Problem]:
    """Yield each episode that is recorded twice."""
    first = dict[EpisodeId, int]()
    for source, episode in episodes:
        if episode.id in first:
            yield Problem(
                names[source],
                str(episode.id),
                None,
                f"is recorded twice, also in {names[first[episode.id]]}",
                "Give only one of them, or name the episode differently in one.",
            )
        first.setdefault(episode.id, source)


def _groups(looks: Mapping[int, tuple[str, Look]]) -> list[list[int]]:
    """Return the numbers of episodes that can be in one dataset together, largest group first."""
    groups = list[list[int]]()
    for number, look in looks.items():
        for group in groups:
            if not _differences(looks[group[0]], look):
                group.append(number)
                break
        else:
            groups.append([number])
    return sorted(groups, key=len, reverse=True)


def _unlike(
    names: Sequence[str],
    episodes: Sequence[PlannedEpisode],
    looks: Mapping[int, tuple[str, Look]],
    groups: Sequence[Sequence[int]],
) -> Iterator[Problem]:
    """Yield each episode that cannot be in one dataset with most of the others."""
    for group in groups[1:]:
        for number in group:
            usual = looks[groups[0][0]]
            source, episode = episodes[number]
            yield Problem(
                names[source],
                str(episode.id),
                None,
                f"cannot be in one dataset with {usual[0]}: "
                f"{'; '.join(_differences(usual, looks[number]))}",
                f"Leave it out, choose {named('cameras')} that all have, or build separate buffer "
                "sets.",
            )


def _differences(left: tuple[str, Look], right: tuple[str, Look]) -> list[str]:
    """Return how two episodes differ that are to be in one dataset."""
    looks = in_dataset(left[1], right[1])
    return differences((left[0], looks[0]), (right[0], looks[1]))
