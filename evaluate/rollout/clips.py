"""Clips of rollouts: the lesson, the received history and the live observations, side by side."""

import traceback
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack, closing, suppress
from functools import wraps
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import MAX_STEPS
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.errors import counted
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.sampling import spread
from robomme_interference_data.schema.subgoal import Pixel, Subgoal
from robomme_interference_data.simulators.episode import EpisodeInfo, Observation
from robomme_interference_data.viz.buffer_page import RetrievedPart, write_page
from robomme_interference_data.viz.episode_video import VIEW, EpisodeVideo
from robomme_interference_data.viz.filmstrip import session_colors

_LIVE_CAMERAS = 2  # that are shown
_COLUMNS = 8
_THUMB = VIEW // _COLUMNS
_SMALL = _THUMB - 4  # side of a frame, above the line of its session


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
                    clip._resources.close()

    return attempt


class Clip:
    """Draws and encodes a rollout at the pace of its recordings; `data` is the closed MP4 file.

    Beside it, `page` is the web page of the buffer that the rollout received, with the received
    part; None without a history. A fault in the clip does not break the rollout: `problem` has its
    traceback, and `data` is None.
    """

    def __init__(self, item: WorkItem, system: str, folder: str | None = None):
        self._folder = folder
        self.data: bytes | None = None
        self.page: bytes | None = None
        self.problem: str | None = None
        self._heading = (system, str(item.episode), f"condition {item.condition}")
        self._goal = ""
        self._fps = 1.0
        self._history = "no history"  # heading of its picture
        self._history_picture: NDArray[np.uint8] | None = None
        self._lesson: Iterator[NDArray[np.uint8]] = iter(())
        self._lesson_frame: NDArray[np.uint8] | None = None
        self._live: dict[str, NDArray[np.uint8]] = {}
        self._cameras: list[str] = []
        self._pointed = ""  # the camera that the points of subgoals are in
        self._subgoal: Subgoal | None = None
        self._steps = 0
        self._resources = ExitStack()
        self._path = Path()
        self._video: EpisodeVideo | None = None

    @_harmless
    def begin(
        self,
        buffer_set: BufferSet,
        buffer: Buffer,
        received: Sequence[int],
        first: Observation,
        info: EpisodeInfo,
    ) -> None:
        """Draw the first picture, with the history frames that were received."""
        self._goal, self._fps = info.goal, buffer.query.dataset.fps
        if received:
            self._history = f"history given: {counted(len(received), 'frame')}"
        self._history_picture = history_picture(buffer, received)
        self._cameras = sorted(first.images)[:_LIVE_CAMERAS]
        self._pointed = buffer.query.dataset.camera()
        self._lesson = self._resources.enter_context(closing(_lesson_of(buffer)))
        self._show(first)
        folder = self._resources.enter_context(TemporaryDirectory(dir=self._folder))
        self._path = Path(folder) / "clip.mp4"
        self._video = EpisodeVideo(self._path, self._fps, 2 + _LIVE_CAMERAS)
        self._draw(Status.ONGOING)
        if len(buffer) and self._pointed in first.images:
            buffer.fetch([self._pointed])
            page = Path(folder) / "buffer.html"
            live = {self._pointed: first.images[self._pointed]}
            write_page(buffer_set, buffer, page, live, _received_part(buffer, received))
            self.page = page.read_bytes()

    @_harmless
    def step(self, observation: Observation, status: Status, subgoal: Subgoal | None) -> None:
        """Draw a step, with the images of two cameras, and its subgoal."""
        if self._video is not None:
            self._steps += 1
            self._subgoal = subgoal
            self._show(observation)
            self._draw(status)

    @_harmless
    def close(self, status: Status, error: str | None = None) -> None:
        """Show the end for a second, and close the clip, if it began."""
        if self._video is not None:
            for _ in range(max(1, round(self._fps))):
                self._draw(status, error)
            self._video.close()
            self.data = self._path.read_bytes()
            self._resources.close()

    def _show(self, observation: Observation) -> None:
        """Set the live observations, and the lesson's next frame, if it has one."""
        self._live |= observation.images
        self._lesson_frame = next(self._lesson, self._lesson_frame)

    def _draw(self, status: Status, error: str | None = None) -> None:
        """Add the current picture, `(280, 1280, 3) uint8`, to the video."""
        lesson = "no lesson" if self._lesson_frame is None else "lesson"
        views = {lesson: self._lesson_frame, self._history: self._history_picture}
        for camera in self._cameras:
            views[camera] = self._live.get(camera)
        pointed = views.get(self._pointed)
        if self._subgoal is not None and pointed is not None:
            views[self._pointed] = _with_crosses(pointed, self._subgoal.points)
        text = [*self._heading, "", self._goal]
        if self._subgoal is not None:
            text += ["", "subgoal:", self._subgoal.simple]
        if error:
            text += ["", "error:", error]
        if self._video is not None:
            self._video.add(views, text, (f"step {self._steps} of {MAX_STEPS}", str(status)))


def _received_part(buffer: Buffer, received: Sequence[int]) -> list[RetrievedPart]:
    """Return what a retrieval step passed on; nothing if all frames were received."""
    if len(received) == len(buffer):
        return []
    lesson = sum(
        session.start <= frame < session.stop
        for frame in received
        for session in buffer.sessions
        if session.role == "lesson"
    )
    grade = f"{lesson} of {counted(len(received), 'frame')} are of the lesson"
    return [RetrievedPart("the retrieval step of this rollout", received, grade)]


def _lesson_of(buffer: Buffer) -> Generator[NDArray[np.uint8]]:
    """Yield the frames of a buffer's lesson, `(H, W, 3) uint8`, of the first camera."""
    camera = buffer.query.dataset.camera()
    lessons = [session for session in buffer.sessions if session.role == "lesson"]
    indices = [index for session in lessons for index in range(session.start, session.stop)]
    for chunk in buffer.stream(1, (camera,), indices, other_states="omit"):
        yield chunk.frames[camera][0]


def _with_crosses(view: NDArray[np.uint8], points: Sequence[Pixel]) -> NDArray[np.uint8]:
    """Return a view with marked points, in black and white: visible on any background."""
    marked = view.copy()
    for y, x in points:
        for wide, shade in ((2, 255), (1, 0)):
            marked[max(y - 5, 0) : y + 6, max(x - wide + 1, 0) : x + wide] = shade
            marked[max(y - wide + 1, 0) : y + wide, max(x - 5, 0) : x + 6] = shade
    return marked


def history_picture(buffer: Buffer, received: Sequence[int]) -> NDArray[np.uint8]:
    """Return 64 evenly spread history frames, `(256, 256, 3) uint8`, underlined by session."""
    picture = np.full((VIEW, VIEW, 3), 255, np.uint8)
    colors, sessions = session_colors(buffer.sessions), buffer.session_index
    camera = buffer.query.dataset.camera()
    for place, number in enumerate(spread(0, len(received), _COLUMNS * _COLUMNS)):
        index = received[number]
        y, x = (_THUMB * part for part in divmod(place, _COLUMNS))
        frame = buffer.frame(index, camera)
        step = max(1, frame.shape[0] // _SMALL)
        small = frame[step // 2 :: step, step // 2 :: step][:_SMALL, :_SMALL]
        picture[y : y + small.shape[0], x : x + small.shape[1]] = small
        color = bytes.fromhex(colors[sessions[index]][1:])
        picture[y + _SMALL : y + _THUMB - 1, x : x + _THUMB - 2] = tuple(color)
    return picture
