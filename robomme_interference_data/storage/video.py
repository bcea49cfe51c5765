"""Decode spans of frames from a video file: the only module that reads video.

A LeRobot v3 video file holds consecutive episodes at a constant frame rate, so a frame is
identified by its number in the file: its presentation time multiplied by the rate.

The samples (frames, or pieces of sound) that an MP4 file declares are bounded before FFmpeg opens
it: it makes an index of all of them, however short the file is, and 50 million took 1.2 GB. The
tables that declare them are searched for by name in everything but the frames, so that none is
missed wherever FFmpeg would find it.
"""

import os
import re
from collections import Counter
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import BinaryIO

import av
import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError, InterferenceError, MissingFileError

from .files import check_not_pointer

MAX_PIXELS = 1 << 24
"""Upper bound on the pixels of a frame: twice 3840 × 2160."""

_LATEST = 1 << 62
"""Upper bound on the ticks of a container to which FFmpeg can seek."""

_MP4 = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
"""The first box of an MP4 or QuickTime file."""

_DECODERS = (
    "libdav1d",
    "libaom-av1",
    "av1",
    "h264",
    "hevc",
    "vp8",
    "vp9",
    "mpeg4",
    "mjpeg",
    "ffv1",
    "png",
    "rawvideo",
    "huffyuv",
    "ffvhuff",
    "utvideo",
    "qtrle",
)
"""FFmpeg's decoders that are used: those of LeRobot's codecs, and lossless ones."""

_TABLES = re.compile(b"(?=(stsz|stz2|trun|elst|stsc|stco|co64|cmov|sidx))")
"""Tables of samples, of edits and of chunks, and what would hide them: compressed metadata, and an
index by which FFmpeg would jump into the frames. Names may overlap: `stco64`."""

_MAX_SAMPLES = 1 << 23  # times edits, for each of which FFmpeg goes through all of them
_MAX_IN_CHUNKS = 1 << 32  # chunks times samples of the longest: of some sound, the only number
_MAX_BOX_BYTES = 64 << 20  # the tables of some million samples


def iter_frames(
    path: Path, start: int, stop: int | None, fps: float, shape: tuple[int, ...] | None = None
) -> Generator[NDArray[np.uint8]]:
    """Decode the frames `start` to `stop` (excluded; None for all) of a video file, in order.

    Frames are `(H, W, 3) uint8` RGB; `shape` is the shape that they must have. Decoding runs on the
    calling thread and holds one frame at a time. Every frame's presentation time is checked, so
    that no frame is missing or duplicated.
    """
    expected = start
    with closing(_indexed_frames(path, start, fps, shape)) as frames:
        if stop is not None and start >= stop:
            return
        for number, frame in frames:
            if number != expected:
                what = f"frame {expected} is missing; the next frame is {number}"
                raise FormatError.damaged(path, what)
            if shape is not None:
                _check_shape(path, (frame.height, frame.width), shape)
            yield _to_rgb(path, frame)
            expected += 1
            if expected == stop:
                return
    if stop is not None or expected == start:
        frames_expected = "a frame" if stop is None else f"frames {start} to {stop - 1}"
        what = f"the video ends before frame {expected}; expected {frames_expected}"
        raise FormatError.damaged(path, what)


def _to_rgb(path: Path, frame: av.VideoFrame) -> NDArray[np.uint8]:
    try:
        # Planar RGB (the lossless codec) needs no color conversion.
        planar = frame.format.name == "gbrp"
        return frame.to_ndarray() if planar else frame.to_ndarray(format="rgb24")
    except (av.error.FFmpegError, ValueError) as error:
        raise FormatError.damaged(path, f"a frame cannot be converted to RGB: {error}") from None


def find_container(path: Path) -> str:
    """Return FFmpeg's name of a video file's container: `mp4`, `matroska` or `avi`.

    FFmpeg must not guess it: it would accept a playlist as a video, whatever the file's name.
    """
    with path.open("rb") as file:
        start = file.read(12)
    if start.startswith(b"\x1a\x45\xdf\xa3"):
        return "matroska"
    if start.startswith(b"RIFF") and start.endswith(b"AVI "):
        return "avi"
    if start[4:8] in _MP4:
        return "mp4"
    raise _unreadable(path, "no MP4, Matroska or AVI file")


def _unreadable(path: Path, why: object) -> FormatError:
    return FormatError(f"{path} is not a readable video: {why}", "Download or build it again.")


@contextmanager
def open_video(path: Path) -> Iterator[tuple[av.container.InputContainer, av.VideoStream]]:
    """Open a video file and its first video stream, before anything is decoded."""
    limits = {"max_pixels": str(MAX_PIXELS)}
    allowed = {"protocol_whitelist": "file", "codec_whitelist": ",".join(_DECODERS)}
    try:
        check_not_pointer(path)
        kind = find_container(path)
        if kind == "mp4":
            check_samples(path)
        container = av.open(str(path), format=kind, options=limits, container_options=allowed)
    except InterferenceError:
        raise
    except FileNotFoundError:
        raise MissingFileError(f"{path} does not exist") from None
    except (av.error.FFmpegError, OSError, ValueError) as error:  # ValueError: a damaged header
        raise _unreadable(path, error) from error
    with container:
        if not container.streams.video:
            raise FormatError(f"{path} holds no video stream")
        stream = container.streams.video[0]
        context = stream.codec_context
        if context is None:  # a header cut short; PyAV would crash the process
            raise _unreadable(path, "its codec is unknown")
        if context.name not in _DECODERS or not stream.time_base:
            what = f"codec {context.name}, time base {stream.time_base}"
            raise _unreadable(path, what)
        context.options = limits
        stream.thread_count = 1  # sessions are decoded in parallel
        yield container, stream


def _indexed_frames(
    path: Path, start: int, fps: float, shape: tuple[int, ...] | None
) -> Generator[tuple[int, av.VideoFrame]]:
    """Yield `(number, frame)` from frame `start` on."""
    with open_video(path) as (container, stream):
        if shape is not None:
            _check_shape(path, (stream.height, stream.width), shape)
        tick = float(stream.time_base) * fps
        if start / tick >= _LATEST:
            raise FormatError.damaged(path, f"there is no frame {start} at {fps:g} Hz")
        try:
            if start > 0:
                container.seek(round(start / tick), stream=stream, backward=True)
            first = True
            for frame in container.decode(stream):
                number = _number(path, frame, tick, fps)
                if first and number > start:
                    # The seek went too far (some muxers mark no earlier key frame): read from the
                    # beginning, which is slower and always right.
                    container.seek(0, stream=stream, backward=True)
                    for earlier in container.decode(stream):
                        number = _number(path, earlier, tick, fps)
                        if number >= start:
                            yield number, earlier
                    return
                first = False
                if number >= start:
                    yield number, frame
        except av.error.FFmpegError as error:
            raise FormatError.damaged(path, f"decoding stopped: {error}") from error


def _check_shape(path: Path, found: tuple[int, ...], shape: tuple[int, ...]) -> None:
    if found != shape[:2]:
        raise FormatError(
            f"{path}: frames have {found[1]}×{found[0]} pixels; expected {shape[1]}×{shape[0]}, as "
            "in the dataset's info.json"
        )


def _number(path: Path, frame: av.VideoFrame, tick: float, fps: float) -> int:
    if frame.pts is None:
        raise FormatError(f"{path}: a frame has no presentation time")
    position = frame.pts * tick
    number = round(position)
    if abs(position - number) > 0.1:
        raise FormatError(
            f"{path}: a frame at {position / fps:.4f} s lies between frames {int(position)} and "
            f"{int(position) + 1} at {fps:g} frames per second"
        )
    return number


def check_samples(path: Path) -> None:
    """Raise `ValueError` if an MP4 file declares more samples than any real one."""
    counts = Counter[bytes]()
    longest = 0
    with path.open("rb") as file:
        for box in _boxes_without_frames(file):
            for match in _TABLES.finditer(box):
                name = match[1]
                # Version and flags come first; before a number of sizes, also one size for all.
                start = match.start() + (12 if name in (b"stsz", b"stz2") else 8)
                count = int.from_bytes(box[start : start + 4])
                counts[name] += count
                if name == b"stsc":  # entries: first chunk, samples in each chunk, description
                    available = max(0, len(box) - start - 4) // 12
                    entries = np.frombuffer(box, ">u4", 3 * min(count, available), start + 4)
                    longest = max(longest, int(entries[1::3].max(initial=0)))
    if counts.keys() & {b"cmov", b"sidx"}:
        what = "its metadata is compressed or has a segment index"
        raise ValueError(f"{what}; convert it with ffmpeg -i OLD -c copy NEW")
    samples = counts[b"stsz"] + counts[b"stz2"] + counts[b"trun"]
    edits = counts[b"elst"]
    if samples * max(1, edits) > _MAX_SAMPLES:
        raise ValueError(f"it declares {samples} frames or samples of sound, and {edits} edits")
    chunks = counts[b"stco"] + counts[b"co64"]
    if chunks * longest > _MAX_IN_CHUNKS:
        raise ValueError(f"it declares {chunks} chunks of up to {longest} samples")


def _boxes_without_frames(file: BinaryIO) -> Iterator[bytes]:
    """Yield the outer boxes of a file, each with its header, except those of frames."""
    end = file.seek(0, os.SEEK_END)
    start = 0
    while start + 8 <= end:
        file.seek(start)
        header = file.read(16)
        size = int.from_bytes(header[:4])
        # The real size then follows, in 64 bits.
        if size == 1:
            size = int.from_bytes(header[8:])
        elif size == 0:  # up to the end of the file
            size = end - start
        if size < 8:  # where FFmpeg stops
            return
        size = min(size, end - start)
        if header[4:8] != b"mdat":
            if size > _MAX_BOX_BYTES:
                raise ValueError(f"over {_MAX_BOX_BYTES:,} bytes of metadata")
            file.seek(start)
            yield file.read(size)
        start += size
