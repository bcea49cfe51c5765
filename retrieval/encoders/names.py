"""Names of encoders, and what is known of them without their weights."""

from robomme_interference_data.constants import PAPER_ENCODER
from robomme_interference_data.embeddings import encoder_id
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest

__all__ = ["KINDS", "encoder_name", "published_threshold"]

KINDS = ("siglip", "thumbnail")

_PUBLISHED = {"siglip": 0.923}
"""Encoder to the paper's cut (section "Adding Retrieval"), which was made for it alone."""


def encoder_name(name: str) -> str:
    """Return the one name of an encoder: `siglip` for the paper's model, however it was given.

    Args:
        name: `thumbnail`, `siglip`, or `siglip:` and the id or folder of a model.

    Raises:
        UnknownNameError: There is no such encoder.
        InvalidOptionError: It takes no model, or names none.
    """
    kind, colon, model = name.partition(":")
    if kind not in KINDS:
        raise UnknownNameError(f"there is no encoder {name!r}", nearest(kind, KINDS))
    if kind == "thumbnail" and colon:
        raise InvalidOptionError(
            f"encoder {name!r}: thumbnail has no models", "Type: --encoder thumbnail"
        )
    if colon and not model:
        raise InvalidOptionError(
            f"encoder {name!r} names no model",
            "Type siglip for the paper's model, or siglip:ID with an id or a folder.",
        )
    return "siglip" if model == PAPER_ENCODER else name


def published_threshold(name: str) -> float | None:
    """Return the cut that was published for an encoder, at whatever revision, or None.

    A folder is not known to hold the published weights, whatever its name: None.
    """
    return _PUBLISHED.get(encoder_id(encoder_name(name)))
