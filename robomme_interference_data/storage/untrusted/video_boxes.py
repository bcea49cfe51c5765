"""Find a video's container, and bound what an MP4 file declares, before FFmpeg opens it.

FFmpeg makes an index of all frames that an MP4 file declares, however short the file is: 50 million
of them took 1.2 GB. So the boxes that FFmpeg reads are read here first. FFmpeg gets the container's
name and must not guess it: it would accept a playlist as a video, whatever the file's name.
"""

import re
from collections import Counter
from pathlib import Path
from typing import BinaryIO

import numpy as np

from robomme_interference_data.errors import FormatError

_MP4 = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
"""The first box of an MP4 or QuickTime file."""

_CONTAINERS = re.compile(
    b"dinf|edts|free|hoov|ilst|mdia|meta|minf|moof|moov|mvex|schi|sinf|stbl|traf|trak|tref|udta"
)
"""Boxes in which FFmpeg looks for further boxes from the start; in `meta`, from `hdlr` on."""

_OTHERS = re.compile(b"iprp|jp2h|stsd|wave")
"""Boxes in which it does so after other fields: there, the names of tables are searched for."""

_TABLES = re.compile(b"stsz|stz2|trun|elst|stsc|stco|co64|cmov|sidx")
"""Tables of frames, and boxes that hide some: compressed ones, and an index of fragments, by which
FFmpeg would jump into what is not read here."""

_MAX_SAMPLES = 1 << 22  # frames and samples of sound: 38 hours at 30 frames per second
_MAX_EDITED = 1 << 23  # frames times edits: FFmpeg iterates over all frames for each edit
_MAX_UNITS = 1 << 32  # chunks times samples of the longest one
_MAX_BYTES = 64 << 20  # of the boxes that are read: those of some million frames
_MAX_BOXES = 1 << 17  # a fragmented file has about three per second
_MAX_DEPTH = 12  # FFmpeg reads eleven


def find_container(path: Path) -> str:
    """Return FFmpeg's name of a video file's container: `mp4`, `matroska` or `avi`."""
    with path.open("rb") as file:
        start = file.read(12)
        if start.startswith(b"\x1a\x45\xdf\xa3"):
            return "matroska"
        if start.startswith(b"RIFF") and start.endswith(b"AVI "):
            return "avi"
        if start[4:8] not in _MP4:
            raise unreadable(path, "no MP4, Matroska or AVI file")
        try:
            _check_declared(file)
        except ValueError as error:
            raise unreadable(path, error) from None
    return "mp4"


def unreadable(path: Path, why: object) -> FormatError:
    """Return the error for a file that is not a supported video."""
    return FormatError(f"{path} is not a readable video: {why}", "Download or build it again.")


def _check_declared(file: BinaryIO) -> None:
    """Read the boxes of an MP4 file as FFmpeg does, without the frames themselves."""
    end, start = file.seek(0, 2), 0
    tables, read = _Tables(), 0
    while start + 8 <= end:
        file.seek(start)
        head = file.read(16)
        body, stop = _box(head, 0, end - start)
        if stop < body:
            break
        if any(boxes.fullmatch(head, 4, 8) for boxes in (_CONTAINERS, _OTHERS, _TABLES)):
            read += stop
            if read > _MAX_BYTES:
                raise ValueError(f"over {_MAX_BYTES:,} bytes of metadata")
            file.seek(start)
            tables.walk(file.read(stop), 0, stop)
        tables.count_box()
        start += stop
    tables.check()


def _box(data: bytes, start: int, end: int) -> tuple[int, int]:
    """Return where the content of a box begins, and where the box ends."""
    size, body = int.from_bytes(data[start : start + 4]), start + 8
    if size == 1 and body + 8 <= end:
        size, body = int.from_bytes(data[body : body + 8]), body + 8
    return body, min(end, start + size) if size else end


class _Tables:
    """Sums of the numbers of entries that the tables of a file declare, by the tables' name."""

    def __init__(self) -> None:
        self._sums = Counter[bytes]()
        self._boxes = self._longest = 0

    def walk(self, data: bytes, start: int, end: int, depth: int = 0) -> None:
        """Read consecutive boxes and those inside them."""
        if depth > _MAX_DEPTH:
            raise ValueError("its metadata is nested too deeply")
        while start + 8 <= end:
            (body, stop), kind = _box(data, start, end), data[start + 4 : start + 8]
            if stop < body:
                return
            if _OTHERS.fullmatch(kind):
                for match in _TABLES.finditer(data, body, stop):
                    self._add(match[0], data, match.end())
            elif _CONTAINERS.fullmatch(kind):
                if kind == b"meta":
                    names = range(body, stop, 4)
                    body = next((at - 4 for at in names if data[at : at + 4] == b"hdlr"), stop)
                self.walk(data, body, stop, depth + 1)
            elif _TABLES.fullmatch(kind):
                self._add(kind, data, body)
            self.count_box()
            start = stop

    def count_box(self) -> None:
        """Count a box, and bound the time that this takes."""
        self._boxes += 1
        if self._boxes > _MAX_BOXES:
            raise ValueError(f"over {_MAX_BOXES} boxes")

    def _add(self, kind: bytes, data: bytes, at: int) -> None:
        """Add a table, which begins with version and flags, and maybe one size for all entries."""
        self.count_box()
        if kind in (b"cmov", b"sidx"):
            what = "its metadata is compressed or has a segment index"
            raise ValueError(f"{what}; convert it with ffmpeg -i OLD -c copy NEW")
        skipped = 8 if kind in (b"stsz", b"stz2") else 4
        count = int.from_bytes(data[at + skipped : at + skipped + 4])
        self._sums[kind] += count
        if kind == b"stsc":
            if self._sums[kind] > _MAX_SAMPLES:
                raise ValueError("its tables are too long")
            entries = min(count, max(0, len(data) - at - 8) // 12)
            lengths = np.frombuffer(data, ">u4", 3 * entries, at + 8)[1::3]
            self._longest = max(self._longest, int(lengths.max(initial=0)))

    def check(self) -> None:
        """Check the sums."""
        sums = self._sums
        samples, edits = sums[b"stsz"] + sums[b"stz2"] + sums[b"trun"], sums[b"elst"]
        if samples > _MAX_SAMPLES or max(1, edits) * samples > _MAX_EDITED:
            raise ValueError(f"it declares {samples} frames or samples of sound, and {edits} edits")
        if (chunks := sums[b"stco"] + sums[b"co64"]) * self._longest > _MAX_UNITS:
            raise ValueError(f"it declares {chunks} chunks of up to {self._longest} samples")
