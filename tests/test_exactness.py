"""Which videos and images count as exact, and whether they are."""

import io
from pathlib import Path

import numpy as np
import pytest
from lerobot_factory import EXACT_VIDEO, encode, recording, write_video
from PIL import Image

from robomme_interference_data.build_dataset.sources.exactness import (
    info_is_exact,
    probe_video,
    stream_is_exact,
)
from robomme_interference_data.build_dataset.sources.images import decode_image, is_png, png_size
from robomme_interference_data.errors import FormatError, SourceError
from robomme_interference_data.video import iter_frames

FRAMES = recording(7, 5, "look").images["front"]


def info(codec: str, pix_fmt: str, crf: object = 30, **options: object) -> dict[str, object]:
    return {
        "video.codec": codec,
        "video.pix_fmt": pix_fmt,
        "video.crf": crf,
        "video.extra_options": options,
    }


@pytest.mark.parametrize(
    ("described", "exact"),
    [
        (info("av1", "gbrp", None, **EXACT_VIDEO["extra_options"]), True),
        (info("av1", "gbrp", None, **{"aom-params": "lossless=0"}), False),
        (info("av1", "gbrp", None, usage=1), False),
        (info("av1", "yuv420p"), False),
        (info("av1", "yuv444p", None, **{"aom-params": "lossless=1"}), False),
        (info("hevc", "gbrp", **{"x265-params": "bframes=0:lossless=1:log-level=error"}), True),
        (info("hevc", "gbrp", crf=0), False),
        (info("vp9", "gbrp", lossless=1), True),
        (info("h264", "gbrp", crf=0), True),
        (info("h264", "gbrp", crf=None, qp=0), True),
        (info("h264", "gbrp", crf=0, qp=4), False),
        (info("h264", "yuv444p", crf=0), False),
        (info("h264", "gbrp", crf=1), False),
        (info("ffv1", "gbrp"), True),
        (info("ffv1", "bgr0", None), True),
        (info("ffv1", "yuv420p"), False),
        (info("png", "rgb24"), True),
        ({}, False),
        ({"video.codec": "av1", "video.pix_fmt": "gbrp"}, False),
    ],
)
def test_info(described: dict[str, object], exact: bool) -> None:
    assert info_is_exact(described) is exact


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "suffix", "counts", "really"),
    [
        ("ffv1", "bgr0", ".mkv", True, True),
        ("huffyuv", "rgb24", ".avi", True, True),
        ("png", "rgb24", ".mov", True, True),
        ("rawvideo", "bgr24", ".avi", True, True),
        ("ffv1", "yuv444p", ".mkv", False, False),
        ("libx264rgb", "rgb24", ".mkv", False, False),
        ("mpeg4", "yuv420p", ".mp4", False, False),
    ],
)
def test_video_that_counts_as_exact_is(
    tmp_path: Path, codec: str, pix_fmt: str, suffix: str, counts: bool, really: bool
) -> None:
    path = tmp_path / f"video{suffix}"
    write_video(path, FRAMES, codec, pix_fmt)
    stream = probe_video(path)
    assert stream.size == (48, 64)
    assert stream.rate == 10
    read = np.stack(list(iter_frames(path, 0, None, 10)))
    assert np.array_equal(read, FRAMES) is really
    assert stream_is_exact(stream) is counts


def test_no_video(tmp_path: Path) -> None:
    path = tmp_path / "video.mkv"
    path.write_bytes(b"not a video")
    with pytest.raises(SourceError, match="is not a readable video"):
        probe_video(path)


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA", "P", "1"])
def test_png_of_every_kind(mode: str) -> None:
    picture = Image.fromarray(FRAMES[3]).convert(mode)
    out = io.BytesIO()
    picture.save(out, "PNG")
    assert is_png(out.getvalue())
    assert png_size(out.getvalue()[:24]) == (48, 64)
    np.testing.assert_array_equal(decode_image(out.getvalue()), np.asarray(picture.convert("RGB")))


def test_jpeg_is_near() -> None:
    data = encode(FRAMES[0], "jpg")
    assert not is_png(data)
    # Decoders differ in how they scale the colour planes up, at the edges of this picture.
    theirs = np.asarray(Image.open(io.BytesIO(data))).astype(int)
    assert np.abs(decode_image(data) - theirs).mean() < 15


def test_sixteen_bits_are_refused() -> None:
    out = io.BytesIO()
    Image.fromarray(np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)).save(out, "PNG")
    with pytest.raises(FormatError, match="16 bits a channel"):
        decode_image(out.getvalue())


def test_every_single_changed_byte_of_a_png_is_noticed() -> None:
    data = encode(FRAMES[2][:8, :8], "png")
    for place in range(len(data)):
        changed = bytearray(data)
        changed[place] ^= 0x40
        try:
            image = decode_image(bytes(changed))
        except FormatError:
            continue
        np.testing.assert_array_equal(image, FRAMES[2][:8, :8])


@pytest.mark.parametrize("data", [b"", b"GIF89a", encode(FRAMES[0], "png")[:40]])
def test_what_is_no_image(data: bytes) -> None:
    with pytest.raises(FormatError):
        decode_image(data)


def test_size_of_what_is_no_png() -> None:
    for data in (b"", b"\xff\xd8\xff", encode(FRAMES[0], "png")[:20]):
        with pytest.raises(FormatError, match="not a PNG"):
            png_size(data)
