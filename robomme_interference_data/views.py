"""The stored first live views of queries under shifts: a dataset that a split may have."""

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, SHIFTED
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import MissingFileError
from robomme_interference_data.files import LocalFiles
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.shifts import SHIFTS, Shift
from robomme_interference_data.split import Split
from robomme_interference_data.split_index import SplitIndex


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
) -> NDArray[np.float32]:
    """Look up the embedding of a query's first live view under a shift, `(D,) float32`.

    For grading without a simulator: in a rollout, what the robot sees is embedded then.

    Raises:
        MissingFileError: The split has no such views.
        MissingIndexError, StaleIndexError, FormatError: See `SplitIndex`.
    """
    views, place = _views(split), SHIFTS.index(shift)
    needed = {name: split.datasets[name] for name in (DISTRACTORS, SHIFTED)}
    index = SplitIndex(needed, encoder, camera)
    return index.span(SHIFTED, views.index_of(episode_id), place, place + 1)[0]


def _views(split: Split) -> Dataset:
    if SHIFTED not in split.datasets:
        what = f"{split.location} has no first live views under shifts"
        if "tabletop" not in split.datasets[DEMONSTRATIONS].identity.simulators:
            raise MissingFileError(what, "Only a split that was built from tabletop can have them.")
        if not isinstance(split.files, LocalFiles):
            raise MissingFileError(what, "Ask its publisher to add them.")
        raise MissingFileError(
            what,
            f"Type: robomme-interference build {SHIFTED} --source tabletop --split test --out "
            f"{split.location}/{SHIFTED}, then build manifests and index again.",
        )
    return split.datasets[SHIFTED]
