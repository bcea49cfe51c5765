"""Read frames of video files by their numbers, and the times of all frames.

A LeRobot v3 video file holds consecutive episodes at a constant frame rate, so a frame is
identified by its number in the file: its presentation time multiplied by the rate, and rounded to
the nearest number, of which each must have exactly one frame. An AVI file stores no presentation
times: its frames are counted, in the order in which they are shown.
"""

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError

from .file import REWRITE, open_video, reason
from .pixels import to_rgb

_LATEST = 1 << 62
"""Upper bound on the ticks of a container to which FFmpeg can seek."""


def rate_fraction(fps: float) -> Fraction:
    """Return a frame rate of 0.001 or more as a fraction: NTSC's 29.97… as 30000/1001."""
    # The denominator keeps times of 10,000 frames per second within the 32 bits of MP4.
    return Fraction(fps).limit_denominator(100_000)


def iter_frames(
    path: Path,
    start: int,
    stop: int | None,
    fps: float,
    shape: tuple[int, ...] | None = None,
    first_s: float = 0.0,
) -> Generator[NDArray[np.uint8]]:
    """Decode the frames `start` to `stop` (excluded; None for all) of a video file, in order.

    Frames are `(H, W, 3) uint8` RGB, with the colors and the rotation that the file states (see
    `pixels.to_rgb`); `shape` is the shape that they must have. Decoding runs on the calling thread
    and holds one frame at a time. Every frame's presentation time is checked, so that no frame is
    missing or duplicated.

    Args:
        path: The file.
        start: Number of the first frame.
        stop: Number after the last frame, or None.
        fps: Frames per second.
        shape: `(H, W, 3)`, or None for any.
        first_s: Presentation time of frame 0, in seconds.

    Raises:
        MissingFileError: There is no such file.
        FormatError: It is no video that can be read, its frames are not evenly spaced in time, one
            of those asked for is missing, or their shape is another one.
    """
    expected = start
    with closing(_numbered_frames(path, start, fps, first_s)) as frames:
        if stop is not None and start >= stop:
            return
        for number, frame in frames:
            if number != expected:
                raise _uneven(path, fps, expected - 1, number)
            try:
                pixels = to_rgb(frame)
            except FormatError as error:
                raise error.about(path) from None
            if shape is not None and pixels.shape[:2] != shape[:2]:
                raise _other_shape(path, pixels.shape, shape)
            yield pixels
            expected += 1
            if expected == stop:
                return
    if stop is not None or expected == start:
        frames_expected = "a frame" if stop is None else f"frames {start} to {stop - 1}"
        what = f"the video ends before frame {expected}; expected {frames_expected}"
        raise FormatError.damaged(path, what)


@dataclass(frozen=True)
class FrameTimes:
    """When the frames of a video file are shown, as its container states, without decoding.

    Attributes:
        path: The file.
        ticks: Presentation times in ascending order, `(T,) int64`.
        tick_s: Duration of a tick in seconds.
    """

    path: Path
    ticks: NDArray[np.int64]
    tick_s: Fraction

    def __len__(self) -> int:
        return len(self.ticks)

    @property
    def first_s(self) -> float:
        """Presentation time of the first frame in seconds."""
        return float(int(self.ticks[0]) * self.tick_s)

    @property
    def last_s(self) -> float:
        """Presentation time of the last frame in seconds."""
        return float(int(self.ticks[-1]) * self.tick_s)

    def first_number(self, fps: float, first_s: float = 0.0) -> int:
        """Return the number of the first frame, after which the others have the next numbers.

        Raises:
            FormatError: They do not: at this rate, a number has no frame, or several ones.
        """
        numbers = np.rint((self.ticks * float(self.tick_s) - first_s) * fps)
        wrong = np.flatnonzero(np.diff(numbers) != 1)
        if len(wrong):
            before, after = numbers[wrong[0] : wrong[0] + 2]
            raise _uneven(self.path, fps, int(before), int(after))
        return int(numbers[0])


def read_times(path: Path) -> FrameTimes:
    """Read the presentation times of all frames of a video file.

    Raises:
        MissingFileError: There is no such file.
        FormatError: It is no video that can be read, or has no frames or no times.
    """
    with open_video(path) as (container, stream):
        counted = _is_counted(container)
        ticks = []
        try:
            for packet in container.demux(stream):
                # The last packet is empty; others lie before the edit at which the video begins.
                if packet.size and not packet.is_discard:
                    # In AVI, packets have numbers in the order of decoding.
                    tick = packet.dts if counted else packet.pts
                    if tick is None:
                        raise FormatError(f"{path}: a frame has no presentation time", REWRITE)
                    ticks.append(tick)
        except av.error.FFmpegError as error:
            raise FormatError.damaged(path, f"reading stopped: {reason(error)}") from error
        if not ticks:
            raise FormatError.damaged(path, "the video has no frames")
        return FrameTimes(path, np.sort(np.array(ticks, np.int64)), stream.time_base)


def _numbered_frames(
    path: Path, start: int, fps: float, first_s: float
) -> Generator[tuple[int, av.VideoFrame]]:
    """Yield `(number, frame)` from frame `start` on."""
    with open_video(path) as (container, stream):
        tick_s = float(stream.time_base)
        begin = (first_s + start / fps) / tick_s
        if begin >= _LATEST:
            raise FormatError.damaged(path, f"there is no frame {start} at {fps:g} Hz")
        try:
            if _is_counted(container):
                frames = enumerate(container.decode(stream))
                yield from (numbered for numbered in frames if numbered[0] >= start)
                return
            if start > 0:
                container.seek(round(begin), stream=stream, backward=True)
            first = True
            for frame in container.decode(stream):
                number = _number(path, frame, tick_s, fps, first_s)
                if first and number > start > 0:
                    # The seek went too far (some muxers mark no earlier key frame): read from the
                    # beginning, which is slower and always right.
                    container.seek(0, stream=stream, backward=True)
                    for earlier in container.decode(stream):
                        number = _number(path, earlier, tick_s, fps, first_s)
                        if number >= start:
                            yield number, earlier
                    return
                first = False
                if number >= start:
                    yield number, frame
        except av.error.FFmpegError as error:
            raise FormatError.damaged(path, f"decoding stopped: {reason(error)}") from error


def _is_counted(container: av.container.InputContainer) -> bool:
    return container.format.name == "avi"


def _number(path: Path, frame: av.VideoFrame, tick_s: float, fps: float, first_s: float) -> int:
    if frame.pts is None:
        raise FormatError(f"{path}: a frame has no presentation time", REWRITE)
    return round((frame.pts * tick_s - first_s) * fps)


def _other_shape(path: Path, found: tuple[int, ...], shape: tuple[int, ...]) -> FormatError:
    return FormatError(
        f"{path}: frames have {found[1]}×{found[0]} pixels; expected {shape[1]}×{shape[0]}, as "
        "in the dataset's info.json",
        "Correct info.json, or write the video again.",
    )


def _uneven(path: Path, fps: float, before: int, after: int) -> FormatError:
    """Return the error for a frame that has not the number after the one before."""
    what = f"frame {before + 1} is missing; the next is {after}"
    if after <= before:
        what = f"two frames would be frame {after}"
    rate = rate_fraction(fps)
    return FormatError(
        f"{path}: at {fps:g} frames per second, {what}",
        "The video has a variable frame rate, or another one than stated. Give its frames even "
        f"times: ffmpeg -i OLD -vf settb={1 / rate},setpts=N,fps={rate} -c:v ffv1 NEW.mkv",
    )
