"""Images and videos in the form in which models get them."""

import base64
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.evaluate.run.history import HistoryReader
from robomme_interference_data.schema.sampling import spread
from robomme_interference_data.storage.video.encode import CLIP, MODEL_VIDEO, VideoEncoder

from .models import Message, Part, Video


def within(messages: Iterable[Message], images: int | None) -> list[Message]:
    """Return messages with at most so many images; None: unchanged.

    Videos become evenly spread images, and the longest ones are thinned out first.
    """
    if images is None:
        return list(messages)
    messages = list(messages)
    parts = [part for message in messages for part in message.parts]
    lengths = [len(part.frames) for part in parts if isinstance(part, Video)]
    left = max(0, images - sum(isinstance(part, np.ndarray) for part in parts))
    shares = iter(_shares(lengths, left))
    return [
        Message(
            message.role,
            tuple(thinned for part in message.parts for thinned in _thin(part, shares)),
        )
        for message in messages
    ]


def _shares(lengths: Sequence[int], left: int) -> list[int]:
    """Return how many frames each video keeps, so that they are `left` at most."""
    top = max(lengths, default=0)
    while sum(min(length, top) for length in lengths) > left:
        top -= 1
    return [min(length, top) for length in lengths]


def _thin(part: Part, shares: Iterable[int]) -> tuple[Part, ...]:
    if not isinstance(part, Video):
        return (part,)
    return tuple(part.frames[place] for place in spread(0, len(part.frames), next(iter(shares))))


def mp4(video: Video) -> bytes:
    """Return a video as H.264 in MP4, without an odd last row or column."""
    height, width = (side // 2 * 2 for side in video.frames.shape[1:3])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "video.mp4"
        # The published systems' codec varies from run to run with other sizes, see `CLIP`.
        codec = CLIP if height % 16 or width % 16 else MODEL_VIDEO
        encoder = VideoEncoder(path, codec, video.fps, height, width)
        for frame in video.frames:
            encoder.add(np.ascontiguousarray(frame[:height, :width]))
        encoder.close()
        return path.read_bytes()


def data_url(media_type: str, data: bytes) -> str:
    """Return bytes as a `data:` URL of a media type such as `image/png`."""
    return f"data:{media_type};base64,{base64.b64encode(data).decode()}"


class HistoryFrames:
    """The history frames that a policy gets, of the first camera; decoded on request."""

    def __init__(self, buffer: Buffer, indices: Sequence[int], reader: HistoryReader):
        self._buffer, self._indices, self._reader = buffer, indices, reader

    @property
    def camera(self) -> str:
        """The camera of the frames; subgoals' points are in its live images."""
        return self._buffer.query.dataset.camera()

    def __len__(self) -> int:
        return len(self._indices)

    def frames(self, places: Sequence[int]) -> NDArray[np.uint8]:
        """Decode frames by their ascending places, `(n, H, W, 3) uint8` RGB."""
        indices = [self._indices[place] for place in places]
        chunks = self._reader.stream(self._buffer, 64, (self.camera,), indices, other_states="omit")
        return np.concatenate([chunk.frames[self.camera] for chunk in chunks])

    def video(self, places: Sequence[int], fps: float | None = None) -> Video:
        """Decode frames as a video of `fps` frames per second; None for the recorded pace."""
        if fps is None:
            fps, steps = self._buffer.query.dataset.fps, places[-1] - places[0]
            fps *= (len(places) - 1) / steps if steps else 1
        return Video(self.frames(places), fps)
