"""Side-by-side clips of rollouts: what was in the history, what the robot sees, how it went."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.buffer import Buffer
from robomme_interference_data.constants import FPS, MAX_STEPS
from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.plan import WorkItem
from robomme_interference_data.evaluate.rollout import run_rollout
from robomme_interference_data.evaluate.rows import Rollout
from robomme_interference_data.files import atomic_path
from robomme_interference_data.simulators.base import EpisodeInfo, Observation, Status
from robomme_interference_data.strip import session_colors, shown_frames

__all__ = ["VIDEO_FOLDER", "ClipWatcher", "record_rollout", "video_name"]

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


def video_name(item: WorkItem) -> str:
    """Return the path of a rollout's clip inside the run's folder."""
    episode = item.episode
    name = f"{episode.family}_{episode.split}_{episode.index}_{item.condition}.mp4"
    return f"{VIDEO_FOLDER}/{name}"


def record_rollout(config: RunConfig, item: WorkItem, out: Path, **parts: Any) -> Rollout:
    """Run a rollout and write its clip; see `run_rollout` for arguments and errors.

    Args:
        config: The run.
        item: The rollout.
        out: The run's folder.
        **parts: For `run_rollout`.
    """
    watcher = ClipWatcher(item)
    row = run_rollout(config, item, watcher=watcher, **parts)
    watcher.write(out / video_name(item))
    return row


class ClipWatcher:
    """Collects what a rollout shows, and writes it as a clip; see `rollout.Watcher`.

    Args:
        item: The rollout.
    """

    def __init__(self, item: WorkItem):
        self._item = item
        self._goal = ""
        self._history: NDArray[np.uint8] = np.zeros((_VIEW, _VIEW, 3), np.uint8)
        self._seen: list[tuple[dict[str, NDArray[np.uint8]], Status, str | None]] = []

    def begin(self, buffer: Buffer | None, first: Observation, info: EpisodeInfo) -> None:
        """Take what is known before the first step."""
        self._goal = info.goal
        if buffer is not None and len(buffer):
            self._history = history_picture(buffer)
        self._seen = [(dict(first.images), Status.ONGOING, None)]

    def step(self, observation: Observation, status: Status, subgoal: str | None) -> None:
        """Take what came of a step."""
        self._seen.append((dict(observation.images), status, subgoal))

    def write(self, path: Path) -> None:
        """Write the clip, H.264 in MP4, 10 frames a second, the end held for a second."""
        import av

        with atomic_path(path) as partial, av.open(str(partial), "w", format="mp4") as container:
            stream = container.add_stream("libx264", rate=FPS)
            stream.width, stream.height = _WIDTH, _HEIGHT
            stream.pix_fmt = "yuv420p"
            stream.options = {"crf": "23", "preset": "veryfast"}
            for number in [*range(len(self._seen)), *[len(self._seen) - 1] * _LAST]:
                frame = av.VideoFrame.from_ndarray(self.picture(number), format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())

    def picture(self, number: int) -> NDArray[np.uint8]:
        """Return the clip's picture after so many steps, `(280, 1024, 3) uint8`."""
        images, status, subgoal = self._seen[number]
        canvas = np.full((_HEIGHT, _WIDTH, 3), 255, np.uint8)
        canvas[24:, :_VIEW] = self._history
        for place, name in enumerate(("front", "wrist"), 1):
            if name in images:
                view = images[name][:_VIEW, :_VIEW]
                canvas[24 : 24 + view.shape[0], place * _VIEW : place * _VIEW + view.shape[1]] = (
                    view
                )
        episode = self._item.episode
        lines = [str(episode), f"condition {self._item.condition}", "", *_wrap(self._goal, 34)]
        if subgoal:
            lines += ["", "subgoal:", *_wrap(subgoal, 34)]
        lines += ["", f"step {number} of {MAX_STEPS}", str(status)]
        return _lettered(canvas, lines, _COLOURS[status])


def history_picture(buffer: Buffer) -> NDArray[np.uint8]:
    """Return 64 frames of a history, evenly spread, as `(256, 256, 3) uint8`.

    Each has a line under it in the colour of its session, the lesson's as in the film strip.
    """
    picture = np.full((_VIEW, _VIEW, 3), 255, np.uint8)
    colours = session_colors(buffer.sessions)
    sessions = buffer.session_index
    for place, index in enumerate(shown_frames(0, len(buffer), _COLUMNS * _COLUMNS)):
        y, x = (_THUMB * part for part in divmod(place, _COLUMNS))
        frame = buffer.frame(index, "front")
        step = frame.shape[0] // (_THUMB - 4)
        small = frame[step // 2 :: step, step // 2 :: step][: _THUMB - 4, : _THUMB - 4]
        picture[y : y + small.shape[0], x : x + small.shape[1]] = small
        picture[y + _THUMB - 4 : y + _THUMB - 1, x : x + _THUMB - 2] = _rgb(
            colours[sessions[index]]
        )
    return picture


def _lettered(canvas: NDArray[np.uint8], lines: list[str], colour: str) -> NDArray[np.uint8]:
    """Write the lines beside the views, and what the parts are above them."""
    try:
        from PIL import Image, ImageDraw, ImageFont
    except ImportError as error:
        raise MissingExtraError(
            "videos need pillow, which is not installed",
            "pip install 'robomme-interference-data[evaluate]'",
        ) from error
    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    font = ImageFont.load_default(13)
    heads = ("history given to the policy", "front", "wrist", "")
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
    import textwrap

    return textwrap.wrap(text, width)[:8]


def _rgb(colour: str) -> tuple[int, ...]:
    return tuple(int(colour[place : place + 2], 16) for place in (1, 3, 5))
