"""Videos of episodes: views side by side, a heading above each, and text beside them."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.storage.video.encode import CLIP, VideoEncoder

from .figure import Hue

VIEW = 256
"""Side of a view, in pixels; larger images are thinned out."""

HEAD = 24
"""Height of the headings, in pixels."""

_COLORS = {"success": Hue.GREEN, "fail": Hue.VERMILION, "timeout": Hue.ORANGE, "error": "#000000"}
"""Colors of the line with the status; others are gray."""

_LETTERS = 34
"""Maximum letters in a line of text."""

_LINES = 14
"""Maximum lines of text."""


def check_pillow(what: str) -> None:
    """Check that Pillow, which writes on videos, is installed; `what` needs it, for the message."""
    try:
        import PIL  # noqa: F401
    except ImportError as error:
        raise MissingExtraError.needs(what, "pillow", "retrieval") from error


class EpisodeVideo:
    """Encodes pictures of an episode as H.264 in MP4, as they come.

    Args:
        path: The file to write.
        fps: Pictures a second.
        views: Number of views side by side.
    """

    def __init__(self, path: Path, fps: float, views: int):
        check_pillow("a video")
        self._views = views
        width = (views + 1) * VIEW  # and the text
        self._encoder = VideoEncoder(path, CLIP, fps, HEAD + VIEW, width, container="mp4")

    def add(
        self,
        views: Mapping[str, NDArray[np.uint8] | None],
        paragraphs: Iterable[str],
        ending: Sequence[str],
    ) -> None:
        """Add a picture.

        Args:
            views: Heading to image, `(H, W, 3) uint8` RGB, or None for an empty place.
            paragraphs: Text beside the views, wrapped, and cut where it does not fit.
            ending: The last lines of the text, which always fit; the last one is the status.
        """
        canvas = np.full((HEAD + VIEW, (self._views + 1) * VIEW, 3), 255, np.uint8)
        for place, image in enumerate(views.values()):
            if image is not None:
                step = -(-max(image.shape[:2]) // VIEW)  # 1 up to 256 pixels
                small = image[::step, ::step]
                left = place * VIEW
                canvas[HEAD : HEAD + small.shape[0], left : left + small.shape[1]] = small
        lines = [line for text in paragraphs for line in textwrap.wrap(text, _LETTERS) or [""]]
        # Room for an empty line and for the ending, which is never cut.
        lines = lines[: _LINES - len(ending) - 1]
        self._encoder.add(self._lettered(canvas, list(views), [*lines, "", *ending]))

    def close(self) -> None:
        """Write the end of the file."""
        self._encoder.close()

    def _lettered(
        self, canvas: NDArray[np.uint8], headings: Sequence[str], lines: Sequence[str]
    ) -> NDArray[np.uint8]:
        """Write headings above the views, and lines beside them."""
        from PIL import Image, ImageDraw, ImageFont

        image = Image.fromarray(canvas)
        draw = ImageDraw.Draw(image)
        font = ImageFont.load_default(13)
        for place, heading in enumerate(headings):
            draw.text((place * VIEW + 4, 4), heading, fill="#333333", font=font)
        y, left = HEAD + 4, self._views * VIEW
        *text, status = lines
        for line in text:
            draw.text((left + 10, y), line, fill="black", font=font)
            y += 17
        color = _COLORS.get(status, "#555555")
        draw.rectangle((left + 8, y + 2, left + VIEW - 8, y + 24), fill=color)
        draw.text((left + 14, y + 5), status, fill="white", font=font)
        return np.asarray(image)
