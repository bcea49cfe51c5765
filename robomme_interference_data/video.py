"""Decode spans of frames from a video file: the only place that reads video.

A LeRobot v3 video file holds many episodes one after the other at a constant frame rate, so a
frame is named by its number in the file: its presentation time multiplied by the rate.
"""

from collections.abc import Generator
from contextlib import closing
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError, MissingFileError, TruncatedVideoError


def iter_frames(
    path: Path,
    start: int,
    stop: int | None,
    fps: float,
    shape: tuple[int, ...] | None = None,
) -> Generator[NDArray[np.uint8]]:
    """Decode the frames `start` (included) to `stop` (excluded) of a video file, in order.

    Decoding runs on the calling thread and holds one frame at a time. Every frame's presentation
    time is checked, so that a frame can neither be missing nor come twice.

    Args:
        path: The video file.
        start: Number of the first frame in the file.
        stop: Number after the last frame; None for all that there are.
        fps: Constant frame rate of the file, in Hz.
        shape: Shape that every frame must have, `(H, W, 3)`; None for any.

    Yields:
        Frames, `(H, W, 3) uint8` RGB. The array is the caller's.

    Raises:
        MissingFileError: There is no such file.
        FormatError: The file is not a video, its frames are not evenly spaced at `fps`, or they
            are of another shape.
        TruncatedVideoError: The file ends before `stop`, or a frame is missing.
    """
    expected = start
    with closing(_indexed_frames(path, start, fps)) as frames:
        if stop is not None and start >= stop:
            return
        for number, frame in frames:
            if number != expected:
                raise TruncatedVideoError(
                    f"{path}: frame {expected} is missing (the next one found is {number})",
                    "The file is damaged: download or build it again.",
                )
            image = _to_rgb(frame)
            if shape is not None and image.shape != shape:
                raise FormatError(
                    f"{path}: frames are {image.shape[1]}×{image.shape[0]} pixels; the dataset's "
                    f"info.json says {shape[1]}×{shape[0]}"
                )
            yield image
            expected += 1
            if expected == stop:
                return
    if stop is not None or expected == start:
        wanted = "at least one frame" if stop is None else f"frames {start} to {stop - 1}"
        raise TruncatedVideoError(
            f"{path}: the video ends before frame {expected}; expected {wanted}",
            "The file is damaged or incomplete: download or build it again.",
        )


def _to_rgb(frame: av.VideoFrame) -> NDArray[np.uint8]:
    # Planar RGB (the lossless codec) is only re-arranged, without the colour converter.
    return frame.to_ndarray() if frame.format.name == "gbrp" else frame.to_ndarray(format="rgb24")


def _indexed_frames(path: Path, start: int, fps: float) -> Generator[tuple[int, av.VideoFrame]]:
    """Yield `(number, frame)` from frame `start` on."""
    try:
        container = av.open(str(path))
    except FileNotFoundError:
        raise MissingFileError(f"{path} does not exist") from None
    except (av.error.FFmpegError, OSError, ValueError) as error:  # ValueError: a damaged header
        raise FormatError(f"{path} is not a readable video: {error}") from error
    with container:
        if not container.streams.video:
            raise FormatError(f"{path} holds no video stream")
        stream = container.streams.video[0]
        if stream.codec_context is None:  # a header cut short; PyAV would crash the process
            raise FormatError(f"{path} is not a readable video: its codec is not known")
        stream.thread_count = 1  # sessions are decoded side by side instead
        tick = float(stream.time_base) * fps
        try:
            if start > 0:
                container.seek(round(start / tick), stream=stream, backward=True)
            first = True
            for frame in container.decode(stream):
                number = _number(path, frame, tick, fps)
                if first and number > start:
                    # The seek index was off (some muxers mark no earlier key frame): read from
                    # the beginning instead, slower and always right.
                    container.seek(0, stream=stream, backward=True)
                    yield from (
                        (n, f)
                        for f in container.decode(stream)
                        if (n := _number(path, f, tick, fps)) >= start
                    )
                    return
                first = False
                if number >= start:
                    yield number, frame
        except av.error.FFmpegError as error:
            raise TruncatedVideoError(
                f"{path}: decoding stopped: {error}",
                "The file is damaged or incomplete: download or build it again.",
            ) from error


def _number(path: Path, frame: av.VideoFrame, tick: float, fps: float) -> int:
    if frame.pts is None:
        raise FormatError(f"{path}: a frame has no presentation time")
    position = frame.pts * tick
    number = round(position)
    if abs(position - number) > 0.1:
        raise FormatError(
            f"{path}: a frame lies at {position / fps:.4f} s, between frames {int(position)} and "
            f"{int(position) + 1} at {fps:g} frames per second"
        )
    return number
