"""The retrieval step of a rollout: embed the live image, and choose frames of the history."""

from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.embeddings import BufferSetIndex
from robomme_interference_data.data.index_layout import index_folder
from robomme_interference_data.errors import InvalidOptionError

from .encoders import check_encoder, encoder_name, make_encoder, published_threshold
from .measure import measure
from .select import Rule, choose


class RetrievalStep:
    """What the retrieval steps share: encoder, rule and camera.

    Args:
        encoder: Name of the encoder of the index, see `make_encoder`.
        rule: Rule of the choice, see `Rule.parse`.
        camera: Camera whose frames are compared; None for the first.
    """

    def __init__(self, encoder: str, *, rule: str = "max", camera: str | None = None):
        self.encoder = encoder_name(encoder)
        self.rule = Rule.parse(rule, published_threshold(self.encoder))
        self.camera = camera

    def label(self, dataset: Dataset) -> str:
        """Return index and rule, such as `siglip/max/0.923`, for histories from a dataset."""
        camera = dataset.camera(self.camera)
        return f"{PurePath(index_folder(self.encoder, camera)).name}/{self.rule}"

    def matching_frames(self, buffer: Buffer, query: NDArray[np.floating]) -> NDArray[np.int64]:
        """Choose the frames of a buffer that match the embedding of a live image, `(D,)`."""
        return choose(measure(buffer, self.encoder, self.camera, query), self.rule).frames


class Selector(RetrievalStep):
    """Chooses the frames of a history that match a live image.

    The embeddings of the history come from the index beside the data; only the live image is
    embedded, on `device`; None for a GPU if there is one.
    """

    def __init__(
        self,
        encoder: str,
        *,
        rule: str = "max",
        camera: str | None = None,
        device: str | None = None,
    ):
        super().__init__(encoder, rule=rule, camera=camera)
        self._encoder = make_encoder(encoder, device=device)

    def identity(self, buffer: Buffer) -> dict[str, Any]:
        """Return everything that its choices depend on besides the buffers, as plain values.

        Args:
            buffer: Any buffer of the buffer set.

        Returns:
            `encoder`, the name; `fingerprint`, the SHA-256 over everything that determines the
            features; `camera`; `method` and `number` of the rule; and `cosine`, the threshold that
            it is here, None for a rule that does not cut.
        """
        index = self._index(buffer)
        cosine = None
        if self.rule.method.sides is not None:
            cosine = self.rule.cosine(index.units.typical_cosine)
        return {
            "encoder": index.units.header.encoder.name,
            "fingerprint": index.units.header.encoder.sha256,
            "camera": index.units.header.camera,
            "method": self.rule.name,
            "number": self.rule.number,
            "cosine": cosine,
        }

    def select(self, buffer: Buffer, image: NDArray[np.uint8]) -> NDArray[np.int64]:
        """Choose the frames of a buffer that match an image.

        Args:
            buffer: The history.
            image: The first live observation, `(H, W, 3) uint8` RGB.

        Returns:
            Indices in the buffer, ascending, `(n,) int64`, n at least 1.
        """
        index = self._index(buffer)
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            actual = f"{image.dtype} of shape {image.shape}"
            raise InvalidOptionError.expected("image", actual, "(H, W, 3) uint8")
        features = self._encoder.features(self._encoder.prepare(image[None]))
        query = index.embed(features)[0]
        return self.matching_frames(buffer, query)

    def _index(self, buffer: Buffer) -> BufferSetIndex:
        """Return the index of the buffer set, which this encoder has to have made."""
        index = buffer.index(self.encoder, self.camera)
        check_encoder(index.units.header.encoder, self._encoder, index.units.remedy)
        return index
