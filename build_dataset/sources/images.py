"""Decode single images: PNG, which keeps every pixel, and JPEG, which does not."""

import av
import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError

__all__ = ["decode_image", "is_png"]

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"


def is_png(data: bytes) -> bool:
    """Tell whether an encoded image is a PNG.

    Raises:
        FormatError: It is neither PNG nor JPEG.
    """
    if data.startswith(_PNG):
        return True
    if data.startswith(_JPEG):
        return False
    raise FormatError(
        f"an image starts with the bytes {data[:8].hex(' ') or '(none)'}; expected PNG or JPEG",
        "Store images as PNG: it is exact.",
    )


def decode_image(data: bytes) -> NDArray[np.uint8]:
    """Decode a PNG or JPEG image to `(H, W, 3) uint8` RGB; transparency is left out.

    Raises:
        FormatError: It is neither, damaged, or has more than 8 bits a channel.
    """
    codec = av.CodecContext.create("png" if is_png(data) else "mjpeg", "r")
    codec.thread_count = 1
    # Without these, a PNG with a broken checksum is decoded as if nothing were wrong.
    codec.options = {"err_detect": "crccheck+explode"}
    try:
        frames = codec.decode(av.Packet(data)) + codec.decode(None)
    except (av.error.FFmpegError, ValueError) as error:
        raise FormatError(f"an image is damaged: {error}") from None
    if len(frames) != 1:
        raise FormatError(f"an image is damaged: it decodes to {len(frames)} frames")
    depth = max(component.bits for component in frames[0].format.components)
    if depth > 8:
        raise FormatError(
            f"an image has {depth} bits a channel ({frames[0].format.name}); expected 8",
            "Convert the images to 8 bits a channel.",
        )
    return frames[0].to_ndarray(format="rgb24")
