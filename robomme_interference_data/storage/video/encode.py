"""Encode frames with PyAV, as video or PNG; decode single images."""

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import av
import numpy as np
from av.codec.codec import UnknownCodecError
from numpy.typing import NDArray

from robomme_interference_data.constants import KEY_FRAMES
from robomme_interference_data.errors import BuildError, FormatError, InvalidOptionError

from ..limits import MAX_PIXELS, MAX_RATE, MIN_RATE
from .file import file_url, reason
from .frames import rate_fraction
from .pixels import turned

_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"

# Of a chunk of a PNG file: its size and kind come before its content, a checksum after it.
_HEADER_BYTES, _CHECKSUM_BYTES = 8, 4

# Of EXIF: a tag, and the bytes of a tag's number, type, count and value.
_ORIENTATION, _ENTRY_BYTES = 0x0112, 12

_RESTORE = "Restore the image from a copy, or leave the episode out."

_AS_STORED = 1
"""The orientation of pixels that are shown as they are stored."""


@dataclass(frozen=True)
class Codec:
    """Video settings, in the terms of LeRobot's `RGBEncoderConfig`.

    `settings` are further arguments of `RGBEncoderConfig`, and `options` the same for FFmpeg; a
    test compares them. `exact` codecs are lossless. `sides` are the smallest and the largest height
    and width in pixels, `rates` the smallest and the largest number of frames per second;
    `interpolation` is that of subsampled colors, None for PyAV's.
    """

    name: str
    vcodec: str
    pix_fmt: str
    settings: Mapping[str, Any]
    options: Mapping[str, str]
    exact: bool
    sides: tuple[int, int] = (1, (1 << 16) - 1)  # MP4 has 16 bits for a side
    rates: tuple[float, float] = (MIN_RATE, MAX_RATE)
    interpolation: str | None = None


_LOSSLESS = "av1-lossless"

# The encoder's fastest mode: without loss, more effort saves bytes but changes no pixel.
_AOM_LOSSLESS = {"usage": 1, "cpu-used": 8, "row-mt": 1, "aom-params": "lossless=1"}

CODECS = {
    codec.name: codec
    for codec in (
        # Lossless in PyAV, torchcodec and browsers. Key frames are close and nothing is reordered,
        # so seeking is safe.
        Codec(
            name=_LOSSLESS,
            vcodec="libaom-av1",
            pix_fmt="gbrp",
            settings={"g": KEY_FRAMES, "crf": None, "extra_options": _AOM_LOSSLESS},
            options={"g": str(KEY_FRAMES)}
            | {name: str(value) for name, value in _AOM_LOSSLESS.items()},
            exact=True,
        ),
        Codec(
            name="lerobot-default",
            vcodec="libsvtav1",
            pix_fmt="yuv420p",
            settings={"g": 2, "crf": 30, "preset": 12},
            options={"g": "2", "crf": "30", "preset": "12", "svtav1-params": "fast-decode=0"},
            exact=False,
            sides=(64, 8704),  # SVT-AV1 crashes on some smaller frames
            rates=(1e-2, 240),
        ),
    )
}
"""The codecs that a dataset can be built with, by name."""


CLIP = Codec(
    name="clip",
    vcodec="libx264",
    pix_fmt="yuv420p",
    settings={},
    # With its macroblock tree, x264 reads uninitialized memory unless both sides are multiples of
    # 16, so that its output varies.
    options={"crf": "22", "preset": "veryfast", "x264-params": "mbtree=0"},
    exact=False,
)
"""Clips of rollouts for any player: H.264 in MP4, for even heights and widths."""

MODEL_VIDEO = replace(
    CLIP, name="model-video", options={"crf": "23", "preset": "medium"}, interpolation="BICUBIC"
)
"""Videos for models, as RoboMME's client encodes them: with the defaults of x264 and ffmpeg. For
heights and widths that are multiples of 16."""


def get_codec(name: str) -> Codec:
    """Return a codec by name."""
    if name not in CODECS:
        raise InvalidOptionError.one_of("codec", name, CODECS)
    return CODECS[name]


def _misfit(codec: Codec, fps: float, height: int, width: int) -> str | None:
    """Return why a codec cannot hold frames, or why they could not be read again; None if not."""
    least, most = codec.sides
    slowest, fastest = codec.rates
    size = f"frames of {width}×{height} pixels"
    if min(height, width) < least:
        return f"{size} are too small for {codec.name}, which needs at least {least}×{least}"
    if max(height, width) > most:
        return f"{size} are too large for {codec.name}, which holds at most {most}×{most}"
    if height * width > MAX_PIXELS:
        return f"{size} are too large; a frame has at most {MAX_PIXELS:,} pixels"
    if not slowest <= fps <= fastest:
        return f"{fps:g} frames per second do not fit {codec.name}: {slowest:g} to {fastest:g} do"
    return None


class VideoEncoder:
    """Writes frames to one video file in the calling thread, so that none is dropped.

    The container follows from the path's suffix, unless given by FFmpeg's name.
    """

    def __init__(
        self,
        path: Path,
        codec: Codec,
        fps: float,
        height: int,
        width: int,
        container: str | None = None,
    ):
        if problem := _misfit(codec, fps, height, width):
            hint = "Make the images smaller, or correct the frame rate."
            if _misfit(CODECS[_LOSSLESS], fps, height, width) is None:
                hint = f"Use the codec {_LOSSLESS!r}."
            raise BuildError(f"{path.stem}: {problem}", hint)
        self._path, self._codec = path, codec
        self._container: Any = None
        os.environ.setdefault("SVT_LOG", "1")  # errors only: SVT-AV1 prints its settings otherwise
        rate = rate_fraction(fps)
        with self._errors():
            # Omits FFmpeg's version.
            self._container = av.open(
                file_url(path), "w", format=container, container_options={"fflags": "+bitexact"}
            )
            self._stream = self._container.add_stream(
                codec.vcodec, rate=rate, options=dict(codec.options)
            )
        self._stream.pix_fmt = codec.pix_fmt
        self._stream.height = height
        self._stream.width = width
        self._stream.codec_context.thread_count = 1  # episodes are encoded in parallel
        self._time_base = 1 / rate
        self._stream.time_base = self._time_base
        self._count = 0

    def add(self, image: NDArray[np.uint8]) -> None:
        """Encode the next frame, `(H, W, 3) uint8` RGB."""
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        if self._codec.interpolation is not None:
            frame = frame.reformat(
                format=self._codec.pix_fmt, interpolation=self._codec.interpolation
            )
        frame.pts = self._count
        frame.time_base = self._time_base
        with self._errors():
            self._container.mux(self._stream.encode(frame))
        self._count += 1

    def close(self) -> None:
        """Flush the encoder and close the file."""
        with self._errors():
            self._container.mux(self._stream.encode(None))
            self._container.close()

    def abandon(self) -> None:
        """Close the unfinished file; what goes wrong then does not matter."""
        # Otherwise PyAV closes it during garbage collection, and prints the error there.
        with suppress(av.error.FFmpegError):
            self._container.close()

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (av.error.FFmpegError, UnknownCodecError) as error:
            if self._container is not None:
                self.abandon()
            hint = "Check the free disk space." if isinstance(error, OSError) else None
            what = f"the video cannot be written: {reason(error)}"
            raise BuildError(f"{self._path}: {what}", hint) from error


def png(image: NDArray[np.uint8]) -> bytes:
    """Encode an image, `(H, W, 3) uint8` RGB, as PNG."""
    height, width, _ = image.shape
    encoder = av.CodecContext.create("png", "w")
    encoder.width, encoder.height, encoder.pix_fmt = width, height, "rgb24"
    # None flushes the encoder, which may hold the picture back.
    packets = [*encoder.encode(av.VideoFrame.from_ndarray(image, "rgb24")), *encoder.encode(None)]
    return b"".join(map(bytes, packets))


def is_png(data: bytes) -> bool:
    """Return whether an encoded image is PNG, and not JPEG."""
    if data.startswith(_PNG):
        return True
    if data.startswith(_JPEG):
        return False
    raise FormatError(
        f"an image starts with the bytes {data[:8].hex(' ') or '(none)'}; expected PNG or JPEG",
        "Store images as PNG, which is lossless.",
    )


def decode_image(data: bytes) -> NDArray[np.uint8]:
    """Decode a PNG or JPEG image to `(H, W, 3) uint8` RGB, without transparency.

    A JPEG image is turned as its EXIF states; no pixel changes by that.

    Raises:
        FormatError: It is damaged, has more than 8 bits a channel, or is a PNG image to be turned.
    """
    if is_png(data) and (orientation := _png_orientation(data)) != _AS_STORED:
        raise FormatError(
            f"a PNG image is to be shown turned (EXIF orientation {orientation})",
            "Write it without EXIF: with Pillow, ImageOps.exif_transpose(image).save(file).",
        )
    codec = av.CodecContext.create("png" if is_png(data) else "mjpeg", "r")
    codec.thread_count = 1
    # By default, FFmpeg accepts a PNG with a wrong checksum.
    codec.options = {"err_detect": "crccheck+explode", "max_pixels": str(MAX_PIXELS)}
    try:
        frames = codec.decode(av.Packet(data)) + codec.decode(None)
    except (av.error.FFmpegError, ValueError) as error:
        raise FormatError(f"an image is damaged: {error}", _RESTORE) from None
    if len(frames) != 1:
        what = f"an image is damaged: it decodes to {len(frames)} frames"
        raise FormatError(what, _RESTORE)
    depth = max(component.bits for component in frames[0].format.components)
    if depth > 8:
        raise FormatError(
            f"an image has {depth} bits a channel ({frames[0].format.name}); expected 8",
            "Convert the images to 8 bits a channel.",
        )
    return turned(frames[0].to_ndarray(format="rgb24"), frames[0])


def _png_orientation(data: bytes) -> int:
    """Return the orientation of a PNG image, from 1 to 8 as in EXIF; 1 if it states none."""
    start = len(_PNG)
    while start + _HEADER_BYTES <= len(data):
        size = int.from_bytes(data[start : start + 4])
        content = start + _HEADER_BYTES
        if data[start + 4 : content] == b"eXIf":
            return _orientation(data[content : content + size])
        start = content + size + _CHECKSUM_BYTES
    return _AS_STORED


def _orientation(exif: bytes) -> int:
    """Return the orientation in a block of EXIF, which is a TIFF file without an image."""
    order: Literal["little", "big"] = "little" if exif.startswith(b"II") else "big"

    def number(start: int, size: int) -> int:
        return int.from_bytes(exif[start : start + size], order)

    first = number(4, 4)
    for entry in range(number(first, 2)):
        start = first + 2 + _ENTRY_BYTES * entry
        if number(start, 2) == _ORIENTATION:
            value = number(start + 8, 2)
            return value if 1 <= value <= 8 else _AS_STORED
    return _AS_STORED
