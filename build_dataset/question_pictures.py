"""Draw the options of a question on the first live observation."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from robomme_interference_data.data.questions import LETTERS
from robomme_interference_data.schema.subgoal import Pixel

_LARGER = 3  # times: the picture of things
_OVER = 14  # pixels of the view: a letter over its thing
_APART = 40  # pixels: letters over the same thing
_TILE, _MARGIN = 480, 16  # pixels: a drawing at most; of the view, round all paths
_INK, _PAPER, _PATH = "black", "white", "#ffe800"

Spot = tuple[float, float]


def picture(view: NDArray[np.uint8], marks: Sequence[Sequence[Pixel]]) -> NDArray[np.uint8]:
    """Return an enlarged first live observation with lettered options, `(H, W, 3) uint8`.

    An option of one point has its letter over it, beside those of other options of this point.
    Options of several points are paths: each gets its own drawing. Without points, the picture is
    the view. The same view and marks give the same pixels on every machine, so that `verify` can
    compare them: Pillow draws text alike from 11.2 on.
    """
    if not all(marks):
        return _enlarged(view, 2)
    if max(map(len, marks)) == 1:
        image = Image.fromarray(_enlarged(view, _LARGER))
        draw = ImageDraw.Draw(image)
        letters: dict[Pixel, list[str]] = {}
        for letter, [point] in zip(LETTERS, marks, strict=False):
            letters.setdefault(point, []).append(letter)
        for (y, x), together in letters.items():
            above = _LARGER * (y - _OVER)
            draw.line((_LARGER * x, above, _LARGER * x, _LARGER * y), fill=_INK, width=3)
            for place, letter in enumerate(together):
                aside = _APART * (2 * place - len(together) + 1) // 2
                _letter(draw, letter, (_LARGER * x + aside, above))
        return np.asarray(image)
    top, left, side = _window(view, [point for path in marks for point in path])
    part = _enlarged(view[top : top + side, left : left + side], times := _TILE // side)
    tiles = [
        _tile(part, letter, [(times * (x - left), times * (y - top)) for y, x in path])
        for letter, path in zip(LETTERS, marks, strict=False)
    ]
    tiles += [np.full_like(tiles[0], 255)] * (len(tiles) % 2)
    rows = [np.concatenate(tiles[first : first + 2], 1) for first in range(0, len(tiles), 2)]
    return np.concatenate(rows)


def _window(view: NDArray[np.uint8], points: Sequence[Pixel]) -> tuple[int, int, int]:
    """Return top, left and side of a square of the view, with the points well inside."""
    low, high = np.min(points, 0), np.max(points, 0)
    side = min(int((high - low).max()) + 2 * _MARGIN, *view.shape[:2])
    top, left = (
        int(np.clip((a + b - side) // 2, 0, whole - side))
        for a, b, whole in zip(low, high, view.shape[:2], strict=True)
    )
    return top, left, side


def _tile(part: NDArray[np.uint8], letter: str, path: Sequence[Spot]) -> NDArray[np.uint8]:
    """Return a view with a path on it: a dot where it begins, an arrow where it ends.

    The points of a longer one are numbered, as it may come back to some.
    """
    image = Image.fromarray(part)
    draw = ImageDraw.Draw(image)
    for color, wide in ((_INK, 9), (_PATH, 5)):
        draw.line(list(path), fill=color, width=wide, joint="curve")
        _arrow(draw, path, color, wide)
        x, y = path[0]
        draw.ellipse((x - wide - 2, y - wide - 2, x + wide + 2, y + wide + 2), fill=color)
    numbers: dict[Spot, list[str]] = {}
    for number, point in enumerate(path, 1):
        numbers.setdefault(point, []).append(str(number))
    for (x, y), labels in numbers.items() if len(path) > 2 else ():
        _text(draw, ",".join(labels), (x, y - 22))
    _letter(draw, letter, (30, 30))
    draw.rectangle((0, 0, image.width - 1, image.height - 1), outline=_PAPER, width=2)
    return np.asarray(image)


def _arrow(draw: Any, points: Sequence[Spot], color: str, wide: int) -> None:
    (x0, y0), (x1, y1) = points[-2:]
    way = math.atan2(y1 - y0, x1 - x0)
    size = 2 * wide + 6
    corners = [
        (x1 + size * math.cos(way + turn), y1 + size * math.sin(way + turn))
        for turn in (0.0, 2.4, -2.4)
    ]
    draw.polygon(corners, fill=color)


def _letter(draw: Any, letter: str, at: Spot) -> None:
    x, y = at
    draw.ellipse((x - 19, y - 19, x + 19, y + 19), fill=_PAPER, outline=_INK, width=3)
    draw.text(at, letter, fill=_INK, font=ImageFont.load_default(27), anchor="mm")


def _text(draw: Any, words: str, at: Spot) -> None:
    font = ImageFont.load_default(19)
    draw.text(at, words, fill=_PAPER, font=font, anchor="mm", stroke_width=2, stroke_fill=_INK)


def _enlarged(view: NDArray[np.uint8], times: int) -> NDArray[np.uint8]:
    return np.repeat(np.repeat(view, times, 0), times, 1)
