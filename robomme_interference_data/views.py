"""The stored first live views of queries under shifts, for grading without a simulator."""

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DEMONSTRATIONS, SHIFTED
from robomme_interference_data.errors import MissingFileError, StaleIndexError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.shifts import SHIFTS, Shift
from robomme_interference_data.split import Split


def shifted_embedding(
    split: Split, episode_id: EpisodeId, shift: Shift, encoder: str, camera: str = "front"
) -> NDArray[np.float16]:
    """Look up the embedding of a query's first live view under a shift, `(D,) float16`.

    Raises:
        MissingFileError: The split has no such views.
        MissingIndexError, StaleIndexError, FormatError: See `Dataset.index`.
    """
    if SHIFTED not in split.datasets:
        raise MissingFileError(
            f"{split.location} has no first live views under shifts",
            f"Type: robomme-interference build {SHIFTED} --source tabletop --split test --out "
            f"{split.location}/{SHIFTED}, then build manifests and index again.",
        )
    dataset = split.datasets[SHIFTED]
    own, base = (split.datasets[name].index(encoder, camera) for name in (SHIFTED, DEMONSTRATIONS))
    if own.made != base.made:
        raise StaleIndexError(
            f"the embeddings of encoder {encoder!r} were made differently in "
            f"{dataset.files.describe()} and in the demonstrations",
            "Make them again, all at once: robomme-interference index "
            f"{split.location} --encoder {encoder}",
        )
    place = SHIFTS.index(shift)
    return own.span(dataset.index_of(episode_id), place, place + 1)[0]
