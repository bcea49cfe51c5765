"""A buffer as one web page: `robomme-interference show … --html page.html`.

The page needs no other file and no network: it holds the stored video files of the buffer's
sessions, so that its pictures are the stored pixels.
"""

import base64
import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import av
import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import counted
from robomme_interference_data.schema.manifest import Session
from robomme_interference_data.schema.sampling import even_sample, runs
from robomme_interference_data.storage.files import write_text
from robomme_interference_data.storage.video.encode import png

from .figure import ink_on
from .filmstrip import round_step, session_colors
from .templates import fill

if TYPE_CHECKING:
    from robomme_interference_data.data.buffer import Buffer
    from robomme_interference_data.data.buffer_set import BufferSet

_THUMB = 112
"""Longest side of a picture of the sample, px: twice its size on a phone."""

_TICKS = 7
"""Most labeled frames of the timeline."""


@dataclass(frozen=True)
class RetrievedPart:
    """The frames that a retrieval step chooses from a buffer.

    Attributes:
        name: Encoder and rule, such as `thumbnail/max/adaptive`.
        frames: The chosen frames, ascending.
        grade: How they compare with the true lesson, in words.
    """

    name: str
    frames: Sequence[int]
    grade: str


def write_page(
    buffer_set: "BufferSet",
    buffer: "Buffer",
    out: Path,
    live: Mapping[str, NDArray[np.uint8]],
    retrieved: Sequence[RetrievedPart] = (),
) -> int:
    """Write the page; the same bytes for the same buffer and version of this package.

    Args:
        buffer_set: The buffer set of the buffer.
        buffer: The buffer.
        out: File to write.
        live: The first live observation of each camera that the page shows, `(H, W, 3) uint8`.
        retrieved: What retrieval steps choose.

    Returns:
        The size of the page in bytes.
    """
    videos: dict[Path, str] = {}
    places = [_place(buffer_set, session, tuple(live), videos) for session in buffer.sessions]
    script = resources.files(__package__).joinpath("templates/_buffer.js").read_text("utf-8")
    data = {"fps": buffer.query.dataset.fps, "frames": len(buffer), "sessions": places}
    values = {
        "buffer": buffer,
        "manifest": buffer.manifest,
        "name": buffer_set.name,
        "revision": buffer_set.revision,
        "version": metadata.version("robomme-interference-data"),
        "sessions": _sessions(buffer),
        "sample": _sample(buffer, next(iter(live))),
        "evidence": _evidence(buffer, retrieved),
        "retrieved": [
            {
                "part": part,
                "runs": runs(part.frames),
                "chosen": counted(len(part.frames), "frame"),
                "by_session": Counter(buffer.session_index[list(part.frames)].tolist()),
            }
            for part in retrieved
        ],
        "ticks": range(0, len(buffer), round_step(len(buffer), _TICKS)),
        "live": {camera: _address(png(image)) for camera, image in live.items()},
        "videos": [_read(path) for path in videos],
        "data": json.dumps(data),
        "script": script,
        # The page's policy runs this script alone: a goal from a stranger cannot add one.
        "script_hash": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
    }
    text = fill(__package__, "buffer.html.j2", values, what="the page", autoescape=True)
    write_text(out, text)
    return len(text.encode())


def _place(
    buffer_set: "BufferSet", session: Session, cameras: Sequence[str], videos: dict[Path, str]
) -> dict[str, Any]:
    """Return where a session's frames are, for the script; adds its files to `videos`."""
    entry = session.entry
    stored = [
        buffer_set.datasets[entry.dataset].video_of(entry.episode_index, camera)
        for camera in cameras
    ]
    for path, _ in stored:
        # Sessions of one file, such as the halves of a lesson, share its copy in the page.
        videos.setdefault(path, f"video-{len(videos)}")
    return {
        "start": session.start,
        "stop": session.stop,
        "first": entry.start,
        "repeat": entry.repeat,
        "files": [videos[path] for path, _ in stored],
        "offsets": [offset for _, offset in stored],
    }


def _sessions(buffer: "Buffer") -> list[dict[str, Any]]:
    sample = even_sample(len(buffer))
    return [
        {
            "session": session,
            "color": color,
            "ink": ink_on(color),
            "share": len(session) / len(buffer),
            "sampled": sum(session.start <= index < session.stop for index in sample),
        }
        for session, color in zip(buffer.sessions, session_colors(buffer.sessions), strict=True)
    ]


def _sample(buffer: "Buffer", camera: str) -> list[dict[str, Any]]:
    """Return the history frames of the even sample, as small pictures."""
    numbers = buffer.session_index
    return [
        {
            "index": index,
            "session": int(numbers[index]),
            "shows": [
                evidence.span.text for evidence in buffer.evidence or () if evidence.seen([index])
            ],
            "picture": _address(png(_small(buffer.frame(index, camera)))),
        }
        for index in even_sample(len(buffer))[:-1]
    ]


def _evidence(buffer: "Buffer", retrieved: Sequence[RetrievedPart]) -> list[dict[str, Any]] | None:
    """Return the evidence, and which of the kept frames show it; None if it is unknown."""
    if buffer.evidence is None:
        return None
    sample = even_sample(len(buffer))
    return [
        {
            "span": evidence,
            "sampled": evidence.seen(sample),
            "retrieved": [evidence.seen(part.frames) for part in retrieved],
        }
        for evidence in buffer.evidence
    ]


def _small(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image that is at most `_THUMB` pixels high and wide."""
    height, width, _ = image.shape
    scale = min(1, _THUMB / max(height, width))
    size = {"height": max(1, round(height * scale)), "width": max(1, round(width * scale))}
    frame = av.VideoFrame.from_ndarray(image, "rgb24")
    return frame.reformat(**size, interpolation="AREA").to_ndarray(format="rgb24")


def _address(picture: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(picture).decode()}"


def _read(path: Path) -> str:
    return base64.b64encode(path.read_bytes()).decode()
