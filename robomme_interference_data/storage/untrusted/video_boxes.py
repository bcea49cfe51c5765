"""What a video file declares, looked at before FFmpeg opens it: which container, how many frames.

FFmpeg makes an index of all frames that an MP4 file declares, however short the file is: 50 million
of them took 1.2 GB. And it takes a playlist for a video, whatever its name ends with.
"""

import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

from robomme_interference_data.errors import FormatError

_MP4 = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
"""What an MP4 or QuickTime file begins with, after four bytes."""

_MOST_SAMPLES = 1 << 22
"""Frames and pieces of sound that a file may declare: 38 hours at 30 frames per second."""

_MOST_EDITED = 1 << 23
"""Frames times edits of them, at most: FFmpeg goes over all frames for each edit."""

_MOST_UNITS = 1 << 32
"""Sound samples in all pieces, at most: a day of them."""

_MOST_INDEX = 64 << 20
"""Bytes beside the frames themselves, at most: those of some million frames."""

_MOST_BOXES = 1 << 17
"""Parts of a file, and tables, at most: writers of fragments make three a second or so."""

_TABLE = re.compile(rb"stsz|stz2|trun|elst|stsc|stco|co64|cmov")


def find_container(path: Path) -> str:
    """Return FFmpeg's name of a video file's container: `mp4`, `matroska` or `avi`.

    Raises:
        FormatError: It is none of these, or declares more than is read.
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        start = file.read(12)
        if start.startswith(b"\x1a\x45\xdf\xa3"):
            return "matroska"
        if start.startswith(b"RIFF") and start.endswith(b"AVI "):
            return "avi"
        if start[4:8] not in _MP4:
            raise unreadable(path, "no MP4, Matroska or AVI file")
        try:
            _check_declared(_described(file))
        except ValueError as error:
            raise unreadable(path, error) from None
    return "mp4"


def unreadable(path: Path, why: object) -> FormatError:
    """Return the error for a file that is no video, or none that is read."""
    return FormatError(f"{path} is not a readable video: {why}", "Download or build it again.")


def _described(file: BinaryIO) -> bytes:
    """Return all of an MP4 file but the frames themselves."""
    end, place = file.seek(0, 2), 0
    found: list[bytes] = []
    total = 0
    for _ in range(_MOST_BOXES):
        if place >= end:
            return b"".join(found)
        file.seek(place)
        head = file.read(16)
        size, kind = int.from_bytes(head[:4]), head[4:8]
        if size == 1:
            size = int.from_bytes(head[8:])
        # Of a box that is cut short or has no size, the rest of the file is looked at.
        size = size if 8 <= size <= end - place else end - place
        if kind != b"mdat":
            total += size
            if total > _MOST_INDEX:
                raise ValueError(f"over {_MOST_INDEX:,} bytes that describe it")
            file.seek(place)
            found.append(file.read(size))
        place += size
    raise ValueError(f"over {_MOST_BOXES} parts")


def _check_declared(described: bytes) -> None:
    """Add up what tables declare, wherever they stand: FFmpeg finds them in many places."""
    samples = edits = chunks = runs = most = 0
    for count, match in enumerate(_TABLE.finditer(described), 1):
        # After four letters a version and flags, and in tables of sizes one size for all.
        at = match.end()
        first, second = (int.from_bytes(described[at + skip : at + skip + 4]) for skip in (4, 8))
        if match[0] in (b"stsz", b"stz2"):
            samples += second
        elif match[0] == b"trun":
            samples += first
        elif match[0] == b"elst":
            edits += first
        elif match[0] in (b"stco", b"co64"):
            chunks += first
        elif match[0] == b"stsc":
            runs += first
            there = min(first, max(0, len(described) - at - 8) // 12)
            if there:
                told = np.frombuffer(described, ">u4", 3 * there, at + 8)[1::3]
                most = max(most, int(told.max()))
        else:
            raise ValueError("its description is compressed")
        if count > _MOST_BOXES or runs > _MOST_SAMPLES:
            raise ValueError("its description has too many tables")
    if samples > _MOST_SAMPLES or max(1, edits) * samples > _MOST_EDITED:
        raise ValueError(f"it declares {samples} frames and {edits} edits of them")
    if chunks * most > _MOST_UNITS:
        raise ValueError(f"it declares {chunks} pieces of up to {most} samples")
