"""Bound the samples that an MP4 file declares, before FFmpeg opens it.

FFmpeg makes an index of all samples (frames, or pieces of sound), however short the file is, and 50
million took 1.2 GB. The tables that declare them are searched for by name in everything but the
frames, so that none is missed wherever FFmpeg would find it.
"""

import os
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

_TABLES = re.compile(b"(?=(stsz|stz2|trun|elst|stsc|stco|co64|cmov|sidx))")
"""Tables of samples, of edits and of chunks, and what would hide them: compressed metadata, and an
index by which FFmpeg would jump into the frames. Names may overlap: `stco64`."""

_MAX_SAMPLES = 1 << 23  # times edits, for each of which FFmpeg goes through all of them
_MAX_IN_CHUNKS = 1 << 32  # chunks times samples of the longest: of some sound, the only number
_MAX_BOX_BYTES = 64 << 20  # the tables of some million samples


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
        raise ValueError("its metadata is compressed or has a segment index")
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
