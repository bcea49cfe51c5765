"""The embeddings of a buffer set: features from each dataset's index, centred on the distractor units.

This is the one place where features become embeddings, those of stored frames and of live images.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import DISTRACTORS
from robomme_interference_data.errors import MissingFileError

from .embeddings import EncoderRecord, Remedy

if TYPE_CHECKING:
    from .dataset import Dataset


def normalised(
    features: NDArray[Any], centre: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Turn what an encoder makes of images into embeddings of length 1.

    Features are rounded as an index keeps them, so that equal images have equal embeddings, whether
    they are stored or live.

    Args:
        features: `(T, D)` float.
        centre: `(D,) float32`, taken off first, or None.

    Returns:
        `(T, D) float32`; a row of noughts, which resembles nothing, where nothing is left.
    """
    values = features.astype(np.float16, copy=False).astype(np.float32)
    if centre is not None:
        values -= centre
    lengths = np.sqrt(np.einsum("td,td->t", values, values))
    values /= np.where(lengths > 0, lengths, 1)[:, None]
    return values


class BufferSetIndex:
    """The indexes of a buffer set's datasets, of one encoder and camera, and what they have in common.

    Args:
        datasets: Those datasets of the buffer set that are needed, the distractor units among them.
        encoder: Name of the encoder, such as `thumbnail`.
        camera: Name of the camera, with or without `observation.images.`.
    """

    def __init__(self, datasets: Mapping[str, "Dataset"], encoder: str, camera: str = "front"):
        if DISTRACTORS not in datasets:
            what = f"a buffer set without {DISTRACTORS} has nothing to centre embeddings on"
            raise MissingFileError(what)
        self._indexes = {name: one.index(encoder, camera) for name, one in datasets.items()}
        self._units = units = self._indexes[DISTRACTORS]
        for name, index in self._indexes.items():
            if index.made != units.made:
                places = (datasets[one].files.describe() for one in (name, DISTRACTORS))
                raise MissingFileError(
                    f"the embeddings of encoder {encoder!r} were made differently in "
                    f"{' and in '.join(places)}",
                    *index.remedy,
                )

    @property
    def encoder(self) -> EncoderRecord:
        """The encoder, as all of the indexes record it."""
        return self._units.header.encoder

    @property
    def remedy(self) -> Remedy:
        """How they are made."""
        return self._units.remedy

    @property
    def size(self) -> int:
        """Values in an embedding."""
        return self._units.header.size

    @property
    def typical_cosine(self) -> float:
        """Median cosine of two frames of different distractor units; see `EmbeddingIndex`."""
        return self._units.typical_cosine

    def embed(self, features: NDArray[Any]) -> NDArray[np.float32]:
        """Return the embeddings of images whose features the encoder has just made.

        Args:
            features: `(T, size)` float.

        Returns:
            `(T, size) float32`, each of length 1.
        """
        return normalised(features, self._units.centre)

    def span(self, dataset: str, episode_index: int, start: int, stop: int) -> NDArray[np.float32]:
        """Return the embeddings of stored frames `start` to `stop` (excluded) of an episode.

        Args:
            dataset: Name of the dataset in the buffer set.
            episode_index: The episode in it.
            start: First frame.
            stop: Frame after the last one.

        Returns:
            `(stop - start, size) float32`, each of length 1; a new array.
        """
        return self.embed(self._indexes[dataset].span(episode_index, start, stop))
