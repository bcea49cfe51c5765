"""Small files that ask for much: of memory, or of time."""

import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from support.buffer_sets import GOLDEN

from robomme_interference_data.storage.video import MOST_PIXELS

_VIDEO = GOLDEN / "demonstrations/videos/observation.images.front/chunk-000/file-000.mp4"
_MEGABYTE = 1 << 20


def _one_text_many_times(path: Path) -> None:
    """4 GiB of texts, each the one of the dictionary."""
    texts = pa.DictionaryArray.from_arrays(np.zeros(4096, np.int8), ["x" * _MEGABYTE])
    pq.write_table(pa.table({"v": texts}), path, store_schema=False)


def _many_equal_numbers(path: Path) -> None:
    """80 million noughts in runs."""
    table = pa.table({"v": np.zeros(_MEGABYTE, np.int64)})
    with pq.ParquetWriter(path, table.schema) as writer:
        for _ in range(80):
            writer.write_table(table)


def _zeros(path: Path) -> None:
    """2.5 GiB of compressed noughts."""
    table = pa.table({"v": [bytes(64 * _MEGABYTE)]})
    with pq.ParquetWriter(
        path, table.schema, compression="zstd", use_dictionary=False, write_statistics=False
    ) as writer:
        for _ in range(40):
            writer.write_table(table)


def _page_that_lies(path: Path) -> None:
    """A page of more values than the metadata say."""
    pq.write_table(
        pa.table({"v": np.zeros(1 << 14, np.int64)}),
        path,
        compression="none",
        use_dictionary=False,
        write_statistics=False,
    )
    data = path.read_bytes()
    told, more = b"\x15\x80\x80\x02", b"\x15\xfe\xff\x7f"  # as Thrift writes 16,384; 1,048,575
    assert data.count(told) >= 1
    path.write_bytes(data.replace(told, more, 1))


def _common_prefixes(path: Path) -> None:
    """Texts of which each repeats the one before."""
    table = pa.table({"v": ["x" * _MEGABYTE] * 4})
    encoding = {"v": "DELTA_BYTE_ARRAY"}
    pq.write_table(table, path, use_dictionary=False, column_encoding=encoding)


def _footer(path: Path, body: bytes) -> None:
    path.write_bytes(b"PAR1" + body + struct.pack("<I", len(body)) + b"PAR1")


def _many_groups(path: Path) -> None:
    """Metadata that tell of 900 million row groups, and end there."""
    schema = b"\x48\x01r\x15\x02\x00" + b"\x15\x02\x25\x02\x18\x01x\x00"
    count = b"\xfc\x80\x80\xad\xad\x03"
    _footer(path, b"\x15\x02\x19\x2c" + schema + b"\x16\x00\x19" + count)


def _large_footer(path: Path) -> None:
    _footer(path, bytes(20 * _MEGABYTE))


def _declared_frames(path: Path) -> None:
    """A video of a billion frames of a hundred bytes."""
    data = bytearray(_VIDEO.read_bytes())
    sizes, runs = data.find(b"stsz"), data.find(b"stsc")
    data[sizes + 8 : sizes + 16] = struct.pack(">II", 100, 10**9)
    data[runs + 16 : runs + 20] = struct.pack(">I", 10**9)
    path.write_bytes(data)


def _large_frames(path: Path) -> None:
    """Frames larger than any that are read, whatever the container says."""
    side = int(MOST_PIXELS**0.5) + 16
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream("mjpeg", rate=10)
        stream.pix_fmt, stream.height, stream.width = "yuvj420p", side, side
        container.mux(stream.encode(av.VideoFrame(side, side, "yuvj420p")))
        container.mux(stream.encode(None))


def _larger_than_told(path: Path) -> None:
    _large_frames(path)
    frames, box, described = path.read_bytes().rpartition(b"moov")
    side = struct.pack(">H", int(MOST_PIXELS**0.5) + 16)
    path.write_bytes(frames + box + described.replace(side * 2, struct.pack(">HH", 32, 32)))


def _playlist(path: Path) -> None:
    path.write_text(f"#EXTM3U\n#EXTINF:1,\nfile://{_VIDEO}\n#EXT-X-ENDLIST\n")


def _list_of_files(path: Path) -> None:
    path.write_text(f"ffconcat version 1.0\nfile '{_VIDEO}'\n")


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
        return (
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        )

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    body = zlib.compress(bytes(_MEGABYTE))
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", body), chunk(b"IEND", b""))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))


BOMBS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "one text many times": ("parquet", _one_text_many_times),
    "many equal numbers": ("parquet", _many_equal_numbers),
    "compressed noughts": ("parquet", _zeros),
    "a page that lies": ("parquet", _page_that_lies),
    "common prefixes": ("parquet", _common_prefixes),
    "many row groups": ("parquet", _many_groups),
    "large metadata": ("parquet", _large_footer),
    "a billion frames": ("video", _declared_frames),
    "large frames": ("video", _large_frames),
    "larger than told": ("video", _larger_than_told),
    "a playlist": ("video", _playlist),
    "a list of files": ("video", _list_of_files),
    "long": ("json", _long_json),
    "deep": ("json", _deep_json),
    "deep, but read by Python": ("json", _deep_readable_json),
    "sparse": ("json", _sparse),
    "sparse sums": ("sums", _sparse),
    "sparse rows": ("lines", _sparse),
    "a header alone": ("array", _long_array),
    "an archive": ("array", _archive),
    "pickled": ("array", _pickled),
    "a large image": ("image", _large_image),
}
"""Name to the kind of file, and what writes it."""


def read(kind: str, path: Path) -> object:
    """Read a file as what it is."""
    from robomme_interference_data.evaluate.run.log import whole_lines
    from robomme_interference_data.storage.arrays import read_array
    from robomme_interference_data.storage.encode import decode_image
    from robomme_interference_data.storage.files import read_json, read_sums
    from robomme_interference_data.storage.parquet import RowSpan
    from robomme_interference_data.storage.video import iter_frames

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
