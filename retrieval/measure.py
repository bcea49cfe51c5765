"""Measure all buffers of a buffer set, to grade what retrieval would choose of them."""

from collections.abc import Sequence
from typing import Any

from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.views import live_embedding
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.schema.shifts import Shift

from .select import Similarities, measure


def measure_all(
    buffer_set: BufferSet,
    encoder: str,
    camera: str,
    shift: Shift | None,
    *,
    families: Sequence[str] = (),
    conditions: Sequence[str] = (),
    progress: WorkProgress,
) -> tuple[list[Similarities], int]:
    """Return the similarities of each buffer with a lesson, and the number of the other buffers.

    Args:
        buffer_set: The buffer set.
        encoder: Name of the encoder, whose embeddings are stored.
        camera: Camera whose frames are compared.
        shift: Shift of the first live observation; None for none.
        families: Families of the query episodes; empty for all.
        conditions: Conditions; empty for all.
        progress: Shows how many buffers are measured.

    Raises:
        InvalidOptionError: No buffer has a lesson.
        MissingFileError: The embeddings are missing.
    """
    selected: dict[str, Any] = {"family": families, "condition": conditions}
    total = sum(1 for _ in buffer_set.manifests(**selected))
    buffer_set.check_tables(conditions or buffer_set.conditions)
    measured = []
    progress.start(encoder, total)
    for buffer in buffer_set.buffers(**selected):
        if buffer.manifest.lesson_frames:
            query = live_embedding(buffer_set, buffer, shift, encoder, camera)
            measured.append(measure(buffer, encoder, camera, query))
        progress.advance(1)
    if not measured:
        raise InvalidOptionError(
            f"none of the {total} buffers of {buffer_set.name} holds a lesson, which grading needs",
            command=buffer_set.planning("k0", "k3"),
        )
    return measured, total - len(measured)
