"""Image encoders by name."""

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest
from robomme_interference_data.retrieval.encoders.base import Encoder

__all__ = ["KINDS", "Encoder", "make_encoder"]

KINDS = ("siglip", "thumbnail")


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
    kind, colon, model = name.partition(":")
    if kind not in KINDS:
        raise UnknownNameError(f"there is no encoder {name!r}", nearest(kind, KINDS))
    if batch is not None and batch < 1:
        raise InvalidOptionError(f"batch={batch}; expected 1 or more")
    if kind == "thumbnail":
        if colon:
            raise InvalidOptionError(
                f"encoder {name!r}: thumbnail has no models", "Type: --encoder thumbnail"
            )
        from robomme_interference_data.retrieval.encoders.thumbnail import Thumbnail

        return Thumbnail()
    if colon and not model:
        raise InvalidOptionError(
            f"encoder {name!r} names no model",
            "Type siglip for the paper's model, or siglip:ID with an id or a folder.",
        )
    from robomme_interference_data.retrieval.encoders.siglip import DEFAULT_MODEL, Siglip

    return Siglip(model or DEFAULT_MODEL, device=device, batch=batch)
