"""Which videos and images count as exact, whether they are, and how images are decoded."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support.messages import raises
from support.recordings import encode_image, make_episode, write_video

from robomme_interference_data.build_dataset.sources.images import (
    ProbedVideo,
    info_is_exact,
    probe_video,
)
from robomme_interference_data.errors import FormatError
from robomme_interference_data.storage.video.encode import CODECS, decode_image, is_png
from robomme_interference_data.storage.video.frames import iter_frames

FRAMES = make_episode(7, 5).images["front"]
OURS = CODECS["av1-lossless"].settings["extra_options"]


def info(codec: object, pix_fmt: str, crf: object = 30, **options: object) -> dict[str, object]:
    named = {"video.codec": codec, "video.pix_fmt": pix_fmt, "video.crf": crf}
    return {**named, "video.extra_options": options}


@pytest.mark.parametrize(
    ("described", "exact"),
    [
        (info("av1", "gbrp", None, **OURS), True),
        (info("av1", "gbrp", None, **{"aom-params": "lossless=0"}), False),
        (info("av1", "yuv420p"), False),
        (info("hevc", "gbrp", **{"x265-params": "bframes=0:lossless=1:log-level=error"}), True),
        (info("hevc", "gbrp", crf=0), False),
        (info("vp9", "gbrp", lossless=1), True),
        (info("h264", "gbrp", crf=None, qp=0), True),
        (info("h264", "gbrp", crf=0, qp=4), False),
        (info("ffv1", "bgr0", None), True),
        ({}, False),
    ],
)
def test_info(described: dict[str, object], exact: bool) -> None:
    assert info_is_exact(described) is exact


@pytest.mark.parametrize(
    ("codec", "pix_fmt", "suffix", "counts"),
    [
        ("ffv1", "bgr0", ".mkv", True),
        ("huffyuv", "rgb24", ".avi", True),
        ("ffv1", "yuv444p", ".mkv", False),
        ("mpeg4", "yuv420p", ".mp4", False),
    ],
)
def test_a_video_that_counts_as_exact_is(
    tmp_path: Path, codec: str, pix_fmt: str, suffix: str, counts: bool
) -> None:
    path = write_video(tmp_path / f"video{suffix}", FRAMES, codec, pix_fmt)
    assert probe_video(path) == ProbedVideo(rate=10, count=5, first_s=0, exact=counts)
    assert np.array_equal(np.stack(list(iter_frames(path, 0, None, 10))), FRAMES) is counts


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "L", "LA", "P", "1"])
def test_png_of_every_kind(mode: str) -> None:
    picture, out = Image.fromarray(FRAMES[3]).convert(mode), io.BytesIO()
    picture.save(out, "PNG")
    assert is_png(out.getvalue())
    np.testing.assert_array_equal(decode_image(out.getvalue()), np.asarray(picture.convert("RGB")))


def with_orientation(orientation: int, kind: str) -> bytes:
    exif, out = Image.Exif(), io.BytesIO()
    exif[0x112] = orientation
    Image.fromarray(FRAMES[3]).save(out, kind, exif=exif)
    return out.getvalue()


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photo_is_turned_as_its_exif_states(orientation: int) -> None:
    plain, data = with_orientation(1, "JPEG"), with_orientation(orientation, "JPEG")
    stored = decode_image(plain)
    turned = {
        1: stored,
        2: stored[:, ::-1],
        3: stored[::-1, ::-1],
        4: stored[::-1],
        5: stored.swapaxes(0, 1),
        6: np.rot90(stored, -1),  # clockwise
        7: stored.swapaxes(0, 1)[::-1, ::-1],
        8: np.rot90(stored),
    }
    np.testing.assert_array_equal(decode_image(data), turned[orientation])


def test_a_png_that_is_to_be_turned_is_an_error() -> None:
    np.testing.assert_array_equal(decode_image(with_orientation(1, "PNG")), FRAMES[3])
    for orientation in range(2, 9):
        with raises(FormatError):
            decode_image(with_orientation(orientation, "PNG"))


def test_every_single_changed_byte_of_a_png_is_noticed() -> None:
    data = encode_image(FRAMES[2][:8, :8])
    for place in range(len(data)):
        changed = bytearray(data)
        changed[place] ^= 0x40
        try:
            image = decode_image(bytes(changed))
        except FormatError:
            continue
        np.testing.assert_array_equal(image, FRAMES[2][:8, :8])


def test_invalid_images() -> None:
    deep = io.BytesIO()
    Image.fromarray(np.arange(64, dtype=np.uint16).reshape(8, 8)).save(deep, "PNG")
    for data in (b"", b"GIF89a", encode_image(FRAMES[0])[:40], deep.getvalue()):
        with raises(FormatError):
            decode_image(data)
