"""A buffer as a recording for the Rerun viewer: `robomme-interference show … --rerun file.rrd`."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.schema.sampling import even_sample
from robomme_interference_data.storage.files import atomic_path
from robomme_interference_data.storage.video.encode import png

if TYPE_CHECKING:
    from robomme_interference_data.data.buffer import Buffer


def write_recording(buffer: "Buffer", out: Path, live: Mapping[str, NDArray[np.uint8]]) -> None:
    """Write a recording with the timeline `frame`, whose last moment is the live observation.

    Entities: `<camera>` (PNG), `state`, `session` (its number), `evidence` and `sample` (1 where a
    frame shows the answer, or is in the even sample), and `text` (which session begins, and what
    evidence shows).

    Args:
        buffer: The buffer.
        out: File to write, `.rrd`.
        live: The first live observation of each camera to write, `(H, W, 3) uint8`.

    Raises:
        MissingExtraError: rerun-sdk is not installed.
    """
    rerun = _load_rerun()
    name = f"{buffer.episode_id} {buffer.condition}"
    sample = {*even_sample(len(buffer))}
    with atomic_path(out) as partial:
        recording = rerun.RecordingStream("robomme-interference", recording_id=name)
        recording.save(str(partial))
        recording.send_recording_name(f"{name}: {buffer.goal}")
        states = [
            state for n, _ in enumerate(buffer.sessions) for state in buffer.session_states(n)
        ]
        for chunk in buffer.stream(cameras=tuple(live), other_states="omit"):
            for place, index in enumerate(chunk.indices.tolist()):
                recording.set_time("frame", sequence=index)
                for camera, frames in chunk.frames.items():
                    recording.log(camera, _image(rerun, frames[place]))
                recording.log("state", rerun.Scalars(states[index]))
                recording.log("session", rerun.Scalars(int(chunk.session_index[place])))
                recording.log("sample", rerun.Scalars(int(index in sample)))
                shown = any(entry.seen([index]) for entry in buffer.evidence or ())
                recording.log("evidence", rerun.Scalars(int(shown)))
        for number, session in enumerate(buffer.sessions):
            recording.set_time("frame", sequence=session.start)
            text = f"session {number}: {session.role} {session.source}"
            recording.log("text", rerun.TextLog(text))
        for entry in buffer.evidence or ():
            recording.set_time("frame", sequence=entry.start)
            recording.log("text", rerun.TextLog(f"shows the answer: {entry.span.text}"))
        recording.set_time("frame", sequence=len(buffer))
        for camera, image in live.items():
            recording.log(camera, _image(rerun, image))
        recording.log("state", rerun.Scalars(buffer.query.state()))
        recording.log("text", rerun.TextLog("first live observation"))
        recording.flush()
        # Closes the file, which only then gets its name.
        recording.disconnect()


def _image(rerun: Any, image: NDArray[np.uint8]) -> Any:
    return rerun.EncodedImage(contents=png(image), media_type="image/png")


def _load_rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise MissingExtraError(
            "writing a recording for Rerun needs rerun-sdk, which is not installed",
            "Install it: pip install rerun-sdk",
        ) from error
    return rerun
