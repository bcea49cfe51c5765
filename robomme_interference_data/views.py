"""The stored first live views of queries under shifts: a dataset that a split may have."""

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DEMONSTRATIONS, SHIFTED
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import MissingFileError, StaleIndexError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.shifts import SHIFTS, Shift
from robomme_interference_data.split import Split


def shifted_frame(
    split: Split, episode_id: EpisodeId, shift: Shift, camera: str = "front"
) -> NDArray[np.uint8]:
    """Decode a query's first live view under a shift, `(H, W, 3) uint8` RGB.

    Raises:
        UnknownNameError: There is no such camera.
        MissingFileError: The split has no such views, or a file is missing.
        FormatError, TruncatedVideoError: Its video cannot be read.
    """
    dataset, place = _views(split), SHIFTS.index(shift)
    [frame] = dataset.iter_frames(dataset.index_of(episode_id), camera, place, place + 1)
    return frame


def shifted_embedding(
    split: Split, episode_id: EpisodeId, shift: Shift, encoder: str, camera: str = "front"
) -> NDArray[np.float16]:
    """Look up the embedding of a query's first live view under a shift, `(D,) float16`.

    For grading without a simulator: in a rollout, what the robot sees is embedded then.

    Raises:
        MissingFileError: The split has no such views.
        MissingIndexError, StaleIndexError, FormatError: See `Dataset.index`.
    """
    dataset, place = _views(split), SHIFTS.index(shift)
    own, base = (one.index(encoder, camera) for one in (dataset, split.datasets[DEMONSTRATIONS]))
    if own.made != base.made:
        raise StaleIndexError(
            f"the embeddings of encoder {encoder!r} were made differently in "
            f"{dataset.files.describe()} and in the demonstrations",
            "Make them again, all at once: robomme-interference index "
            f"{split.location} --encoder {encoder}",
        )
    return own.span(dataset.index_of(episode_id), place, place + 1)[0]


def _views(split: Split) -> Dataset:
    if SHIFTED not in split.datasets:
        raise MissingFileError(
            f"{split.location} has no first live views under shifts",
            f"Type: robomme-interference build {SHIFTED} --source tabletop --split test --out "
            f"{split.location}/{SHIFTED}, then build manifests and index again.",
        )
    return split.datasets[SHIFTED]
