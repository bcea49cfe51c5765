"""The columns of rows that describe which frames a retrieval step chose."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from robomme_interference_data.schema.sampling import even_sample


@dataclass(frozen=True, kw_only=True)
class RetrievalColumns:
    """The frames that a retrieval step chose; all None without one, or without a history."""

    retrieval_start: Annotated[int | None, "First retrieved frame of the buffer."] = None
    retrieval_stop: Annotated[
        int | None, "Frame after the last retrieved one; frames between may be left out."
    ] = None
    retrieval_selected_lesson_fraction: Annotated[
        float | None,
        "Share of lesson frames in an even 32-frame sample of the retrieved frames and the first "
        "live observation, as in the released CSV.",
    ] = None
    retrieval_selected_filler_fraction: Annotated[
        float | None, "Share of frames of other sessions in that sample."
    ] = None
    retrieval_selected_query_fraction: Annotated[
        float | None, "Share of the first live observation in that sample."
    ] = None


def retrieval_columns(chosen: Sequence[int], lesson_share: float) -> dict[str, Any]:
    """Return the columns, given the chosen frames and the share of lesson frames in their sample.

    `chosen` are ascending indices of a buffer's frames, at least one.
    """
    frames = len(even_sample(len(chosen)))
    filler = (frames - 1 - round(lesson_share * frames)) / frames
    return {
        "retrieval_start": chosen[0],
        "retrieval_stop": chosen[-1] + 1,
        "retrieval_selected_lesson_fraction": lesson_share,
        "retrieval_selected_filler_fraction": filler,
        "retrieval_selected_query_fraction": 1 / frames,
    }
