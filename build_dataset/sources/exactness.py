"""Tell from a video's codec, pixel format and encoder options whether it kept every pixel.

A recording counts as exact only where that is certain: RGB pixels and a codec, or options, that
lose nothing. Converting to YUV alone already changes 8-bit RGB values.
"""

from pathlib import Path
from typing import Any

import av

from robomme_interference_data.errors import SourceError

__all__ = ["VideoStream", "info_is_exact", "probe_video", "stream_is_exact"]

_RGB_FORMATS = (
    *("rgb24", "bgr24", "rgb0", "bgr0", "0rgb", "0bgr", "gbrp"),
    *("rgba", "bgra", "argb", "abgr", "gbrap"),
)
_LOSSLESS_CODECS = ("ffv1", "png", "rawvideo", "huffyuv", "ffvhuff", "utvideo", "qtrle")
_TRUE = ("1", "true", "yes")


class VideoStream:
    """What the header of a video file says.

    Attributes:
        codec: Canonical codec name, such as `ffv1`.
        pixel_format: Such as `gbrp`, or None if the container does not say.
        rate: Frames per second, or None if the container does not say.
        size: `(height, width)` in pixels.
    """

    def __init__(self, stream: "av.VideoStream"):
        self.codec: str = stream.codec.canonical_name
        self.pixel_format: str | None = stream.pix_fmt
        rate = stream.average_rate or stream.base_rate
        self.rate: float | None = float(rate) if rate else None
        self.size: tuple[int, int] = (stream.height, stream.width)


def probe_video(path: Path) -> VideoStream:
    """Read the header of a video file.

    Raises:
        SourceError: It is not a video.
    """
    try:
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            if stream.codec_context is None:  # a header cut short; PyAV would crash the process
                raise ValueError("its codec is not known")
            return VideoStream(stream)
    except (av.error.FFmpegError, OSError, IndexError, ValueError) as error:
        raise SourceError(
            f"{path} is not a readable video: {error}",
            "Write it again, for example with codec ffv1 in a .mkv file.",
        ) from None


def stream_is_exact(stream: VideoStream) -> bool:
    """Tell whether a codec and pixel format alone make a video exact."""
    return stream.codec in _LOSSLESS_CODECS and stream.pixel_format in _RGB_FORMATS


def info_is_exact(info: dict[str, Any]) -> bool:
    """Tell whether a video is exact by what LeRobot's `info.json` says of it.

    Args:
        info: The feature's `info`: `video.codec`, `video.pix_fmt` and, since LeRobot 0.4, the
            encoder's options (`video.crf`, `video.extra_options`).
    """
    if info.get("video.pix_fmt") not in _RGB_FORMATS:
        return False
    codec = info.get("video.codec")
    if codec in _LOSSLESS_CODECS:
        return True
    options = _options(info.get("video.extra_options") or {})
    if options.get("lossless") in _TRUE:
        return True
    # x264 in RGB is lossless at quantizer 0; no other encoder promises that.
    quality = options.get("qp", options.get("crf", str(info.get("video.crf"))))
    return codec == "h264" and quality in ("0", "0.0")


def _options(extra: dict[str, Any]) -> dict[str, str]:
    """Return all encoder options as one map; `aom-params` and the like are `a=1:b=2` lists."""
    found: dict[str, str] = {}
    for name, value in extra.items():
        text = str(value).lower()
        if name.endswith("-params"):
            parts = (part.partition("=") for part in text.split(":"))
            found.update((key, setting) for key, _, setting in parts)
        else:
            found[name] = text
    return found
