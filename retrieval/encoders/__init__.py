"""Image encoders by name: what each is to the rest, and what is known of it without its weights."""

from hashlib import sha256
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import PAPER_ENCODER
from robomme_interference_data.data.embeddings import EncoderRecord, Remedy, encoder_id
from robomme_interference_data.errors import InvalidOptionError, MissingIndexError
from robomme_interference_data.runtime.specs import Kind, Registry
from robomme_interference_data.storage.files import canonical_json

ENCODERS = Registry(
    "encoder",
    {
        "thumbnail": Kind("thumbnail", f"{__name__}.thumbnail:Thumbnail"),
        "siglip": Kind(
            "siglip, or siglip:ID with the id or folder of a model",
            f"{__name__}.siglip:Siglip",
            r"(?P<model>.+)",
            default=PAPER_ENCODER,
            extra="retrieval",
        ),
    },
)

_PAPER_CUT = 0.923
"""The paper's cut (section "Adding Retrieval"), which was made for its encoder alone."""


class Encoder(Protocol):
    """Turns images into vectors whose cosine tells how alike two images are; can be pickled.

    An image's features depend on that image alone: not on its neighbours in a batch (beyond
    what float16 keeps), nor on the data that it is from.

    Attributes:
        name: Under which `make_encoder` makes it.
        centred: Whether the mean over the distractor units is taken off the features before they
            are normalised.
        batch: Images that it takes best at a time.
        computed_in: Where and in which precision it computes, such as `cpu, float32`.
        fingerprint: What determines the features up to that precision, as plain values: model,
            weights, preprocessing.
    """

    name: str
    centred: bool
    batch: int
    computed_in: str
    fingerprint: dict[str, Any]

    def prepare(self, images: NDArray[np.uint8]) -> Any:
        """Preprocess images, `(N, H, W, 3) uint8` RGB; may be called from several threads."""
        ...

    def features(self, prepared: Any) -> NDArray[np.float32]:
        """Return the features, `(N, D) float32`, of what `prepare` returned."""
        ...


def encoder_digest(encoder: Encoder) -> str:
    """Return the one hash of all that determines an encoder's features."""
    return sha256(canonical_json(encoder.fingerprint).encode()).hexdigest()


def check_encoder(recorded: EncoderRecord, encoder: Encoder, remedy: Remedy) -> None:
    """Check that embeddings were made with this very encoder.

    Args:
        recorded: What their index records.
        encoder: The encoder.
        remedy: How they are made again.
    """
    if recorded.sha256 != encoder_digest(encoder):
        raise MissingIndexError(
            f"the embeddings of {encoder.name!r} beside the data were made with another version "
            "of the encoder: its weights, settings, preprocessing or code differ",
            *remedy,
        )


def encoder_name(name: str) -> str:
    """Return the one name of an encoder: `siglip` for the paper's model, however it was given.

    Args:
        name: `thumbnail`, `siglip` (the paper's model), or `siglip:` and the id or folder of a
            SigLIP or SigLIP 2 model, such as `siglip:google/siglip2-base-patch16-224`.
    """
    return "siglip" if ENCODERS.parse(name).target == PAPER_ENCODER else name


def published_threshold(name: str) -> float | None:
    """Return the cut that was published for an encoder, at whatever revision, or None.

    A folder is not known to hold the published weights, whatever its name: None.
    """
    return _PAPER_CUT if encoder_id(encoder_name(name)) == "siglip" else None


def make_encoder(name: str, *, device: str | None = None, batch: int | None = None) -> Encoder:
    """Make an encoder; heavy libraries are loaded only if it needs them.

    Args:
        name: As `encoder_name` reads it.
        device: Where to compute, such as `cpu`; None for a GPU if there is one.
        batch: Images at a time; None for what suits the encoder.
    """
    if batch is not None and batch < 1:
        raise InvalidOptionError.expected("batch", batch, "1 or more")
    spec = ENCODERS.parse(name)
    options = {"device": device, "batch": batch} if spec.kind == "siglip" else {}
    made: Encoder = ENCODERS.factory(spec)(**spec.given, **options)
    return made
