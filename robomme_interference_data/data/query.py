"""A query episode without its buffer: its goal and the first live observation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import STATE
from robomme_interference_data.errors import FormatError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.manifest import QueryFrame
from robomme_interference_data.schema.records import EpisodeRecord

from .dataset import Dataset


@dataclass(frozen=True)
class Query:
    """A query episode, returned by `BufferSet.query`.

    Attributes:
        dataset: The demonstrations.
        record: The episode's record.
    """

    dataset: Dataset
    record: EpisodeRecord

    def __repr__(self) -> str:
        return f"Query({self.episode_id}, difficulty={self.difficulty}, goal={self.goal!r})"

    @property
    def episode_id(self) -> EpisodeId:
        """Id of the episode."""
        return self.record.episode_id

    @property
    def goal(self) -> str:
        """The goal in words: the first of its wordings."""
        return self.record.goal

    @property
    def seed(self) -> int | None:
        """Seed of the episode in its simulator, or None."""
        return self.record.seed

    @property
    def difficulty(self) -> str | None:
        """`easy`, `medium`, `hard`, or None."""
        return self.record.difficulty

    @property
    def simulator(self) -> str | None:
        """Simulator that the episode belongs to, or None."""
        return self.record.simulator

    @property
    def first_counts(self) -> bool:
        """Whether the first of several lessons counts, as its goal says, instead of the last."""
        return self.record.ability == "order-first"

    @property
    def lesson_frames(self) -> int:
        """Frames of its demonstration, without the first live observation."""
        start = self.record.exec_start_idx
        if start is None:
            where = self.dataset.files.describe()
            raise FormatError.damaged(where, f"{self.episode_id}: no lesson")
        return start

    @property
    def first_frame(self) -> QueryFrame:
        """Where the first live observation is stored."""
        dataset, index = self.dataset, self.record.episode_index
        return QueryFrame(dataset.kind, dataset.revision, index, self.lesson_frames)

    def frame(self, camera: str | None = None) -> NDArray[np.uint8]:
        """Decode the first live observation, `(H, W, 3) uint8` RGB; of the first camera by default.

        Raises:
            UnknownNameError: There is no such camera.
            MissingFileError, FormatError: Its video cannot be read.
        """
        start, index = self.lesson_frames, self.record.episode_index
        [frame] = self.dataset.iter_frames(index, camera, start, start + 1)
        return frame

    def state(self) -> NDArray[np.float32]:
        """Return the state at the first live observation, `(8,) float32`; see `Buffer.states`."""
        start, index = self.lesson_frames, self.record.episode_index
        return self.dataset.read_vectors(index, STATE, start, start + 1)[0]
