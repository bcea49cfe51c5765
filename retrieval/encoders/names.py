"""Names of encoders, and what is known of them without their weights."""

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest

__all__ = ["DEFAULT_MODEL", "KINDS", "encoder_name", "published_threshold"]

KINDS = ("siglip", "thumbnail")

DEFAULT_MODEL = "google/siglip-so400m-patch14-384"
"""The paper's model."""

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
    return "siglip" if model == DEFAULT_MODEL else name


def published_threshold(name: str) -> float | None:
    """Return the cut that was published for an encoder, or None."""
    return _PUBLISHED.get(encoder_name(name))
