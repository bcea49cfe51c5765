"""Small files that would take much memory or time."""

import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from support.buffer_sets import GOLDEN

from robomme_interference_data.storage.limits import MAX_PIXELS

_VIDEO = GOLDEN / "demonstrations/videos/observation.images.front/chunk-000/file-000.mp4"
_MEGABYTE = 1 << 20


def _one_text_many_times(path: Path) -> None:
    """4 GiB of texts, each the one of the dictionary."""
    texts = pa.DictionaryArray.from_arrays(np.zeros(4096, np.int8), ["x" * _MEGABYTE])
    pq.write_table(pa.table({"v": texts}), path, store_schema=False)


def _repeated(path: Path, values: Any, count: int, **options: Any) -> None:
    table = pa.table({"v": values})
    with pq.ParquetWriter(path, table.schema, write_statistics=False, **options) as writer:
        for _ in range(count):
            writer.write_table(table)


def _many_equal_numbers(path: Path) -> None:
    """80 million zeros in runs."""
    _repeated(path, np.zeros(_MEGABYTE, np.int64), 80)


def _zeros(path: Path) -> None:
    """2.5 GiB of compressed zeros."""
    values = [bytes(64 * _MEGABYTE)]
    _repeated(path, values, 40, compression="zstd", use_dictionary=False)


def _one_page(path: Path) -> None:
    """A page of 128 MiB of zeros, which its header takes for 2 GiB."""
    _repeated(path, [bytes(128 * _MEGABYTE)], 1, compression="zstd", use_dictionary=False)
    data = path.read_bytes()
    start = data.index(b"\x80\x80\x80\x01") - 1  # the end of the size, as Thrift writes it
    path.write_bytes(data[:start] + b"\xfe\xff\xff\xff\x0f" + data[start + 5 :])


def _page_that_lies(path: Path) -> None:
    """A page of more values than in the metadata."""
    values = np.zeros(1 << 14, np.int64)
    _repeated(path, values, 1, compression="none", use_dictionary=False)
    data = path.read_bytes()
    count, more = b"\x15\x80\x80\x02", b"\x15\xfe\xff\x7f"  # as Thrift writes 16,384; 1,048,575
    assert data.count(count) >= 1
    path.write_bytes(data.replace(count, more, 1))


def _common_prefixes(path: Path) -> None:
    """Texts of which each repeats the one before."""
    table = pa.table({"v": ["x" * _MEGABYTE] * 4})
    encoding = {"v": "DELTA_BYTE_ARRAY"}
    pq.write_table(table, path, use_dictionary=False, column_encoding=encoding)


def _footer(path: Path, body: bytes) -> None:
    path.write_bytes(b"PAR1" + body + struct.pack("<I", len(body)) + b"PAR1")


def _many_groups(path: Path) -> None:
    """Metadata that declare 900 million row groups, and end there."""
    schema = b"\x48\x01r\x15\x02\x00" + b"\x15\x02\x25\x02\x18\x01x\x00"
    count = b"\xfc\x80\x80\xad\xad\x03"
    _footer(path, b"\x15\x02\x19\x2c" + schema + b"\x16\x00\x19" + count)


def _many_columns(path: Path) -> None:
    """Metadata of a row group that declare a million columns, and end there."""
    schema = b"\x48\x01r\x15\x02\x00" + b"\x15\x02\x25\x02\x18\x01x\x00"
    count = b"\xfc\xbf\x84\x3d"
    _footer(path, b"\x15\x02\x19\x2c" + schema + b"\x16\x00\x19\x1c\x19" + count)


def _large_footer(path: Path) -> None:
    _footer(path, bytes(20 * _MEGABYTE))


def _declare(data: bytearray, samples: int) -> None:
    """Let the first track of a video have samples of a hundred bytes, all in one chunk."""
    sizes, runs = data.find(b"stsz"), data.find(b"stsc")
    data[sizes + 8 : sizes + 16] = struct.pack(">II", 100, samples)
    data[runs + 16 : runs + 20] = struct.pack(">I", samples)


def _declared_frames(path: Path, samples: int = 10**9) -> None:
    data = bytearray(_VIDEO.read_bytes())
    _declare(data, samples)
    path.write_bytes(data)


def _many_frames(path: Path) -> None:
    _declared_frames(path, 5 * 10**7)


def _many_fragments(path: Path) -> None:
    """Fragments of 50 million frames."""
    with av.open(str(path), "w", format="mp4", options={"movflags": "empty_moov"}) as container:
        _add_track(container, 32)
    data = bytearray(path.read_bytes())
    run = data.find(b"trun")
    data[run + 4 : run + 12] = struct.pack(">II", 0, 5 * 10**7)
    path.write_bytes(data)


def _replace(data: bytearray, table: bytes, entries: list[bytes]) -> None:
    """Replace the entries of the first table of a name, and correct the sizes of boxes around."""
    start = data.find(table)
    change = 12 + len(b"".join(entries)) + 4 - int.from_bytes(data[start - 4 : start])
    stop = start - 4 + int.from_bytes(data[start - 4 : start])
    for box in (b"stbl", b"minf", b"mdia", b"edts", b"trak", b"moov", table):
        place = data.rfind(box, 0, start + 4) - 4
        size = int.from_bytes(data[place : place + 4])
        if place >= 0 and place + size >= stop:
            data[place : place + 4] = struct.pack(">I", size + change)
    data[start + 4 : stop] = struct.pack(">II", 0, len(entries)) + b"".join(entries)


def _many_edits(path: Path) -> None:
    """A million frames, and 200 edits of all of them."""
    data = bytearray(_VIDEO.read_bytes())
    _declare(data, 10**6)
    durations = data.find(b"stts")
    data[durations + 12 : durations + 16] = struct.pack(">I", 10**6)
    _replace(data, b"elst", [struct.pack(">III", 2**31 - 1, 0, 1 << 16)] * 200)
    path.write_bytes(data)


def _long_chunks(path: Path) -> None:
    """Sound of 60 chunks of a billion samples, of which a number of 1024 is declared, too."""
    with av.open(str(path), "w", format="mov") as container:
        sound = container.add_stream("pcm_u8", rate=8000, layout="mono")
        _add_track(container, 32)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.uint8), "u8", "mono")
        frame.sample_rate = 8000
        container.mux(sound.encode(frame))
        container.mux(sound.encode(None))
    data = bytearray(path.read_bytes())
    runs = data.find(b"stsc")
    data[runs + 16 : runs + 20] = struct.pack(">I", 1 << 30)
    _replace(data, b"stco", [struct.pack(">I", 36)] * 60)
    path.write_bytes(data)


def _add_track(container: Any, side: int) -> None:
    """Add a video of one frame."""
    stream = container.add_stream("mjpeg", rate=10)
    stream.pix_fmt, stream.height, stream.width = "yuvj420p", side, side
    container.mux(stream.encode(av.VideoFrame(side, side, "yuvj420p")))
    container.mux(stream.encode(None))


def _large_frames(path: Path) -> None:
    """Frames larger than any that are read, whatever the container says."""
    side = int(MAX_PIXELS**0.5) + 16
    with av.open(str(path), "w", format="mp4") as container:
        _add_track(container, side)


def _larger_than_declared(path: Path) -> None:
    _large_frames(path)
    frames, box, described = path.read_bytes().rpartition(b"moov")
    side = struct.pack(">H", int(MAX_PIXELS**0.5) + 16)
    path.write_bytes(frames + box + described.replace(side * 2, struct.pack(">HH", 32, 32)))


def _playlist(path: Path) -> None:
    path.write_text(f"#EXTM3U\n#EXTINF:1,\nfile://{_VIDEO}\n#EXT-X-ENDLIST\n")


def _long_json(path: Path) -> None:
    path.write_bytes(b'{"a":[' + b"[]," * (8 * _MEGABYTE) + b"0]}")


def _deep_json(path: Path) -> None:
    path.write_bytes(b'{"a":' * 100_000 + b"0" + b"}" * 100_000)


def _deep_readable_json(path: Path) -> None:
    path.write_bytes(b'{"a":' * 300 + b"0" + b"}" * 300)


def _sparse(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(8 << 30)


def _long_array(path: Path) -> None:
    """A header alone, of an array of a terabyte."""
    np.lib.format.open_memmap(path, "w+", np.float16, (1, 8))
    data = path.read_bytes()[:128]
    path.write_bytes(data.replace(b"(1, 8), }           ", b"(99999999999, 8), } "))


def _archive(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("a.npy", bytes(64 * _MEGABYTE))


def _pickled(path: Path) -> None:
    with path.open("wb") as file:
        np.save(file, np.array([[{}]], object), allow_pickle=True)


def _large_image(path: Path) -> None:
    """The header of a PNG image of 60,000 × 60,000 pixels."""
    import zlib

    def chunk(kind: bytes, data: bytes) -> bytes:
        body = kind + data
        return struct.pack(">I", len(data)) + body + struct.pack(">I", zlib.crc32(body))

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(_MEGABYTE))
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", body), chunk(b"IEND", b""))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


def write_rows_bomb(path: Path) -> None:
    """Rows of rollouts that take 1 GiB in pyarrow, and as much again in Python."""
    count = 1 << 17
    values = {"family": "MoveCube", "condition": "k0", "status": "success", "success": "1"}
    columns: dict[str, Any] = {"episode": np.arange(count)}
    for name, value in (values | {"system": "x" * 8000}).items():
        columns[name] = pa.DictionaryArray.from_arrays(np.zeros(count, np.int8), [value])
    pq.write_table(pa.table(columns), path, store_schema=False)


class Bomb(NamedTuple):
    """The kind of file, what writes it, and a part of the error of reading it."""

    kind: str
    write: Callable[[Path], None]
    message: str


BOMBS = {
    "one text many times": Bomb("parquet", _one_text_many_times, "once decoded"),
    "many equal numbers": Bomb("parquet", _many_equal_numbers, "once decoded"),
    "compressed zeros": Bomb("parquet", _zeros, "once decoded"),
    "one page of 2 GiB": Bomb("parquet", _one_page, "once decoded"),
    "a page that lies": Bomb("parquet", _page_that_lies, "values; its metadata has 16384"),
    "common prefixes": Bomb("parquet", _common_prefixes, "common prefixes"),
    "many row groups": Bomb("parquet", _many_groups, "cannot be read"),
    "many columns": Bomb("parquet", _many_columns, "cannot be read"),
    "large metadata": Bomb("parquet", _large_footer, "bytes of metadata"),
    "a billion frames": Bomb("video", _declared_frames, "it declares 1000000000 frames"),
    "50 million frames": Bomb("video", _many_frames, "it declares 50000000 frames"),
    "fragments of 50 million frames": Bomb("video", _many_fragments, "it declares 50000000 frames"),
    "many edits": Bomb("video", _many_edits, "and 200 edits"),
    "long chunks of sound": Bomb("video", _long_chunks, "chunks of up to 1073741824 samples"),
    "large frames": Bomb("video", _large_frames, "decoding stopped"),
    "larger than declared": Bomb("video", _larger_than_declared, "decoding stopped"),
    "a playlist": Bomb("video", _playlist, "no MP4, Matroska or AVI file"),
    "long": Bomb("json", _long_json, "at most"),
    "deep": Bomb("json", _deep_json, "not valid JSON"),
    "deep, but read by Python": Bomb("json", _deep_readable_json, "nested arrays"),
    "sparse": Bomb("json", _sparse, "at most"),
    "sparse sums": Bomb("sums", _sparse, "at most"),
    "sparse rows": Bomb("lines", _sparse, "at most"),
    "a header alone": Bomb("array", _long_array, "128 bytes do not fit an array"),
    "an archive": Bomb("array", _archive, "not an array"),
    "pickled": Bomb("array", _pickled, "not an array"),
    "a large image": Bomb("image", _large_image, "an image is damaged"),
}


def read(kind: str, path: Path) -> object:
    """Read a file as what it is."""
    from robomme_interference_data.evaluate.run.record import whole_lines
    from robomme_interference_data.storage.arrays import read_array
    from robomme_interference_data.storage.files import read_sums
    from robomme_interference_data.storage.parquet import RowSpan
    from robomme_interference_data.storage.text import read_json
    from robomme_interference_data.storage.video.encode import decode_image
    from robomme_interference_data.storage.video.frames import iter_frames

    readers: dict[str, Callable[[], object]] = {
        "parquet": lambda: RowSpan(path).table(),
        "video": lambda: list(iter_frames(path, 0, None, 10)),
        "json": lambda: read_json(path),
        "sums": lambda: read_sums(path),
        "lines": lambda: whole_lines(path),
        "array": lambda: read_array(path, np.float16, (-1, 8)),
        "image": lambda: decode_image(io.FileIO(path).readall()),
    }
    return readers[kind]()
