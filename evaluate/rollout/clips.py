"""Clips of rollouts: the lesson, the history that was given, and the live views, side by side."""

import textwrap
import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from functools import wraps
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.errors import counted
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.sampling import spread
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.episode import EpisodeInfo, Observation
from robomme_interference_data.storage.encode import CLIP, VideoEncoder
from robomme_interference_data.viz.figure import Hue
from robomme_interference_data.viz.filmstrip import session_colors

_VIEW = 256  # side of a camera's picture
_VIEWS = 4  # lesson, history and two live cameras
_WIDTH = (_VIEWS + 1) * _VIEW  # and the text
_HEAD = 24
_HEIGHT = _VIEW + _HEAD
_COLUMNS = 8
_THUMB = _VIEW // _COLUMNS
_SMALL = _THUMB - 4  # side of a frame, above the line of its session
_COLORS = {
    Status.ONGOING: "#555555",
    Status.SUCCESS: Hue.GREEN,
    Status.FAIL: Hue.VERMILION,
    Status.TIMEOUT: Hue.ORANGE,
    Status.ERROR: "#000000",
}
_LETTERS = 34
"""Maximum letters in a line of text."""

_LINES = 14
"""Maximum lines of text."""


def _harmless[**P](method: Callable[P, None]) -> Callable[P, None]:
    """Turn exceptions of a method of a clip into its `problem`."""

    @wraps(method)
    def attempt(*arguments: P.args, **named: P.kwargs) -> None:
        clip: Any = arguments[0]
        if clip.problem is None:
            try:
                method(*arguments, **named)
            except Exception:
                clip.problem = f"the clip failed:\n{traceback.format_exc()}"
                with suppress(Exception):  # a full disk fails again
                    clip._file.close()

    return attempt


class Clip:
    """Draws and encodes a rollout at the pace of its recordings; `data` is the closed MP4 file.

    A fault in the clip does not break the rollout: `problem` has its traceback, and `data` is None.
    """

    def __init__(self, item: WorkItem, system: str, folder: str | None = None):
        self._folder = folder
        self.data: bytes | None = None
        self.problem: str | None = None
        names = (system, str(item.episode), f"condition {item.condition}")
        self._heading = [line for name in names for line in textwrap.wrap(name, _LETTERS)]
        self._goal = self._given = ""
        self._views: dict[str, NDArray[np.uint8]] = {}
        self._cameras: list[str] = []
        self._pointed = ""  # the camera that the points of subgoals are in
        self._lesson: Iterator[NDArray[np.uint8]] = iter(())
        self._subgoal: Subgoal | None = None
        self._steps = 0
        self._fps = 1
        self._file = ExitStack()
        self._path = Path()
        self._encoder: VideoEncoder | None = None

    @_harmless
    def begin(
        self, buffer: Buffer, given: Sequence[int], first: Observation, info: EpisodeInfo
    ) -> None:
        """Draw the first picture, with the history frames that were given."""
        self._goal, self._fps = info.goal, max(1, round(buffer.query.dataset.fps))
        self._given = f"history given: {counted(len(given), 'frame')}" if given else "no history"
        self._views = {"given": history_picture(buffer, given)}
        self._cameras = sorted(first.images)[: _VIEWS - 2]
        self._pointed = buffer.query.dataset.camera()
        self._lesson = self._file.enter_context(closing(_lesson_of(buffer)))
        self._show(first)
        self._path = Path(
            self._file.enter_context(TemporaryDirectory(dir=self._folder)), "clip.mp4"
        )
        self._encoder = VideoEncoder(self._path, CLIP, self._fps, _HEIGHT, _WIDTH, container="mp4")
        self._encoder.add(self._picture(Status.ONGOING))

    @_harmless
    def step(self, observation: Observation, status: Status, subgoal: Subgoal | None) -> None:
        """Draw a step, with the images of two cameras, and its subgoal."""
        if self._encoder is not None:
            self._steps += 1
            self._subgoal = subgoal
            self._show(observation)
            self._encoder.add(self._picture(status))

    @_harmless
    def close(self, status: Status, error: str | None = None) -> None:
        """Show the end for a second, and close the clip, if it began."""
        if self._encoder is not None:
            picture = self._picture(status, error=error)
            for _ in range(self._fps):
                self._encoder.add(picture)
            self._encoder.close()
            self.data = self._path.read_bytes()
            self._file.close()

    def _show(self, observation: Observation) -> None:
        """Set the live views, and the lesson's next frame, if it has one."""
        self._views |= observation.images
        for frame in islice(self._lesson, 1):
            self._views["lesson"] = frame

    def _picture(self, status: Status, *, error: str | None = None) -> NDArray[np.uint8]:
        """Return the current picture, `(280, 1280, 3) uint8`."""
        canvas = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
        for place, name in enumerate(("lesson", "given", *self._cameras)):
            if name in self._views:
                view = self._views[name]
                step = -(-max(view.shape[:2]) // _VIEW)  # 1 up to 256 pixels
                view = view[::step, ::step]
                x = place * _VIEW
                canvas[_HEAD : _HEAD + view.shape[0], x : x + view.shape[1]] = view
        if self._subgoal and self._pointed in self._cameras:
            left = (self._cameras.index(self._pointed) + 2) * _VIEW
            for y, x in self._subgoal.points:
                _cross(canvas[_HEAD:, left : left + _VIEW], y, x)
        lines = [*self._heading, "", *textwrap.wrap(self._goal, _LETTERS)]
        subgoal = self._subgoal and self._subgoal.simple
        for head, text in (("subgoal:", subgoal), ("error:", error)):
            if text:
                lines += ["", head, *textwrap.wrap(text, _LETTERS)]
        # The last two lines always fit, however long the text before them is.
        lines = [*lines[: _LINES - 3], "", f"step {self._steps} of {MAX_STEPS}", str(status)]
        heads = ["lesson" if "lesson" in self._views else "no lesson", self._given]
        heads += self._cameras
        return _lettered(canvas, heads, lines, _COLORS[status])


def _lesson_of(buffer: Buffer) -> Generator[NDArray[np.uint8]]:
    """Yield the frames of a buffer's lesson, `(H, W, 3) uint8`, of the first camera."""
    camera = buffer.query.dataset.camera()
    lesson = [one for one in buffer.sessions if one.role == "lesson"]
    indices = [index for one in lesson for index in range(one.start, one.stop)]
    for chunk in buffer.stream(1, (camera,), indices):
        yield chunk.frames[camera][0]


def _cross(view: NDArray[np.uint8], y: int, x: int) -> None:
    """Mark a point of a view, in black and white: visible on any background."""
    for wide, shade in ((2, 255), (1, 0)):
        view[max(y - 5, 0) : y + 6, max(x - wide + 1, 0) : x + wide] = shade
        view[max(y - wide + 1, 0) : y + wide, max(x - 5, 0) : x + 6] = shade


def history_picture(buffer: Buffer, given: Sequence[int]) -> NDArray[np.uint8]:
    """Return 64 evenly spread history frames, `(256, 256, 3) uint8`, underlined by session."""
    picture = np.full((_VIEW, _VIEW, 3), 255, np.uint8)
    colors, sessions = session_colors(buffer.sessions), buffer.session_index
    camera = buffer.query.dataset.camera()
    for place, chosen in enumerate(spread(0, len(given), _COLUMNS * _COLUMNS)):
        index = given[chosen]
        y, x = (_THUMB * part for part in divmod(place, _COLUMNS))
        frame = buffer.frame(index, camera)
        step = max(1, frame.shape[0] // _SMALL)
        small = frame[step // 2 :: step, step // 2 :: step][:_SMALL, :_SMALL]
        picture[y : y + small.shape[0], x : x + small.shape[1]] = small
        color = bytes.fromhex(colors[sessions[index]][1:])
        picture[y + _SMALL : y + _THUMB - 1, x : x + _THUMB - 2] = tuple(color)
    return picture


def _lettered(
    canvas: NDArray[np.uint8], heads: Sequence[str], lines: Sequence[str], color: str
) -> NDArray[np.uint8]:
    """Write headings above the views, and lines beside them."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(13)
    for place, head in enumerate(heads):
        draw.text((place * _VIEW + 4, 4), head, fill="#333333", font=font)
    y, left = _HEAD + 4, _VIEWS * _VIEW
    for line in lines[:-1]:
        draw.text((left + 10, y), line, fill="black", font=font)
        y += 17
    draw.rectangle((left + 8, y + 2, left + _VIEW - 8, y + 24), fill=color)
    draw.text((left + 14, y + 5), lines[-1], fill="white", font=font)
    return np.asarray(image)
