"""Which recorded images are exact, and how they are decoded.

A recording counts as exact only if that is certain: PNG images, or video of RGB pixels with a
lossless codec or lossless options. Converting to YUV alone already changes 8-bit RGB values.
"""

from collections.abc import Generator, Iterable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError, SourceError
from robomme_interference_data.storage.limits import MAX_RATE, MIN_RATE
from robomme_interference_data.storage.video.encode import decode_image, is_png
from robomme_interference_data.storage.video.file import open_video
from robomme_interference_data.storage.video.frames import read_times

_RGB_FORMATS = (
    "rgb24",
    "bgr24",
    "rgb0",
    "bgr0",
    "0rgb",
    "0bgr",
    "gbrp",
    # with transparency
    "rgba",
    "bgra",
    "argb",
    "abgr",
    "gbrap",
)
_LOSSLESS_CODECS = ("ffv1", "png", "rawvideo", "huffyuv", "ffvhuff", "utvideo", "qtrle")
_TRUE = ("1", "true", "yes")


@dataclass(frozen=True)
class ProbedVideo:
    """What a video file states, without decoding.

    Attributes:
        rate: Frames per second.
        count: Its frames.
        first_s: Presentation time of the first frame in seconds.
        exact: Whether codec and pixel format alone make it exact.
    """

    rate: float
    count: int
    first_s: float
    exact: bool


def probe_video(path: Path, rate: float | None = None) -> ProbedVideo:
    """Return what a video file states; `rate` is its frame rate, if that is known.

    Else the rate is one that its container states, and that its frames have.

    Raises:
        MissingFileError, FormatError: It cannot be read.
        SourceError: Its frames are not evenly spaced in time, at any of these rates.
    """
    with open_video(path) as (_, stream):
        # The basic rate is exact where containers round; of uneven frames it is far too high.
        stated = [stream.base_rate, stream.average_rate]
        lossless = stream.codec.canonical_name in _LOSSLESS_CODECS
        exact = lossless and stream.pix_fmt in _RGB_FORMATS
    if rate is None:
        # Containers store durations in whole ns or ms: 1001 is the denominator of NTSC rates.
        rates = [float(Fraction(each).limit_denominator(1001)) for each in stated if each]
        rates = [each for each in dict.fromkeys(rates) if MIN_RATE <= each <= MAX_RATE]
    else:
        rates = [rate]
    times = read_times(path)
    problem = None
    for tried in rates:
        try:
            times.first_number(tried, times.first_s)
        except FormatError as error:
            problem = error
        else:
            return ProbedVideo(tried, len(times), times.first_s, exact)
    if problem is None:
        raise SourceError(f"{path} has no frame rate", "Give it in a column fps of the table.")
    raise SourceError(
        f"{problem.message} (of {len(times)} frames, the last comes "
        f"{times.last_s - times.first_s:.4g} s after the first)",
        f"{problem.hint}\nIf they have even times already, their rate in a column fps of the table "
        "corrects the one stated.",
    )


def info_is_exact(info: dict[str, Any]) -> bool:
    """Return whether a video is exact, from its feature's `info` in LeRobot's `info.json`.

    That has `video.codec`, `video.pix_fmt` and, since LeRobot 0.4, the encoder's options
    (`video.crf`, `video.extra_options`).
    """
    if info.get("video.pix_fmt") not in _RGB_FORMATS:
        return False
    codec = info.get("video.codec")
    if codec in _LOSSLESS_CODECS:
        return True
    extra = info.get("video.extra_options")
    options = _options(extra) if isinstance(extra, dict) else {}
    if options.get("lossless") in _TRUE:
        return True
    # x264 in RGB is lossless at quantizer 0; no other encoder promises that.
    quality = options.get("qp", options.get("crf", str(info.get("video.crf"))))
    return codec == "h264" and quality in ("0", "0.0")


def _options(extra: dict[str, Any]) -> dict[str, str]:
    """Return all encoder options as one map; `aom-params` and the like are `a=1:b=2` lists."""
    options: dict[str, str] = {}
    for name, value in extra.items():
        text = str(value).lower()
        if name.endswith("-params"):
            parts = (part.partition("=") for part in text.split(":"))
            options.update((key, setting) for key, _, setting in parts)
        else:
            options[name] = text
    return options


def decode_images(
    encoded: Iterable[tuple[object, bytes]], exact: bool
) -> Generator[NDArray[np.uint8]]:
    """Decode images one by one, `(H, W, 3) uint8` RGB; `exact` ones must be PNG.

    Each comes with its location for messages.
    """
    for where, data in encoded:
        try:
            if exact and not is_png(data):
                raise FormatError(
                    "a JPEG image, although the episode counts as exact",
                    "Store images as PNG: it is exact.",
                )
            image = decode_image(data)
        except FormatError as error:
            raise error.about(where) from None
        yield image
