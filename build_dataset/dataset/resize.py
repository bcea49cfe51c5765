"""Resize recorded frames while they are stored, so that recordings of several robots fit a set."""

import re
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError, named
from robomme_interference_data.storage.resize import resize_image

CROP, PAD = "crop", "pad"

_FORM = re.compile(r"([1-9][0-9]{0,3})x([1-9][0-9]{0,3})(?::(crop|pad))?", re.ASCII)


@dataclass(frozen=True)
class Resize:
    """The size of stored frames; `str()` is its one spelling, such as `256x256:pad`.

    Attributes:
        width: Width in pixels.
        height: Height in pixels.
        mode: For frames of another aspect ratio: `crop` covers the size and cuts off what is
            outside, `pad` shows all of the frame between black bars, both centered. None: such
            frames are an error.
    """

    width: int
    height: int
    mode: str | None = None

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `WIDTHxHEIGHT`, `WIDTHxHEIGHT:crop` or `WIDTHxHEIGHT:pad`.

        Raises:
            InvalidOptionError: The text is none of these, or a side is not 1 to 9999 pixels.
        """
        match = _FORM.fullmatch(text)
        if match is None:
            raise InvalidOptionError.expected(
                "resize", text, "WIDTHxHEIGHT in pixels, such as 256x192, 256x256:crop or :pad"
            )
        return cls(int(match[1]), int(match[2]), match[3])

    def __str__(self) -> str:
        size = f"{self.width}x{self.height}"
        return size if self.mode is None else f"{size}:{self.mode}"

    def apply(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return a frame, `(H, W, 3) uint8`, in this size, `(height, width, 3) uint8`.

        A frame that has the size is returned unchanged. For example, 640x480 to 256x256: `crop`
        scales it to 341x256 and cuts off 42 columns on the left and 43 on the right; `pad` scales
        it to 256x192 and adds 32 black rows above and 32 below.

        Raises:
            InvalidOptionError: The frame has another aspect ratio, and there is no mode.
        """
        height, width = image.shape[:2]
        across, down = self.width * height, self.height * width  # equal in an equal aspect ratio
        if across == down:
            return resize_image(image, self.width, self.height)
        if self.mode is None:
            size = f"{self.width}x{self.height}"
            raise InvalidOptionError(
                f"the recorded frames have {width}x{height} pixels; {named('resize', str(self))} "
                "has another aspect ratio",
                f"Set {size}:crop to cut off what is outside, {size}:pad to add black bars, or a "
                "size of the same aspect ratio.",
                option="resize",
            )
        # Which side is scaled to its length; the other one becomes longer, or shorter, than it.
        by_width = (across > down) is (self.mode == CROP)
        if by_width:
            scaled = self.width, max(1, _rounded(self.width * height, width))
        else:
            scaled = max(1, _rounded(self.height * width, height)), self.height
        resized = resize_image(image, *scaled)
        if self.mode == CROP:
            left, top = (scaled[0] - self.width) // 2, (scaled[1] - self.height) // 2
            return np.ascontiguousarray(resized[top : top + self.height, left : left + self.width])
        left, top = (self.width - scaled[0]) // 2, (self.height - scaled[1]) // 2
        padded = np.zeros((self.height, self.width, 3), np.uint8)
        padded[top : top + scaled[1], left : left + scaled[0]] = resized
        return padded


def _rounded(dividend: int, divisor: int) -> int:
    """Return a quotient as the nearest integer, halves up."""
    return (2 * dividend + divisor) // (2 * divisor)
