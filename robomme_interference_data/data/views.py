"""Stored first live observations of queries, with or without a shift of the scene."""

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DISTRACTORS, SHIFTED
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.shifts import SHIFTS, Shift

from .buffer import Buffer
from .buffer_set import BufferSet
from .dataset import Dataset
from .embeddings import BufferSetIndex
from .loading import open_dataset


def live_frame(
    buffer_set: BufferSet, buffer: Buffer, shift: Shift | None, camera: str | None = None
) -> NDArray[np.uint8]:
    """Decode the stored first live observation of a buffer's query, `(H, W, 3) uint8` RGB."""
    if shift is None:
        return buffer.query.frame(camera)
    views, stored, number = shifted_view(buffer_set, buffer.episode_id, shift)
    [frame] = views.iter_frames(stored, camera, number, number + 1)
    return frame


def live_embedding(
    buffer_set: BufferSet,
    buffer: Buffer,
    shift: Shift | None,
    encoder: str,
    camera: str | None = None,
) -> NDArray[np.float32]:
    """Read the embedding of a buffer's stored first live observation, `(D,) float32`."""
    if shift is None:
        return buffer.query_embedding(encoder, camera)
    views, stored, number = shifted_view(buffer_set, buffer.episode_id, shift)
    datasets = {DISTRACTORS: buffer_set.datasets[DISTRACTORS], SHIFTED: views}
    index = BufferSetIndex(datasets, encoder, camera)
    return index.span(SHIFTED, stored, number, number + 1)[0]


def shifted_view(
    buffer_set: BufferSet, episode: EpisodeId, shift: Shift
) -> tuple[Dataset, int, int]:
    """Return dataset, episode index and frame of a query's first live observation under a shift.

    Raises:
        MissingFileError: The buffer set has no views under shifts.
    """
    views = open_dataset(buffer_set, SHIFTED, "For retrieval, run index again, too.")
    return views, views.index_of(episode), SHIFTS.index(shift)
