"""Colors and rotation of decoded frames are those that the file states."""

import struct
from pathlib import Path

import av
import numpy as np
import pytest
from numpy.typing import NDArray
from support.messages import raises

from robomme_interference_data.errors import FormatError
from robomme_interference_data.storage.video.frames import iter_frames
from robomme_interference_data.storage.video.pixels import to_rgb, turn

# --- colors --------------------------------------------------------------------------------------

# Y = Kr R + Kg G + Kb B, Cb = (B - Y) / (2 - 2 Kb), Cr = (R - Y) / (2 - 2 Kr), with R, G, B in
# 0 to 1; then 16 + 219 Y, 128 + 224 Cb and Cr in the limited range, 255 Y, 128 + 255 Cb and Cr in
# the full one. BT.601: Kr 0.299, Kb 0.114; BT.709: Kr 0.2126, Kb 0.0722; BT.2020: Kr 0.2627,
# Kb 0.0593; SMPTE 240M: Kr 0.212, Kb 0.087; FCC: Kr 0.3, Kb 0.11. Red has Y = Kr and Cr = 0.5, so
# in BT.709, limited: 16 + 219 * 0.2126 = 63, 128 - 224 * 0.2126 / 1.8556 = 102, 240.
BT709, UNSTATED, FCC, BT470, BT601, SMPTE240, BT2020 = 1, 2, 4, 5, 6, 7, 9
LIMITED, FULL = 1, 2
RED, GREEN, BLUE, ORANGE = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 128, 0)


@pytest.mark.parametrize(
    ("matrix", "color_range", "yuv", "rgb"),
    [
        (BT709, LIMITED, (63, 102, 240), RED),
        (BT709, LIMITED, (173, 42, 26), GREEN),
        (BT709, LIMITED, (32, 240, 118), BLUE),
        (BT709, FULL, (54, 99, 255), RED),
        (BT601, LIMITED, (81, 90, 240), RED),
        (BT470, LIMITED, (145, 54, 34), GREEN),
        (BT601, LIMITED, (41, 240, 110), BLUE),
        (BT601, FULL, (76, 85, 255), RED),
        # What is not stated.
        (UNSTATED, 0, (81, 90, 240), RED),
        (UNSTATED, FULL, (76, 85, 255), RED),
        (BT709, 0, (63, 102, 240), RED),
        (BT2020, LIMITED, (74, 97, 240), RED),
        # Y = 0.2627 + 0.678 * 0.502 = 0.603
        (BT2020, LIMITED, (148, 56, 188), ORANGE),
        (SMPTE240, LIMITED, (62, 102, 240), RED),
        (FCC, LIMITED, (82, 90, 240), RED),
        # Of grey, the matrix changes nothing: 16 + 219 * 100 / 255 = 102.
        (BT2020, LIMITED, (102, 128, 128), (100, 100, 100)),
        (BT2020, FULL, (100, 128, 128), (100, 100, 100)),
    ],
)
def test_colors_worked_out_by_hand(
    matrix: int, color_range: int, yuv: tuple[int, int, int], rgb: tuple[int, int, int]
) -> None:
    pixels = to_rgb(frame_of(yuv, matrix, color_range))
    assert pixels.shape == (4, 8, 3) and pixels.dtype == np.uint8
    # The numbers above are rounded, and so are those of FFmpeg's tables.
    assert np.abs(pixels.astype(int) - rgb).max() <= 2


@pytest.mark.parametrize(("color_range", "shown"), [(LIMITED, 100), (FULL, 102), (0, 102)])
def test_gray(color_range: int, shown: int) -> None:
    frame = av.VideoFrame.from_ndarray(np.full((4, 8), 102, np.uint8), format="gray")
    frame.color_range = color_range
    np.testing.assert_array_equal(to_rgb(frame), np.full((4, 8, 3), shown, np.uint8))


@pytest.mark.parametrize("matrix", [0, 8, 10, 14])  # RGB, YCgCo, constant luminance, ICtCp
def test_a_matrix_that_is_not_known(matrix: int) -> None:
    with raises(FormatError):
        to_rgb(frame_of((63, 102, 240), matrix, LIMITED))


def frame_of(yuv: tuple[int, int, int], matrix: int, color_range: int) -> av.VideoFrame:
    """Make a frame of one color, of 8 × 4 pixels."""
    planes = np.broadcast_to(np.array(yuv, np.uint8)[:, None, None], (3, 4, 8))
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(planes), format="yuv444p")
    frame.colorspace, frame.color_range = matrix, color_range
    return frame


def test_the_matrix_and_range_in_a_file_are_used(tmp_path: Path) -> None:
    """BT.709 in the full range: Y = 0.2126 * 100 + 0.7152 * 150 + 0.0722 * 200 = 143, Cb = 128 +
    (200 - 143) / 1.8556 = 159, Cr = 128 + (100 - 143) / 1.5748 = 101.
    """
    color = (100, 150, 200)
    for name, options in {"stated": "colormatrix=bt709:fullrange=on", "unstated": ""}.items():
        with av.open(str(tmp_path / f"{name}.mp4"), "w") as container:
            stream = container.add_stream("libx264", 10, options={"qp": "0"})
            stream.options |= {"x264-params": options} if options else {}
            stream.pix_fmt, stream.width, stream.height = "yuv444p", 8, 4
            for _ in range(2):
                container.mux(stream.encode(frame_of((143, 159, 101), UNSTATED, 0)))
            container.mux(stream.encode(None))
    stated, unstated = (
        list(iter_frames(tmp_path / f"{name}.mp4", 0, None, 10)) for name in ("stated", "unstated")
    )
    assert len(stated) == len(unstated) == 2
    assert np.abs(stated[1].astype(int) - color).max() <= 2
    # BT.601, limited: B = 1.164 * (143 - 16) + 2.017 * (159 - 128) = 210
    assert np.abs(unstated[1].astype(int) - color).max() >= 9


# --- rotation ------------------------------------------------------------------------------------

PICTURE = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
"""Two rows of three pixels, all different."""

A, B, C, D, E, F = (PICTURE[row, column] for row in range(2) for column in range(3))
"""A B C in the first row, D E F in the second."""


@pytest.mark.parametrize(
    ("matrix", "rows"),
    [
        ((1, 0, 0, 1), [[A, B, C], [D, E, F]]),
        ((-1, 0, 0, 1), [[C, B, A], [F, E, D]]),  # mirrored left to right
        ((1, 0, 0, -1), [[D, E, F], [A, B, C]]),  # upside down
        ((-1, 0, 0, -1), [[F, E, D], [C, B, A]]),  # by 180°
        ((0, 1, -1, 0), [[D, A], [E, B], [F, C]]),  # by 90° clockwise, as phones held upright
        ((0, -1, 1, 0), [[C, F], [B, E], [A, D]]),  # by 90° counterclockwise
        ((0, 1, 1, 0), [[A, D], [B, E], [C, F]]),  # mirrored along the diagonal
        ((0, -1, -1, 0), [[F, C], [E, B], [D, A]]),
    ],
)
def test_turned_as_stated(
    tmp_path: Path, matrix: tuple[int, ...], rows: list[list[NDArray[np.uint8]]]
) -> None:
    expected = np.stack([np.stack(row) for row in rows])
    np.testing.assert_array_equal(turn(PICTURE, display_matrix(*matrix)), expected)
    frames = list(iter_frames(turned_video(tmp_path, display_matrix(*matrix)), 0, None, 10))
    assert len(frames) == 3
    for frame in frames:
        np.testing.assert_array_equal(frame, expected)
        assert frame.flags.c_contiguous and frame.flags.writeable
    shape = expected.shape
    assert len(list(iter_frames(tmp_path / "turned.mp4", 1, 3, 10, shape))) == 2
    if shape[:2] != PICTURE.shape[:2]:
        with pytest.raises(FormatError):
            list(iter_frames(tmp_path / "turned.mp4", 1, 3, 10, PICTURE.shape))


@pytest.mark.parametrize(
    "matrix", [(0.7, 0.7, -0.7, 0.7), (2, 0, 0, 2), (0, 0, 0, 0), (1, 1, 0, 1)]
)
def test_no_quarter_turn(tmp_path: Path, matrix: tuple[float, ...]) -> None:
    path = turned_video(tmp_path, display_matrix(*matrix))
    with raises(FormatError):
        list(iter_frames(path, 0, None, 10))


def display_matrix(a: float, b: float, c: float, d: float) -> NDArray[np.int32]:
    """Return the matrix of a container: columns of what is shown, rows of it, and an offset."""
    one = 1 << 16
    return np.array([[a * one, b * one, 0], [c * one, d * one, 0], [0, 0, 1 << 30]], dtype=np.int32)


def turned_video(folder: Path, matrix: NDArray[np.int32]) -> Path:
    """Write the picture three times, with a display matrix in the header of the track."""
    path = folder / "turned.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264rgb", 10, options={"qp": "0"})
        stream.pix_fmt, stream.height, stream.width = "rgb24", *PICTURE.shape[:2]
        for _ in range(3):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(PICTURE, format="rgb24")))
        container.mux(stream.encode(None))
    data = bytearray(path.read_bytes())
    # After the name: version and flags, times, number, duration, and 16 bytes more.
    start = data.index(b"tkhd") + 4 + 4 + 20 + 16
    assert data[start : start + 36] == struct.pack(">9i", *display_matrix(1, 0, 0, 1).flat)
    data[start : start + 36] = struct.pack(">9i", *matrix.ravel().tolist())
    path.write_bytes(data)
    return path
