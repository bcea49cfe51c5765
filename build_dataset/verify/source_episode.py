"""Read one recorded episode, and collect what is wrong with its frames.

Reading goes through the source, and the rules of frames, as in a build.
"""

from collections import Counter
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial

from robomme_interference_data.build_dataset.alike import Look
from robomme_interference_data.build_dataset.dataset.frame_checks import (
    check_numbers,
    check_same_shapes,
    check_shapes,
)
from robomme_interference_data.build_dataset.sources import Frame, Recording, Source, SourceEpisode
from robomme_interference_data.constants import ACTION, CAMERA_PREFIX, STATE
from robomme_interference_data.errors import SAME_FOR_ALL, InterferenceError, SourceError, counted

_OF_FRAMES = ("reading", "first frame", "same shapes")
"""Rules that are about one frame, as are those that are named after a feature."""


@dataclass(frozen=True)
class EpisodeProblem:
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
        problems: What is wrong with it.
    """

    frames: int
    lesson: int | None
    look: Look | None
    exact: bool
    problems: tuple[EpisodeProblem, ...]


def check_episode(
    source: Source, episode: SourceEpisode, cameras: tuple[str, ...] | None, fps: float | None
) -> CheckedEpisode:
    """Read an episode to its end, or to what cannot be read.

    Args:
        source: Its source.
        episode: The episode.
        cameras: Cameras to read; None for all.
        fps: Frames per second if the recording does not state them.

    Raises:
        InvalidOptionError, MissingExtraError, SimulatorError: All episodes would fail alike.
    """
    checks = _EpisodeChecks()

    def open_recording() -> Recording:
        episode.check()
        return source.read(episode, cameras)

    recording = checks.apply("opening", open_recording)
    if recording is None:
        return CheckedEpisode(0, None, None, False, checks.problems())
    rate = checks.apply("rate", partial(recording.robot.at, fps))
    lesson: int | None = None
    with closing(recording.frames):
        # What cannot be read ends the episode: the frames after it may be anything.
        while frame := checks.apply("reading", partial(next, recording.frames, None)):
            if frame.is_demonstration is not None:
                lesson = (lesson or 0) + frame.is_demonstration
            checks.add(frame)
    if not checks.count and not checks.problems():
        checks.apply("length", _no_frames)
    checks.apply("names", partial(recording.robot.check_names, checks.shapes))
    look = None
    if checks.shapes and rate is not None:
        look = Look(checks.shapes, rate, recording.robot.type, recording.robot.names)
    return CheckedEpisode(checks.count, lesson, look, recording.exact, checks.problems())


def _no_frames() -> None:
    raise SourceError("the episode has no frames", "Leave it out.")


class _EpisodeChecks:
    """Applies rules to an episode; of each rule, the first frame that breaks it is kept.

    Attributes:
        shapes: Features to their shapes in the first frame.
        count: Number of frames so far.
    """

    def __init__(self) -> None:
        self.shapes: dict[str, tuple[int, ...]] = {}
        self.count = 0
        self._first: dict[str, EpisodeProblem] = {}
        self._times = Counter[str]()

    def apply[Result](self, rule: str, check: Callable[[], Result]) -> Result | None:
        """Return what a check returns; None if it raises an error, which is kept.

        Raises:
            InvalidOptionError, MissingExtraError, SimulatorError: All episodes would fail alike.
        """
        try:
            return check()
        except SAME_FOR_ALL:
            raise
        except InterferenceError as error:
            frame = self.count if rule in _OF_FRAMES or rule in self.shapes else None
            self._times[rule] += 1
            self._first.setdefault(rule, EpisodeProblem(frame, error.message, error.hint))
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
            self.apply("first frame", partial(check_shapes, images, vectors))
        where = f"frame {self.count}"
        self.apply("same shapes", partial(check_same_shapes, shapes, self.shapes, where))
        for name, value in vectors.items():
            self.apply(name, partial(check_numbers, name, value, where))
        self.count += 1

    def problems(self) -> tuple[EpisodeProblem, ...]:
        """Return what is wrong, each thing at its first frame."""
        found = []
        for rule, first in self._first.items():
            more = self._times[rule] - 1
            also = f" (and {counted(more, 'further frame')})" if more else ""
            found.append(replace(first, what=first.what + also))
        return tuple(found)
