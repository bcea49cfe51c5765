"""Image encoders by name."""

from robomme_interference_data.constants import PAPER_ENCODER
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.retrieval.encoders.base import Encoder
from robomme_interference_data.retrieval.encoders.names import (
    KINDS,
    encoder_name,
    published_threshold,
)

__all__ = ["KINDS", "Encoder", "encoder_name", "make_encoder", "published_threshold"]


def make_encoder(name: str, *, device: str | None = None, batch: int | None = None) -> Encoder:
    """Make an encoder; heavy libraries are loaded only if it needs them.

    Args:
        name: `thumbnail`, `siglip` (the paper's model) or `siglip:` and the id or folder of a
            SigLIP or SigLIP 2 model, such as `siglip:google/siglip2-base-patch16-224`.
        device: Where to compute, such as `cpu`; None for a GPU if there is one.
        batch: Images at a time; None for what suits the encoder.

    Raises:
        UnknownNameError: There is no such encoder.
        InvalidOptionError: An option is out of range, or the encoder takes no model.
        MissingExtraError, MissingWeightsError, FormatError: See `siglip.Siglip`.
    """
    kind, _, model = encoder_name(name).partition(":")
    if batch is not None and batch < 1:
        raise InvalidOptionError(f"batch={batch}; expected 1 or more")
    if kind == "thumbnail":
        from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail

        return Thumbnail()
    from robomme_interference_data.retrieval.encoders.siglip import Siglip

    return Siglip(model or PAPER_ENCODER, device=device, batch=batch)
