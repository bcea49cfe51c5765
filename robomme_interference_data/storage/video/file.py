"""Open video files, which are not trusted: the only module that does.

The samples (frames, or pieces of sound) that an MP4 file declares are bounded before FFmpeg opens
it: it makes an index of all of them, however short the file is, and 50 million took 1.2 GB. The
tables that declare them are searched for by name in everything but the frames, so that none is
missed wherever FFmpeg would find it.
"""

import os
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import av
import numpy as np

from robomme_interference_data.errors import FormatError, InterferenceError, MissingFileError

from ..limits import MAX_PIXELS
from ..text import check_not_pointer

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

REWRITE = "Write it again: ffmpeg -i OLD -c:v ffv1 NEW.mkv"
"""What to do about a video that cannot be read as it is."""

_TABLES = re.compile(b"(?=(stsz|stz2|trun|elst|stsc|stco|co64|cmov|sidx))")
"""Tables of samples, of edits and of chunks, and what would hide them: compressed metadata, and an
index by which FFmpeg would jump into the frames. Names may overlap: `stco64`."""

_MAX_SAMPLES = 1 << 23  # times edits, for each of which FFmpeg goes through all of them
_MAX_IN_CHUNKS = 1 << 32  # chunks times samples of the longest: of some sound, the only number
_MAX_BOX_BYTES = 64 << 20  # the tables of some million samples


def file_url(path: Path) -> str:
    """Return a path as FFmpeg opens it: in a bare path, it takes what precedes a colon for a
    protocol.
    """
    return f"file:{path}"


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
        container = av.open(file_url(path), format=kind, options=limits, container_options=allowed)
    except InterferenceError:  # a missing file that is a Git LFS pointer is a FileNotFoundError
        raise
    except FileNotFoundError:
        raise MissingFileError(f"{path} does not exist") from None
    except (av.error.FFmpegError, ValueError) as error:  # ValueError: a damaged header
        raise FormatError.damaged(path, f"not a readable video: {reason(error)}") from error
    except OSError as error:
        hint = "Give a file that you are allowed to read."
        raise FormatError(f"{path} cannot be read: {reason(error)}", hint) from error
    with container:
        if not container.streams.video:
            raise FormatError(f"{path} holds no video stream", "Give a file that shows pictures.")
        stream = container.streams.video[0]
        context = stream.codec_context
        # Of a header that is cut short; PyAV would crash the process.
        if context is None:
            raise FormatError.damaged(path, "the codec of the video is unknown")
        if context.name not in _DECODERS:
            what = f"its codec {context.name} is none of those read: {', '.join(_DECODERS)}"
            raise FormatError(f"{path} is not a readable video: {what}", REWRITE)
        if not stream.time_base:
            raise FormatError.damaged(path, f"the time base is {stream.time_base}")
        context.options = limits
        stream.thread_count = 1  # sessions are decoded in parallel
        yield container, stream


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
    if not start:
        raise FormatError.damaged(path, "the file is empty")
    raise FormatError(
        f"{path} is not a readable video: no MP4, Matroska or AVI file",
        "Convert it, if it is a video: ffmpeg -i OLD -c copy NEW.mkv",
    )


def reason(error: Exception) -> str:
    """Return what FFmpeg or the system reports, without the file's name."""
    return getattr(error, "strerror", None) or str(error)


def check_samples(path: Path) -> None:
    """Raise `FormatError` if an MP4 file declares more samples than any real one."""
    counts = Counter[bytes]()
    longest = 0
    with path.open("rb") as file:
        for box in _boxes_without_frames(path, file):
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
        raise _unreadable(path, "its metadata is compressed or has a segment index")
    samples = counts[b"stsz"] + counts[b"stz2"] + counts[b"trun"]
    edits = counts[b"elst"]
    if samples * max(1, edits) > _MAX_SAMPLES:
        raise _unreadable(
            path, f"it declares {samples} frames or samples of sound, and {edits} edits"
        )
    chunks = counts[b"stco"] + counts[b"co64"]
    if chunks * longest > _MAX_IN_CHUNKS:
        raise _unreadable(path, f"it declares {chunks} chunks of up to {longest} samples")


def _unreadable(path: Path, why: str) -> FormatError:
    hint = "Write its metadata again: ffmpeg -i OLD -c copy NEW.mp4"
    return FormatError(f"{path} is not a readable video: {why}", hint)


def _boxes_without_frames(path: Path, file: BinaryIO) -> Iterator[bytes]:
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
                raise _unreadable(path, f"over {_MAX_BOX_BYTES:,} bytes of metadata")
            file.seek(start)
            yield file.read(size)
        start += size
