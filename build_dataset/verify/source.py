"""Check recorded episodes before a build: read all frames of all of them, and collect problems.

Reading goes through the sources, and the rules of frames and datasets, as in a build.
"""

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import partial

from robomme_interference_data.build_dataset.alike import Look, differences
from robomme_interference_data.build_dataset.dataset.frame_checks import (
    check_numbers,
    check_same_shapes,
    check_shapes,
)
from robomme_interference_data.build_dataset.dataset.plan import PlannedEpisode
from robomme_interference_data.build_dataset.sources import Frame, Recording, Source, SourceEpisode
from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, STATE
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    MissingExtraError,
    SimulatorError,
    SourceError,
    counted,
    first_line,
    named,
    naming_options,
    option_names,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Executor, Outcome, Worker


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
class Finding:
    """What is wrong with an episode: the first frame with it (None: no frame), and the error."""

    frame: int | None
    what: str
    hint: str | None


@dataclass(frozen=True)
class CheckedEpisode:
    """What reading an episode showed.

    Attributes:
        frames: Number of frames that could be read.
        lesson: Number of its demonstration frames; None if the source marks none.
        look: What must be alike in all episodes; None if no frame could be read.
        exact: Whether its frames were never lossily compressed.
        findings: What is wrong with it.
    """

    frames: int
    lesson: int | None
    look: Look | None
    exact: bool
    findings: tuple[Finding, ...]


@dataclass(frozen=True)
class SourceReport:
    """The episodes of sources, and everything that is wrong with them.

    Attributes:
        problems: The problems, by episode and frame.
        episodes: Number of episodes, those with problems included.
        frames: Number of frames that could be read.
        marked: Number of episodes with demonstration frames and a live observation after them.
        exact: Number of episodes whose frames were never lossily compressed.
        looks: What can be in one dataset, with the number of its episodes; most frequent first.
    """

    problems: list[Problem]
    episodes: int
    frames: int
    marked: int
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
            return _check_episode(self.sources[source], episode, self.cameras, self.fps)

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
            if isinstance(outcome.error, InvalidOptionError | MissingExtraError | SimulatorError):
                raise outcome.error
            number, _ = outcome.task
            checked[number] = outcome.value if outcome.error is None else _lost(outcome)
    read = [checked[number] for number in range(len(episodes))]
    problems = [
        Problem(names[source], str(episode.id), finding.frame, finding.what, finding.hint)
        for (source, episode), found in zip(episodes, read, strict=True)
        for finding in found.findings
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
        marked=sum(found.lesson is not None and 0 < found.lesson < found.frames for found in read),
        exact=sum(found.exact for found in read),
        looks=[(looks[group[0]][1], len(group)) for group in groups],
    )


def _check_episode(
    source: Source, episode: SourceEpisode, cameras: tuple[str, ...] | None, fps: float | None
) -> CheckedEpisode:
    checks = _Checks()

    def open_recording() -> Recording:
        episode.check()
        return source.read(episode, cameras)

    recording = checks.apply("opening", open_recording)
    if recording is None:
        return CheckedEpisode(0, None, None, True, checks.findings())
    rate = checks.apply("rate", partial(recording.robot.at, fps))
    lesson: int | None = None
    with closing(recording.frames):
        # What cannot be read ends the episode: the frames after it may be anything.
        while frame := checks.apply("reading", partial(next, recording.frames, None)):
            if frame.is_demonstration is not None:
                lesson = (lesson or 0) + frame.is_demonstration
            checks.add(frame)
    if not checks.count and not checks.findings():
        checks.apply("length", _no_frames)
    checks.apply("names", partial(recording.robot.check_names, checks.shapes))
    look = None
    if checks.shapes and rate is not None:
        look = Look(checks.shapes, rate, recording.robot.type, recording.robot.names)
    return CheckedEpisode(checks.count, lesson, look, recording.exact, checks.findings())


def _no_frames() -> None:
    raise SourceError("the episode has no frames", "Leave it out.")


class _Checks:
    """Applies rules to an episode; of each rule, the first frame that breaks it is kept.

    Attributes:
        shapes: Features to their shapes in the first frame.
        count: Number of frames so far.
    """

    def __init__(self) -> None:
        self.shapes: dict[str, tuple[int, ...]] = {}
        self.count = 0
        self._first: dict[str, Finding] = {}
        self._times = Counter[str]()

    def apply[Result](self, rule: str, check: Callable[[], Result]) -> Result | None:
        """Return what a check returns; None if it raises an error, which is kept.

        Raises:
            InvalidOptionError, MissingExtraError, SimulatorError: All episodes would fail alike.
        """
        try:
            return check()
        except (InvalidOptionError, MissingExtraError, SimulatorError):
            raise
        except InterferenceError as error:
            frame = self.count if rule in _OF_FRAMES or rule in self.shapes else None
            self._times[rule] += 1
            self._first.setdefault(rule, Finding(frame, error.message, error.hint))
            return None

    def add(self, frame: Frame) -> None:
        """Check the next frame."""
        images = {CAMERA_PREFIX + camera: image for camera, image in frame.images.items()}
        vectors = {STATE: frame.state}
        # If the first frame has none, as in recordings of RoboMME, those of others are not stored.
        if frame.action is not None and (self.count == 0 or ACTION in self.shapes):
            vectors[ACTION] = frame.action
        shapes = {name: value.shape for name, value in (images | vectors).items()}
        if self.count == 0:
            self.shapes = shapes
            self.apply("values", partial(check_shapes, images, vectors))
        where = f"frame {self.count}"
        self.apply("shapes", partial(check_same_shapes, shapes, self.shapes, where))
        for name, value in vectors.items():
            self.apply(name, partial(check_numbers, name, value, where))
        self.count += 1

    def findings(self) -> tuple[Finding, ...]:
        """Return what is wrong, each thing at its first frame."""
        found = []
        for rule, first in self._first.items():
            more = self._times[rule] - 1
            also = f" (and {counted(more, 'further frame')})" if more else ""
            found.append(replace(first, what=first.what + also))
        return tuple(found)


_OF_FRAMES = ("reading", "values", "shapes")
"""Rules that are about one frame, as are those of the features."""


def _lost(outcome: Outcome) -> CheckedEpisode:
    """Return what is known of an episode whose worker died, or that took too long."""
    error = outcome.error
    assert error is not None
    hint = error.hint if isinstance(error, InterferenceError) else None
    return CheckedEpisode(0, None, None, True, (Finding(None, first_line(error), hint),))


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
    """Return how two episodes differ; one may lack actions."""
    shared = left[1].features.keys() & right[1].features.keys()
    without = {ACTION} - shared
    return differences(_without(left, without), _without(right, without))


def _without(named_look: tuple[str, Look], names: Collection[str]) -> tuple[str, Look]:
    name, look = named_look
    features = {feature: shape for feature, shape in look.features.items() if feature not in names}
    return name, replace(look, features=features)
