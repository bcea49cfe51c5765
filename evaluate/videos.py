"""Side-by-side clips of rollouts: what was in the history, what the robot sees, how it went."""

import textwrap
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.buffer import Buffer
from robomme_interference_data.constants import FPS, MAX_STEPS
from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.files import atomic_path
from robomme_interference_data.simulators.base import EpisodeInfo, Observation, Status
from robomme_interference_data.strip import session_colors, shown_frames

__all__ = ["VIDEO_FOLDER", "ClipWatcher", "check_videos", "video_name"]

VIDEO_FOLDER = "videos"

_VIEW = 256  # side of a camera's picture
_WIDTH = 4 * _VIEW  # history to the left, then front and wrist, then the facts
_HEIGHT = _VIEW + 24
_COLUMNS = 8
_THUMB = _VIEW // _COLUMNS
_COLOURS = {
    Status.ONGOING: "#555555",
    Status.SUCCESS: "#009E73",
    Status.FAIL: "#D55E00",
    Status.TIMEOUT: "#E69F00",
    Status.ERROR: "#000000",
}
_LAST = 10
"""Frames for which the end stays."""

_LETTERS = 34
"""Letters in a line of the facts."""

_LINES = 14
"""Lines of the facts."""


def video_name(item: WorkItem) -> str:
    """Return the path of a rollout's clip inside the run's folder."""
    episode = item.episode
    name = f"{episode.family}_{episode.split}_{episode.index}_{item.condition}.mp4"
    return f"{VIDEO_FOLDER}/{name}"


def check_videos() -> None:
    """Check that clips can be written.

    Raises:
        MissingExtraError: pillow, which draws the words, is not installed.
    """
    try:
        import PIL  # noqa: F401
    except ImportError as error:
        raise MissingExtraError(
            "--videos needs pillow, which is not installed", "pip install pillow"
        ) from error


class ClipWatcher:
    """Writes the clip of a rollout as it goes, H.264 in MP4, 10 frames a second.

    Pictures are encoded at once, so memory stays bounded. What goes wrong with the clip never
    reaches the rollout: it is kept as `problem`, and there is no clip. Use as a context manager:
    a clip that was not closed is removed.

    Args:
        path: The clip's file.
        item: The rollout.
        system: Name of the system.

    Attributes:
        problem: Traceback of what went wrong, or None.
    """

    def __init__(self, path: Path, item: WorkItem, system: str):
        self.problem: str | None = None
        self._path = path
        self._heading = [*_wrap(system, _LETTERS), str(item.episode), f"condition {item.condition}"]
        self._goal = self._given = ""
        self._history: NDArray[np.uint8] = np.full((_VIEW, _VIEW, 3), 255, np.uint8)
        self._images: Mapping[str, NDArray[np.uint8]] = {}
        self._steps = 0
        self._files = ExitStack()
        self._container: Any = None
        self._stream: Any = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        if self._container is not None:
            self._drop(RuntimeError("the rollout was not recorded to its end"))

    def begin(
        self, buffer: Buffer | None, start: int, stop: int, first: Observation, info: EpisodeInfo
    ) -> None:
        """Take what is known before the first step; see `rollout.Watcher`."""

        def draw() -> None:
            self._goal = info.goal
            self._given = f"history given: {stop - start} frames" if stop > start else "no history"
            if buffer is not None and stop > start:
                self._history = history_picture(buffer, start, stop)
            self._images = first.images
            self._open()
            self._encode(self.picture(Status.ONGOING))

        self._attempt(draw)

    def step(self, observation: Observation, status: Status, subgoal: str | None) -> None:
        """Take what came of a step."""

        def draw() -> None:
            self._steps += 1
            self._images = observation.images
            self._encode(self.picture(status, subgoal=subgoal))

        self._attempt(draw)

    def close(self, status: Status, error: str | None = None) -> bool:
        """Hold the end for a second, and give the clip its name.

        Args:
            status: How the rollout ended.
            error: What broke, or None.

        Returns:
            Whether there is a clip: none of a rollout that broke before its first observation.
        """
        if self._container is None:
            return False

        def end() -> None:
            picture = self.picture(status, error=error)
            for _ in range(_LAST):
                self._encode(picture)
            self._container.mux(self._stream.encode())
            self._container = None
            self._files.close()

        self._attempt(end)
        return self.problem is None

    def picture(
        self, status: Status, *, subgoal: str | None = None, error: str | None = None
    ) -> NDArray[np.uint8]:
        """Return the clip's present picture, `(280, 1024, 3) uint8`."""
        canvas = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
        canvas[24:, :_VIEW] = self._history
        for place, name in enumerate(("front", "wrist"), 1):
            if name in self._images:
                view = self._images[name][:_VIEW, :_VIEW]
                canvas[24 : 24 + view.shape[0], place * _VIEW : place * _VIEW + view.shape[1]] = (
                    view
                )
        lines = [*self._heading, "", *_wrap(self._goal, _LETTERS)]
        for head, text in (("subgoal:", subgoal), ("what broke:", error)):
            if text:
                lines += ["", head, *_wrap(text, _LETTERS)]
        # The last two lines always have their place, however long the words before them are.
        lines = [*lines[: _LINES - 3], "", f"step {self._steps} of {MAX_STEPS}", str(status)]
        heads = (self._given, "front", "wrist", "")
        return _lettered(canvas, heads, lines, _COLOURS[status])

    def _attempt(self, work: Callable[[], None]) -> None:
        if self.problem is None:
            try:
                work()
            except Exception as error:
                self.problem = f"the clip failed:\n{traceback.format_exc()}"
                self._drop(error)

    def _open(self) -> None:
        import av

        for left in self._path.parent.glob(f".{self._path.name}.*.partial"):
            left.unlink()  # of a process that was killed
        partial = self._files.enter_context(atomic_path(self._path))
        self._container = self._files.enter_context(av.open(str(partial), "w", format="mp4"))
        self._stream = self._container.add_stream("libx264", rate=FPS)
        self._stream.width, self._stream.height = _WIDTH, _HEIGHT
        self._stream.pix_fmt = "yuv420p"
        self._stream.options = {"crf": "23", "preset": "veryfast"}

    def _encode(self, picture: NDArray[np.uint8]) -> None:
        import av

        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        self._container.mux(self._stream.encode(frame))

    def _drop(self, error: Exception) -> None:
        """Remove what was written."""
        self._container = None
        with suppress(Exception):  # a full disk fails once more
            self._files.__exit__(type(error), error, error.__traceback__)


def history_picture(buffer: Buffer, start: int, stop: int) -> NDArray[np.uint8]:
    """Return 64 frames of a span of a history, evenly spread, as `(256, 256, 3) uint8`.

    Each has a line under it in the colour of its session, the lesson's as in the film strip.

    Args:
        buffer: The history.
        start: First frame.
        stop: Frame after the last one.
    """
    picture = np.full((_VIEW, _VIEW, 3), 255, np.uint8)
    colours = session_colors(buffer.sessions)
    sessions = buffer.session_index
    for place, index in enumerate(shown_frames(start, stop, _COLUMNS * _COLUMNS)):
        y, x = (_THUMB * part for part in divmod(place, _COLUMNS))
        frame = buffer.frame(index, "front")
        step = frame.shape[0] // (_THUMB - 4)
        small = frame[step // 2 :: step, step // 2 :: step][: _THUMB - 4, : _THUMB - 4]
        picture[y : y + small.shape[0], x : x + small.shape[1]] = small
        picture[y + _THUMB - 4 : y + _THUMB - 1, x : x + _THUMB - 2] = _rgb(
            colours[sessions[index]]
        )
    return picture


def _lettered(
    canvas: NDArray[np.uint8], heads: Sequence[str], lines: Sequence[str], colour: str
) -> NDArray[np.uint8]:
    """Write the lines beside the views, and what the parts are above them."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(13)
    for place, head in enumerate(heads):
        draw.text((place * _VIEW + 4, 4), head, fill="#333333", font=font)
    y = 28
    for line in lines[:-1]:
        draw.text((3 * _VIEW + 10, y), line, fill="black", font=font)
        y += 17
    draw.rectangle((3 * _VIEW + 8, y + 2, 4 * _VIEW - 8, y + 24), fill=colour)
    draw.text((3 * _VIEW + 14, y + 5), lines[-1], fill="white", font=font)
    return np.asarray(image)


def _wrap(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width)[:8]


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(int(colour[place : place + 2], 16) for place in (1, 3, 5))
