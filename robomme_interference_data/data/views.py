"""Stored first live views of queries, with or without a shift of the scene."""

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, SHIFTED
from robomme_interference_data.errors import MissingFileError
from robomme_interference_data.schema.shifts import SHIFTS, Shift
from robomme_interference_data.storage.files import LocalFiles

from .buffer import Buffer
from .buffer_set import BufferSet
from .dataset import Dataset
from .embeddings import BufferSetIndex


def live_frame(
    buffer_set: BufferSet, buffer: Buffer, shift: Shift | None, camera: str = "front"
) -> NDArray[np.uint8]:
    """Decode the stored first live view of a buffer's query, `(H, W, 3) uint8` RGB."""
    if shift is None:
        return buffer.query.frame(camera)
    views, number = _views(buffer_set), SHIFTS.index(shift)
    [frame] = views.iter_frames(views.index_of(buffer.episode_id), camera, number, number + 1)
    return frame


def live_embedding(
    buffer_set: BufferSet, buffer: Buffer, shift: Shift | None, encoder: str, camera: str = "front"
) -> NDArray[np.float32]:
    """Read the embedding of the stored first live view of a buffer's query, `(D,) float32`."""
    if shift is None:
        return buffer.query_embedding(encoder, camera)
    views, number = _views(buffer_set), SHIFTS.index(shift)
    datasets = {DISTRACTORS: buffer_set.datasets[DISTRACTORS], SHIFTED: views}
    index = BufferSetIndex(datasets, encoder, camera)
    return index.span(SHIFTED, views.index_of(buffer.episode_id), number, number + 1)[0]


def _views(buffer_set: BufferSet) -> Dataset:
    if SHIFTED in buffer_set.datasets:
        return buffer_set.datasets[SHIFTED]
    what = f"{buffer_set.location} has no first live views under shifts"
    if not isinstance(buffer_set.files, LocalFiles):
        raise MissingFileError(what, "Ask its publisher to add them.")
    source = next(iter(buffer_set.datasets[DEMONSTRATIONS].identity.simulators), "SIMULATOR")
    raise MissingFileError(
        what,
        "If the simulator of its demonstrations supports shifts, build them, then run build "
        "manifests and index again.",
        f"build {SHIFTED} --source {source} --split test --out {buffer_set.location}/{SHIFTED}",
    )
