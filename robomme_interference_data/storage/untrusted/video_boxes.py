"""What an MP4 file declares, looked at before FFmpeg opens it, and which container a video is in.

FFmpeg makes an index of all frames that an MP4 file declares, however short the file is: 50 million
of them took 1.2 GB. So the boxes that FFmpeg would read are read here first. FFmpeg is told the
container, and guesses none: it would take a playlist for a video, whatever its name ends with.
"""

import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

from robomme_interference_data.errors import FormatError

_MP4 = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide")
"""What an MP4 or QuickTime file begins with, after four bytes."""

_CONTAINERS = re.compile(
    b"dinf|edts|free|hoov|ilst|mdia|meta|minf|moof|moov|mvex|schi|sinf|stbl|traf|trak|tref|udta"
)
"""Boxes in which FFmpeg looks for further boxes from the start; of `meta`, from `hdlr` on."""

_OTHERS = re.compile(b"iprp|jp2h|stsd|wave")
"""Those in which it does so behind fields of their own: names of tables are looked for anywhere."""

_TABLES = re.compile(b"stsz|stz2|trun|elst|stsc|stco|co64|stts|hdlr|cmov")

_OF_SOUND = {b"soun", b"alis", b"url "}
"""Handlers of a track of sound, and of where its samples lie."""

_MOST_SAMPLES = 1 << 22
"""Frames and pieces of sound that a file may declare: 38 hours at 30 frames per second."""

_MOST_EDITED = 1 << 23
"""Frames times edits of them, at most: FFmpeg goes over all frames for each edit."""

_MOST_UNITS = 1 << 32
"""Sound samples in all pieces, at most: a day of them."""

_MOST_INDEX = 64 << 20
"""Bytes of the boxes that are read, at most: those of some million frames."""

_MOST_BOXES = 1 << 17
"""Boxes, at most: writers of fragments make three a second or so."""

_DEEPEST = 12
"""Boxes inside each other, at most: FFmpeg reads eleven."""


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
    """Return the error for a file that is no video, or none that is read."""
    return FormatError(f"{path} is not a readable video: {why}", "Download or build it again.")


def _check_declared(file: BinaryIO) -> None:
    """Read the boxes of an MP4 file as FFmpeg does; frames themselves are passed over."""
    end, start = file.seek(0, 2), 0
    declared = _Declared(end)
    while start + 8 <= end:
        file.seek(start)
        head = file.read(16)
        body, stop = _box(head, 0, end - start)
        if stop < body:
            break
        if any(boxes.fullmatch(head, 4, 8) for boxes in (_CONTAINERS, _OTHERS, _TABLES)):
            declared.read += stop
            if declared.read > _MOST_INDEX:
                raise ValueError(f"over {_MOST_INDEX:,} bytes that describe it")
            file.seek(start)
            data = file.read(stop)
            declared.walk(data, 0, len(data))
        declared.count_box()
        start += stop
    declared.check()


def _box(data: bytes, start: int, end: int) -> tuple[int, int]:
    """Return where the content of a box begins, and where the box ends."""
    size, body = int.from_bytes(data[start : start + 4]), start + 8
    if size == 1 and body + 8 <= end:
        size, body = int.from_bytes(data[body : body + 8]), body + 8
    return body, min(end, start + size) if size else end


class _Declared:
    """What the tables of a file declare, added up."""

    def __init__(self, size: int):
        self.size = size
        self.read = self.boxes = self.samples = self.edits = self.chunks = self.runs = 0
        self.longest = 0
        self._new_track()

    def _new_track(self) -> None:
        self.handlers: set[bytes] = set()
        self.durations: set[tuple[int, int]] = set()
        self.equal: list[tuple[int, int]] = []

    def walk(self, data: bytes, start: int, end: int, depth: int = 0) -> None:
        """Read boxes that lie one after the other, and those in them."""
        if depth > _DEEPEST:
            raise ValueError("its description is nested too deeply")
        while start + 8 <= end:
            (body, stop), kind = _box(data, start, end), data[start + 4 : start + 8]
            if stop < body:
                return
            if _OTHERS.fullmatch(kind):
                for match in _TABLES.finditer(data, body, stop):
                    self.count(match[0], data, match.end())
            elif _CONTAINERS.fullmatch(kind):
                first = body
                if kind == b"meta":
                    names = range(body, stop, 4)
                    first = next((at - 4 for at in names if data[at : at + 4] == b"hdlr"), stop)
                if kind == b"trak":
                    self.finish_track()
                self.walk(data, first, stop, depth + 1)
                if kind == b"trak":
                    self.finish_track()
            elif _TABLES.fullmatch(kind):
                self.count(kind, data, body)
            self.count_box()
            start = stop

    def count_box(self) -> None:
        """Count a box, of which there may be so many."""
        self.boxes += 1
        if self.boxes > _MOST_BOXES:
            raise ValueError(f"over {_MOST_BOXES} parts")

    def count(self, kind: bytes, data: bytes, at: int) -> None:
        """Add what a table declares that begins at a place."""
        self.count_box()
        # After a version and flags, and in tables of sizes after one size for all.
        first, second, third = (
            int.from_bytes(data[at + skip : at + skip + 4]) for skip in (4, 8, 12)
        )
        if kind in (b"stsz", b"stz2"):
            self.equal.append((second, first if kind == b"stsz" else 0))
        elif kind == b"stts":
            self.durations.add((first, third))
        elif kind == b"hdlr":
            self.handlers.add(data[at + 8 : at + 12])
        elif kind == b"trun":
            self.samples += first
        elif kind == b"elst":
            self.edits += first
        elif kind in (b"stco", b"co64"):
            self.chunks += first
        elif kind == b"stsc":
            self.runs += first
            entries = min(first, max(0, len(data) - at - 8) // 12)
            if entries:
                table = np.frombuffer(data, ">u4", 3 * entries, at + 8)
                self.longest = max(self.longest, int(table[1::3].max()))
        elif kind == b"cmov":
            raise ValueError("its description is compressed")
        if self.runs > _MOST_SAMPLES:
            raise ValueError("its description has too many tables")

    def finish_track(self) -> None:
        """Add the samples of a track whose tables were read."""
        sound = b"soun" in self.handlers and self.handlers <= _OF_SOUND
        for count, size in self.equal:
            # Of uncompressed sound, FFmpeg makes an index of the pieces alone.
            if not (sound and self.durations == {(1, 1)} and 0 < count * size <= self.size):
                self.samples += count
        self._new_track()

    def check(self) -> None:
        """Check that all of it is within bounds."""
        self.finish_track()
        samples, edits = self.samples, self.edits
        if samples > _MOST_SAMPLES or max(1, edits) * samples > _MOST_EDITED:
            raise ValueError(f"it declares {samples} frames and {edits} edits of them")
        if self.chunks * self.longest > _MOST_UNITS:
            raise ValueError(f"it declares {self.chunks} pieces of up to {self.longest} samples")
