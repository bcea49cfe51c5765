"""The settings of `index`, and what its options share with those of other commands."""

from dataclasses import dataclass

from robomme_interference_data.schema.settings import setting

RETRIEVAL = "Retrieval"
_EXECUTION = "Execution"
"""Titles of groups of options."""

ENCODER_HELP = (
    "thumbnail (no weights), siglip (the paper's model), or siglip:ID with the id or folder of "
    "another SigLIP or SigLIP 2 model."
)


@dataclass(frozen=True)
class IndexConfig:
    """The settings of `index`."""

    encoder: str = setting("thumbnail", help=ENCODER_HELP, group=RETRIEVAL)
    camera: str | None = setting(None, help="Camera to embed.", shown="the first", group=RETRIEVAL)
    force: bool = setting(False, help="Build the index again.", group=RETRIEVAL)
    device: str | None = setting(
        None,
        help="Device of siglip, such as cuda.",
        shown="a GPU if there is one",
        group=_EXECUTION,
    )
    batch: int | None = setting(
        None, help="Images per batch.", shown="the encoder's default", group=_EXECUTION
    )
    threads: int | None = setting(
        None, help="Threads that decode.", shown="all processors", group=_EXECUTION
    )
