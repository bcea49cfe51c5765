"""What every image encoder is to the rest, and what its output depends on."""

from hashlib import sha256
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.files import canonical_json

__all__ = ["Encoder", "fingerprint_digest"]


class Encoder(Protocol):
    """Turns images into vectors whose cosine tells how alike two images are.

    An image's features depend on that image alone: not on its neighbours in a batch (beyond
    what float16 keeps), nor on the data that it is from.

    Attributes:
        name: Under which `make_encoder` makes it.
        centred: Whether the mean over a data set is taken off the features before they are
            normalised.
        batch: Images that it takes best at a time.
    """

    name: str
    centred: bool
    batch: int

    @property
    def fingerprint(self) -> dict[str, Any]:
        """What determines the features, as plain values: model, weights, preprocessing."""
        ...

    @property
    def computed_in(self) -> str:
        """Where and in which precision it computes, in words."""
        ...

    def prepare(self, images: NDArray[np.uint8]) -> Any:
        """Preprocess images, `(N, H, W, 3) uint8` RGB; may be called from several threads."""
        ...

    def features(self, prepared: Any) -> NDArray[np.float32]:
        """Return the features, `(N, D) float32`, of what `prepare` returned."""
        ...


def fingerprint_digest(fingerprint: dict[str, Any], centre_sha256: str | None) -> str:
    """Return the one hash under which an index records how it was made."""
    text = canonical_json({"centre": centre_sha256, "encoder": fingerprint})
    return sha256(text.encode()).hexdigest()
