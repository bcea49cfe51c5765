"""The retrieval step of questions, ceilings and training, which have no live image of their own."""

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.views import live_embedding
from robomme_interference_data.schema.shifts import Shift

from .selector import RetrievalStep


class StoredSelector(RetrievalStep):
    """Chooses the frames of a history that match its stored first live observation.

    No image is embedded: that view has an embedding in the index, too.
    """

    def select(
        self, buffer_set: BufferSet, buffer: Buffer, shift: Shift | None = None
    ) -> NDArray[np.int64]:
        """Choose the frames of a buffer that match its stored first live observation.

        Args:
            buffer_set: The buffer set of the buffer.
            buffer: The history, with at least one frame.
            shift: Shift of the first live observation.

        Returns:
            Indices in the buffer, ascending, `(n,) int64`, n at least 1.
        """
        live = live_embedding(buffer_set, buffer, shift, self.encoder, self.camera)
        return self.matching_frames(buffer, live)
