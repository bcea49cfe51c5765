"""Videos and image statistics."""

import dataclasses
import subprocess
import sys
import tempfile
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.encode import (
    CODECS,
    Codec,
    ImageStats,
    VideoEncoder,
    get_codec,
)
from robomme_interference_data.build_dataset.writer import load_lerobot
from robomme_interference_data.errors import BuildError, InvalidOptionError
from robomme_interference_data.video import iter_frames

LOSSLESS = CODECS["av1-lossless"]
LOSSY = CODECS["lerobot-default"]


def noise(seed: int, *shape: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)


def write(path: Path, images: NDArray[np.uint8], codec: Codec = LOSSLESS) -> list[NDArray]:
    """Encode images, and return what the file decodes to."""
    encoder = VideoEncoder(path, codec, 10, *images.shape[1:3])
    for image in images:
        encoder.add(image)
    encoder.close()
    return list(iter_frames(path, 0, None, 10))


# --- settings -----------------------------------------------------------------------------------


@pytest.mark.parametrize("codec", CODECS.values(), ids=list(CODECS))
def test_options_are_those_that_lerobot_would_give_ffmpeg(codec: Codec) -> None:
    load_lerobot()
    from lerobot.configs.video import RGBEncoderConfig

    config = RGBEncoderConfig(vcodec=codec.vcodec, pix_fmt=codec.pix_fmt, **codec.settings)
    assert dict(codec.options) == config.get_codec_options(as_strings=True)
    assert (codec.vcodec, codec.pix_fmt) == (config.vcodec, config.pix_fmt)


def test_the_lossy_codec_is_lerobots_default() -> None:
    load_lerobot()
    from lerobot.configs.video import RGBEncoderConfig

    default = RGBEncoderConfig()
    assert (LOSSY.vcodec, LOSSY.pix_fmt) == (default.vcodec, default.pix_fmt)
    assert dict(LOSSY.options) == default.get_codec_options(as_strings=True)
    assert not LOSSY.exact


def test_names() -> None:
    assert {name: codec.name for name, codec in CODECS.items()} == {
        "av1-lossless": "av1-lossless",
        "lerobot-default": "lerobot-default",
    }
    assert get_codec("av1-lossless") is LOSSLESS
    with pytest.raises(InvalidOptionError, match="--codec 'av1-losless' is unknown") as raised:
        get_codec("av1-losless")
    assert "Did you mean 'av1-lossless'?" in str(raised.value)


# --- lossless -----------------------------------------------------------------------------------


@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    length=st.integers(1, 20),
    seed=st.integers(0, 1000),
)
@settings(max_examples=25)
def test_lossless_round_trip_at_any_size(height: int, width: int, length: int, seed: int) -> None:
    images = noise(seed, length, height, width)
    with tempfile.TemporaryDirectory() as folder:
        decoded = write(Path(folder) / "video.mp4", images)
    assert np.array_equal(decoded, images)


@given(
    arrays(
        np.uint8,
        st.tuples(st.integers(1, 3), st.integers(1, 9), st.integers(1, 9), st.just(3)),
        elements=st.sampled_from([0, 1, 127, 128, 254, 255]),
    )
)
@settings(max_examples=25)
def test_lossless_round_trip_of_extreme_values(images: NDArray[np.uint8]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        decoded = write(Path(folder) / "video.mp4", images)
    assert np.array_equal(decoded, images)


def test_all_colours_survive(tmp_path: Path) -> None:
    # Every value of each pair of channels, at three values of the other one.
    first, second = np.mgrid[0:256, 0:256].astype(np.uint8)
    images = np.stack(
        [
            np.stack(np.roll([first, second, np.full_like(first, other)], turn, axis=0), axis=-1)
            for turn in range(3)
            for other in (0, 100, 255)
        ]
    )
    assert np.array_equal(write(tmp_path / "video.mp4", images), images)


def test_file_layout(tmp_path: Path) -> None:
    write(tmp_path / "video.mp4", noise(0, 40, 16, 24))
    with av.open(str(tmp_path / "video.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("libdav1d", "gbrp")
        assert (stream.height, stream.width) == (16, 24)
        assert stream.average_rate == 10
        packets = [packet for packet in container.demux(stream) if packet.pts is not None]
        numbers = [round(float(packet.pts * stream.time_base) * 10) for packet in packets]
        keys = [n for n, packet in zip(numbers, packets, strict=True) if packet.is_keyframe]
        assert numbers == list(range(40))  # no reordering: a packet a frame, in order
        assert keys == [0, 16, 32]
        assert all(packet.pts == packet.dts for packet in packets)


def test_seeking_to_any_frame(tmp_path: Path) -> None:
    images = noise(1, 40, 8, 8)
    write(tmp_path / "video.mp4", images)
    for start in range(40):
        found = next(iter_frames(tmp_path / "video.mp4", start, None, 10))
        assert np.array_equal(found, images[start])


@pytest.mark.parametrize("codec", CODECS.values(), ids=list(CODECS))
def test_the_same_frames_give_the_same_bytes(tmp_path: Path, codec: Codec) -> None:
    images = noise(2, 20, 64, 64)
    write(tmp_path / "one.mp4", images, codec)
    write(tmp_path / "two.mp4", images, codec)
    assert (tmp_path / "one.mp4").read_bytes() == (tmp_path / "two.mp4").read_bytes()


# --- lossy, and what cannot be encoded -----------------------------------------------------------


@pytest.mark.parametrize(("height", "width"), [(64, 64), (65, 67), (64, 130)])
def test_lossy_keeps_number_and_size_of_frames(tmp_path: Path, height: int, width: int) -> None:
    images = noise(3, 20, height, width)
    decoded = np.stack(write(tmp_path / "video.mp4", images, LOSSY))
    assert decoded.shape == images.shape
    assert not np.array_equal(decoded, images)


@pytest.mark.parametrize("codec", CODECS.values(), ids=list(CODECS))
def test_encoders_print_nothing(
    tmp_path: Path, codec: Codec, capfd: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "video.mp4", noise(3, 2, 64, 64), codec)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("height", "width"), [(63, 64), (64, 63), (8, 8)])
def test_too_small_for_the_lossy_codec(tmp_path: Path, height: int, width: int) -> None:
    with pytest.raises(BuildError, match=f"{width}×{height} pixels are too small") as raised:
        VideoEncoder(tmp_path / "video.mp4", LOSSY, 10, height, width)
    assert "--codec av1-lossless" in str(raised.value)


@pytest.mark.slow
@pytest.mark.parametrize("side", range(64, 100, 5))
def test_the_lossy_encoder_does_not_crash_from_its_smallest_size_on(side: int) -> None:
    # SVT-AV1 ends the process with SIGFPE or SIGSEGV on some small frames.
    script = (
        "import sys, numpy as np, tempfile, pathlib\n"
        "from robomme_interference_data.build_dataset.encode import CODECS, VideoEncoder\n"
        "folder = pathlib.Path(tempfile.mkdtemp())\n"
        "for h, w in ((64, %d), (%d, 64), (%d, 256)):\n"
        "    encoder = VideoEncoder(folder / 'v.mp4', CODECS['lerobot-default'], 10, h, w)\n"
        "    for i in range(10):\n"
        "        encoder.add(np.full((h, w, 3), 20 * i, np.uint8))\n"
        "    encoder.close()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script % (side, side, side)],
        check=False,
    )
    assert done.returncode == 0


def test_a_place_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(BuildError, match=r"missing/video\.mp4: the video cannot be written"):
        write(tmp_path / "missing" / "video.mp4", noise(0, 2, 8, 8))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
def test_a_full_disk(tmp_path: Path) -> None:
    (tmp_path / "video.mp4").symlink_to("/dev/full")
    with pytest.raises(BuildError, match="No space left on device"):
        write(tmp_path / "video.mp4", noise(0, 2, 8, 8))


def test_an_encoder_that_this_ffmpeg_does_not_have(tmp_path: Path) -> None:
    codec = dataclasses.replace(LOSSLESS, vcodec="libmissing")
    with pytest.raises(BuildError, match="the video cannot be written: libmissing"):
        VideoEncoder(tmp_path / "video.mp4", codec, 10, 8, 8)


# --- statistics ----------------------------------------------------------------------------------


def test_statistics_by_hand() -> None:
    # Of 8 × 8 pixels, rows and columns 0 and 4 count: four pixels a frame.
    image = np.full((8, 8, 3), 99, np.uint8)
    image[::4, ::4, 0] = [[0, 10], [20, 30]]
    image[::4, ::4, 1] = 7
    image[::4, ::4, 2] = [[255, 0], [0, 0]]
    stats = ImageStats()
    stats.add(image)
    result = stats.result()
    assert result["count"].tolist() == [4]
    assert result["min"].tolist() == [0, 7, 0]
    assert result["max"].tolist() == [30, 7, 255]
    assert result["mean"].tolist() == [15, 7, 63.75]
    # (15² + 5² + 5² + 15²) / 4 = 125; (191.25² + 3 · 63.75²) / 4 = 12192.1875
    np.testing.assert_allclose(result["std"], [125**0.5, 0, 12192.1875**0.5], rtol=1e-14)
    # The quantile q is the smallest value that at least q of the pixels do not exceed.
    assert result["q01"].tolist() == [0, 7, 0]
    assert result["q10"].tolist() == [0, 7, 0]
    assert result["q50"].tolist() == [10, 7, 0]
    assert result["q90"].tolist() == [30, 7, 255]
    assert result["q99"].tolist() == [30, 7, 255]


@given(
    arrays(
        np.uint8,
        st.tuples(st.integers(1, 5), st.integers(1, 13), st.integers(1, 13), st.just(3)),
    )
)
def test_statistics_against_numpy(images: NDArray[np.uint8]) -> None:
    stats = ImageStats()
    for image in images:
        stats.add(image)
    result = stats.result()
    pixels = images[:, ::4, ::4].reshape(-1, 3).astype(np.float64)
    assert result["count"].tolist() == [len(pixels)]
    np.testing.assert_array_equal(result["min"], pixels.min(0))
    np.testing.assert_array_equal(result["max"], pixels.max(0))
    np.testing.assert_allclose(result["mean"], pixels.mean(0), rtol=1e-12)
    np.testing.assert_allclose(result["std"], pixels.std(0), rtol=1e-9, atol=1e-9)
    for name, quantile in (("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)):
        expected = np.quantile(pixels, quantile, axis=0, method="inverted_cdf")
        np.testing.assert_array_equal(result[name], expected)


def test_order_of_frames_does_not_matter() -> None:
    images = noise(4, 10, 16, 16)
    forward, backward = ImageStats(), ImageStats()
    for image in images:
        forward.add(image)
    for image in images[::-1]:
        backward.add(image)
    for name, value in forward.result().items():
        assert value.tobytes() == backward.result()[name].tobytes()
