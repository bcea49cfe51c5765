"""Turn decoded frames of a video into RGB images, as the file states: colors and rotation."""

import av
import numpy as np
from av.sidedata.sidedata import Type
from av.video.reformatter import ColorRange, Colorspace
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError

_MATRICES = {
    1: "BT.709",
    2: "not stated",
    4: "FCC",
    5: "BT.601 (BT.470 B, G)",
    6: "BT.601 (SMPTE 170M)",
    7: "SMPTE 240M",
    9: "BT.2020",
}
"""Matrices from YUV to RGB that are known, by FFmpeg's number (and that of ISO/IEC 23091-2)."""

_NOT_STATED = 2

_FULL_RANGE = np.clip(np.rint((np.arange(256) - 16) * 255 / 219), 0, 255).astype(np.uint8)
"""Gray of the limited range, in the full one; swscale does not convert it."""

_ONE = 1 << 16
"""1 in the display matrix of a container, which has fixed-point numbers."""

_REWRITE = "Write the video again: ffmpeg -i OLD -c:v ffv1 -pix_fmt bgr0 NEW.mkv"


def to_rgb(frame: av.VideoFrame) -> NDArray[np.uint8]:
    """Return a decoded frame as it is to be shown, `(H, W, 3) uint8` RGB.

    YUV is converted with the matrix and the range (full or limited) that the stream states. Where
    it states none, BT.601 and the limited range are assumed, as FFmpeg's swscale and LeRobot do; of
    gray pictures and MJPEG, the full range. Where the container states a rotation by a multiple of
    90°, or a mirror image, it is applied; no pixel changes by that.

    Raises:
        FormatError: The matrix is unknown, or the rotation is another one.
    """
    try:
        pixels = _convert(frame)
    except FormatError:
        raise
    except (av.error.FFmpegError, ValueError) as error:
        what = f"a frame cannot be converted to RGB: {error}"
        raise FormatError(what, _REWRITE) from None
    return turned(pixels, frame)


def turned(pixels: NDArray[np.uint8], frame: av.VideoFrame) -> NDArray[np.uint8]:
    """Return the pixels of a decoded frame, turned or mirrored as the frame states: see `turn`."""
    shown = frame.side_data.get(Type.DISPLAYMATRIX)
    if shown is None:
        return pixels
    return turn(pixels, np.frombuffer(bytes(shown), np.int32).reshape(3, 3))


def _convert(frame: av.VideoFrame) -> NDArray[np.uint8]:
    kind = frame.format
    # Planar RGB (the lossless codec) needs no color conversion.
    if kind.name == "gbrp":
        return frame.to_ndarray()
    if kind.is_rgb or kind.has_palette:
        return frame.to_ndarray(format="rgb24")
    if len(kind.components) < 3:
        gray = frame.to_ndarray(format="rgb24")
        return _FULL_RANGE[gray] if frame.color_range == ColorRange.MPEG else gray
    matrix = frame.colorspace
    if matrix not in _MATRICES:
        known = ", ".join(_MATRICES.values())
        raise FormatError(
            f"the colors have the matrix number {matrix} of ISO/IEC 23091-2; known are {known}",
            _REWRITE,
        )
    if matrix == _NOT_STATED:
        matrix = Colorspace.ITU601.value
    full = frame.color_range == ColorRange.JPEG or kind.name.startswith("yuvj")
    # PyAV ignores what the frame states, unless the source and the target differ.
    return frame.reformat(
        format="rgb24",
        src_colorspace=matrix,
        dst_colorspace=Colorspace.ITU601,
        src_color_range=ColorRange.JPEG if full else ColorRange.MPEG,
    ).to_ndarray()


def turn(pixels: NDArray[np.uint8], matrix: NDArray[np.int32]) -> NDArray[np.uint8]:
    """Turn or mirror an image as a container's display matrix states.

    Args:
        pixels: `(H, W, 3) uint8`.
        matrix: `(3, 3) int32`. A pixel in column `x` and row `y` is shown in column
            `x * matrix[0, 0] + y * matrix[1, 0]` and row `x * matrix[0, 1] + y * matrix[1, 1]`, in
            units of 1/65536, plus an offset that has no meaning for a single image.

    Returns:
        `(H, W, 3)` or `(W, H, 3) uint8`.

    Raises:
        FormatError: The matrix scales, or turns by no multiple of 90°.
    """
    (a, b, u), (c, d, v) = matrix[:2].tolist()
    sides = [abs(a), abs(b), abs(c), abs(d)]
    if (u, v) != (0, 0) or sides not in ([_ONE, 0, 0, _ONE], [0, _ONE, _ONE, 0]):
        numbers = ", ".join(f"{number / _ONE:g}" for number in (a, b, c, d))
        raise FormatError(
            f"the video is to be shown with the display matrix ({numbers}), which is no rotation "
            "by a multiple of 90° and no mirror image",
            _REWRITE,
        )
    if a == 0:
        pixels = pixels.swapaxes(0, 1)
    left, up = a + c < 0, b + d < 0
    if left:
        pixels = pixels[:, ::-1]
    if up:
        pixels = pixels[::-1]
    return np.ascontiguousarray(pixels)
