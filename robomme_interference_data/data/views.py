"""The stored first live views of queries, those under shifts too, which a buffer set may have."""

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, SHIFTED
from robomme_interference_data.errors import MissingFileError
from robomme_interference_data.schema.shifts import SHIFTS, Shift
from robomme_interference_data.storage.files import LocalFiles

from .buffer import Buffer
from .buffer_set import BufferSet
from .buffer_set_index import BufferSetIndex
from .dataset import Dataset


def live_frame(
    buffer_set: BufferSet, buffer: Buffer, shift: Shift | None, camera: str = "front"
) -> NDArray[np.uint8]:
    """Decode the stored first live view of a buffer's query, `(H, W, 3) uint8` RGB.

    Args:
        buffer_set: The buffer set.
        buffer: A buffer of it.
        shift: How the scene differs from the lesson's; None if it does not.
        camera: Name of the camera.
    """
    if shift is None:
        return buffer.query.frame(camera)
    views, place = _views(buffer_set), SHIFTS.index(shift)
    [frame] = views.iter_frames(views.index_of(buffer.episode_id), camera, place, place + 1)
    return frame


def live_embedding(
    buffer_set: BufferSet, buffer: Buffer, shift: Shift | None, encoder: str, camera: str = "front"
) -> NDArray[np.float32]:
    """Look up the embedding of the stored first live view of a buffer's query, `(D,) float32`.

    For grading without a simulator: in a rollout, what the robot sees is embedded then.

    Args:
        buffer_set: The buffer set.
        buffer: A buffer of it.
        shift: As for `live_frame`.
        encoder: Name of the encoder.
        camera: Name of the camera.
    """
    if shift is None:
        return buffer.query_embedding(encoder, camera)
    views, place = _views(buffer_set), SHIFTS.index(shift)
    index = BufferSetIndex(
        {DISTRACTORS: buffer_set.datasets[DISTRACTORS], SHIFTED: views}, encoder, camera
    )
    return index.span(SHIFTED, views.index_of(buffer.episode_id), place, place + 1)[0]


def _views(buffer_set: BufferSet) -> Dataset:
    if SHIFTED not in buffer_set.datasets:
        what = f"{buffer_set.location} has no first live views under shifts"
        if not isinstance(buffer_set.files, LocalFiles):
            raise MissingFileError(what, "Ask its publisher to add them.")
        source = next(iter(buffer_set.datasets[DEMONSTRATIONS].identity.simulators), "SIMULATOR")
        raise MissingFileError(
            what,
            "Build them, if the simulator of its demonstrations has shifts; then build manifests "
            "and index again.",
            f"build {SHIFTED} --source {source} --split test --out {buffer_set.location}/{SHIFTED}",
        )
    return buffer_set.datasets[SHIFTED]
