"""Image encoders by name: their interface, and what is known without their weights."""

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import PAPER_ENCODER
from robomme_interference_data.data.index_layout import EncoderRecord, encoder_id
from robomme_interference_data.errors import InvalidOptionError, MissingFileError
from robomme_interference_data.runtime.specs import Registry, SpecKind
from robomme_interference_data.storage.text import digest_json

ENCODERS = Registry(
    "encoder",
    {
        "thumbnail": SpecKind("thumbnail", f"{__name__}.thumbnail:Thumbnail"),
        "siglip": SpecKind(
            "siglip, or siglip:ID with the id or folder of a model",
            f"{__name__}.siglip:Siglip",
            r"(?P<model>.+)",
            default=PAPER_ENCODER,
            extra="retrieval",
        ),
    },
)

_PAPER_CUT = 0.923
"""The paper's threshold (section "Adding Retrieval"), for its encoder only."""


class Encoder(Protocol):
    """Turns images into vectors whose cosine measures similarity; can be pickled.

    The features of an image depend on that image only, not on its neighbors in a batch (up to the
    precision of float16) or on its dataset.

    Attributes:
        name: Its name, see `make_encoder`.
        centered: Whether the mean over the distractor units is subtracted before normalization.
        batch: Images per batch.
        computed_in: Device and precision, such as `cpu, float32`.
        fingerprint: What determines the features up to that precision, as plain values: model,
            weights, preprocessing.
    """

    name: str
    centered: bool
    batch: int
    computed_in: str
    fingerprint: dict[str, Any]

    def prepare(self, images: NDArray[np.uint8]) -> Any:
        """Preprocess images, `(N, H, W, 3) uint8` RGB; several threads may call it."""
        ...

    def features(self, prepared: Any) -> NDArray[np.float32]:
        """Return the features, `(N, D) float32`, of what `prepare` returned."""
        ...


def encoder_digest(encoder: Encoder) -> str:
    """Return the hash of an encoder's fingerprint."""
    return digest_json([encoder.fingerprint])


def check_encoder(recorded: EncoderRecord, encoder: Encoder, remedy: tuple[str, str]) -> None:
    """Check that this encoder made the embeddings of an index; `remedy` makes them again."""
    if recorded.sha256 != encoder_digest(encoder):
        raise MissingFileError(
            f"the stored embeddings of {encoder.name!r} come from another version of the encoder: "
            "its weights, settings, preprocessing or code differ",
            *remedy,
        )


def encoder_name(name: str) -> str:
    """Return the canonical name of an encoder: `siglip` for the id of the paper's model.

    Args:
        name: `thumbnail`, `siglip` (the paper's model), or `siglip:` and the id or folder of a
            SigLIP or SigLIP 2 model, such as `siglip:google/siglip2-base-patch16-224`.
    """
    return "siglip" if ENCODERS.parse(name).target == PAPER_ENCODER else name


def published_threshold(name: str) -> float | None:
    """Return the threshold that was published for an encoder at any revision; None for others.

    It is None for a folder too, which may hold other weights.
    """
    return _PAPER_CUT if encoder_id(encoder_name(name)) == "siglip" else None


def make_encoder(name: str, *, device: str | None = None, batch: int | None = None) -> Encoder:
    """Make an encoder; heavy libraries are imported only if it needs them.

    Args:
        name: Name, see `encoder_name`.
        device: Device to compute on, such as `cpu`; None for a GPU if there is one.
        batch: Images per batch; None for the encoder's default.
    """
    if batch is not None and batch < 1:
        raise InvalidOptionError.expected("batch", batch, "1 or more")
    spec = ENCODERS.parse(name)
    # `thumbnail` has no device, and its batch is fixed: NumPy computes image by image.
    options = {"device": device, "batch": batch} if spec.kind == "siglip" else {}
    encoder: Encoder = ENCODERS.factory(spec)(**spec.arguments, **options)
    return encoder
