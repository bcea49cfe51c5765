"""The one writer of video: lossless at any size, the same bytes each time, one clear error."""

import dataclasses
import gc
import tempfile
from fractions import Fraction
from pathlib import Path

import av
import av.logging
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from support.machine import full_disk
from support.messages import raises

from robomme_interference_data.errors import BuildError
from robomme_interference_data.storage.video.encode import CLIP, CODECS, Codec, VideoEncoder
from robomme_interference_data.storage.video.frames import iter_frames, read_times

LOSSLESS, LOSSY = CODECS["av1-lossless"], CODECS["lerobot-default"]


def noise(seed: int, *shape: int) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)


def write(
    path: Path, images: NDArray[np.uint8], codec: Codec = LOSSLESS, fps: float = 10
) -> NDArray[np.uint8]:
    """Encode images, and return what the file decodes to."""
    encoder = VideoEncoder(path, codec, fps, *images.shape[1:3])
    for image in images:
        encoder.add(image)
    encoder.close()
    return np.stack(list(iter_frames(path, 0, None, fps)))


# --- lossless ------------------------------------------------------------------------------------


@given(
    arrays(
        np.uint8,
        st.tuples(st.integers(1, 20), st.integers(1, 40), st.integers(1, 40), st.just(3)),
        elements=st.sampled_from([0, 1, 127, 128, 254, 255]),
    ),
    st.integers(0, 1000),
)
@settings(max_examples=25)
def test_any_size_and_value(images: NDArray[np.uint8], seed: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        for given_images in (images, noise(seed, *images.shape[:3])):
            assert np.array_equal(write(Path(folder) / "v.mp4", given_images), given_images)


def test_file_layout(tmp_path: Path) -> None:
    write(tmp_path / "video.mp4", noise(0, 40, 16, 24))
    with av.open(str(tmp_path / "video.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt) == ("libdav1d", "gbrp")
        assert (stream.height, stream.width, stream.average_rate) == (16, 24, 10)
        packets = [packet for packet in container.demux(stream) if packet.pts is not None]
    numbers = [round(float(packet.pts * packet.time_base) * 10) for packet in packets]
    keys = [n for n, packet in zip(numbers, packets, strict=True) if packet.is_keyframe]
    assert numbers == list(range(40))  # no reordering: a packet a frame, in order
    assert keys == [0, 16, 32]
    assert all(packet.pts == packet.dts for packet in packets)


@pytest.mark.parametrize("codec", [LOSSLESS, LOSSY, CLIP], ids=lambda one: one.name)
def test_the_same_frames_give_the_same_bytes_and_nothing_is_printed(
    tmp_path: Path, codec: Codec, capfd: pytest.CaptureFixture[str]
) -> None:
    # LeRobot, if a test before this used it, leaves FFmpeg's own callback behind, which prints.
    av.logging.set_level(av.logging.get_level())
    images = noise(2, 10, 64, 66)
    one, two = tmp_path / "one.mp4", tmp_path / "two.mp4"
    found = write(one, images, codec)
    write(two, images, codec)
    assert one.read_bytes() == two.read_bytes()
    assert found.shape == images.shape
    assert np.array_equal(found, images) == codec.exact
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
@pytest.mark.parametrize(("height", "width"), [(98, 50), (64, 66), (34, 36)])
def test_clips_are_the_same_whatever_memory_held_before(
    tmp_path: Path, height: int, width: int
) -> None:
    random = np.random.default_rng(0)
    found = set()
    for _ in range(20):
        encoder = VideoEncoder(tmp_path / "clip.mp4", CLIP, 10, height, width)
        for image in noise(2, 10, height, width):
            for size in random.integers(1000, 60000, 40):
                random.bytes(int(size))  # memory that is given back, with other bytes in it
            encoder.add(image)
        encoder.close()
        found.add((tmp_path / "clip.mp4").read_bytes())
    assert len(found) == 1


# --- what cannot be encoded ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("codec", "fps", "height", "width", "advice"),
    [
        (LOSSY, 10, 63, 64, "av1-lossless"),
        (LOSSY, 10, 64, 63, "av1-lossless"),
        (LOSSY, 10, 64, 8705, "av1-lossless"),
        (LOSSY, 241, 64, 64, "av1-lossless"),
        (LOSSY, 0.001, 64, 64, "av1-lossless"),
        (LOSSY, 10, 70_000, 64, "smaller"),
        (LOSSLESS, 10, 1, 1 << 16, "smaller"),
        (LOSSLESS, 10, 4097, 4096, "smaller"),  # more than are read
        (LOSSLESS, 1e-4, 8, 8, "frame rate"),
        (LOSSLESS, 20_000, 8, 8, "frame rate"),
    ],
)
def test_what_does_not_fit_a_codec(
    tmp_path: Path, codec: Codec, fps: float, height: int, width: int, advice: str
) -> None:
    with raises(BuildError) as raised:
        VideoEncoder(tmp_path / "video.mp4", codec, fps, height, width)
    assert advice in str(raised.value.hint)
    assert not (tmp_path / "video.mp4").exists()


@pytest.mark.parametrize(
    ("codec", "fps", "height", "width"),
    [
        (LOSSLESS, 10, 1, 1),
        (LOSSLESS, 1e-3, 2, (1 << 16) - 1),
        (LOSSLESS, 9999.99, 3, 5),
        (LOSSY, 240, 65, 67),
        (LOSSY, 1e-2, 64, 8704),
    ],
)
def test_what_just_fits_a_codec(
    tmp_path: Path, codec: Codec, fps: float, height: int, width: int
) -> None:
    images = np.zeros((2, height, width, 3), np.uint8)
    assert write(tmp_path / "video.mp4", images, codec, fps).shape == images.shape


RATES = st.one_of(
    st.sampled_from([12.5, 0.5, 30000 / 1001, 29.97, 1 / 3, 15, 240]),
    st.floats(0.01, 240),
    st.fractions(Fraction(1, 100), 240).map(float),
)


@given(
    st.sampled_from([LOSSLESS, LOSSLESS, LOSSLESS, LOSSY]),
    RATES,
    st.integers(1, 40),
    st.tuples(st.integers(0, 20), st.integers(0, 20)),
    st.data(),
)
@settings(max_examples=25)
def test_what_is_written_is_read(
    codec: Codec, fps: float, length: int, beyond: tuple[int, int], data: st.DataObject
) -> None:
    """Sizes from the smallest one on, odd ones, too, any number of frames, at any rate."""
    height, width = (codec.sides[0] + more for more in beyond)
    images = noise(length, length, height, width)
    start = data.draw(st.integers(0, length - 1))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "v.mp4"
        found = write(path, images, codec, fps)
        assert len(found) == length
        if codec.exact:
            np.testing.assert_array_equal(found, images)
        rest = np.stack(list(iter_frames(path, start, length, fps, found.shape[1:])))
        np.testing.assert_array_equal(rest, found[start:])
        times = read_times(path)
        assert (len(times), times.first_number(fps)) == (length, 0)
        # LeRobot looks for times within 0.1 ms.
        expected = np.arange(length) / fps
        np.testing.assert_allclose(times.ticks * float(times.tick_s), expected, 1e-6, 1e-4)


@pytest.mark.slow
def test_the_lossy_encoder_does_not_crash_from_its_smallest_size_on(tmp_path: Path) -> None:
    # SVT-AV1 ends the process with SIGFPE or SIGSEGV on some small frames.
    for side in range(64, 100, 5):
        for height, width in ((64, side), (side, 64), (side, 256)):
            write(tmp_path / "video.mp4", noise(0, 10, height, width), LOSSY)


def test_what_cannot_be_written(tmp_path: Path) -> None:
    images = noise(0, 2, 8, 8)
    with raises(BuildError):
        write(tmp_path / "missing" / "video.mp4", images)
    codec = dataclasses.replace(LOSSLESS, vcodec="libmissing")
    with raises(BuildError):
        write(tmp_path / "video.mp4", images, codec)


def test_a_full_disk_is_one_error_and_nothing_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    encoder = VideoEncoder(tmp_path / "clip.mp4", CLIP, 10, 256, 256)
    with full_disk(1024):
        with raises(BuildError):
            for image in noise(0, 100, 256, 256):
                encoder.add(image)
        del encoder
        gc.collect()
    assert capsys.readouterr().err == ""
