"""Measure buffers: the cosines from which retrieval chooses, and the truth to grade it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.views import live_embedding
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.schema.evidence import Evidence
from robomme_interference_data.schema.manifest import Session
from robomme_interference_data.schema.shifts import Shift

from .segment import FrameSpan, adjacent_cosines, cosines, side_cosines


@dataclass(frozen=True, eq=False)
class Similarities:
    """Cosines of the frames of a buffer, with each other and with the first live observation.

    Attributes:
        episode_id: The query episode.
        condition: Name of the condition.
        sessions: The true sessions in order.
        adjacent: Cosine of each frame with the next, `(T - 1,) float32`.
        alike: Cosine of each frame with that observation's image, `(T,) float32`.
        typical: Median cosine of two frames of different distractor units.
        embeddings: Returns the embeddings, `(T, D) float32`. It reads them again, because they take
            much memory for many buffers.
        evidence: Frames that show the hidden answer; None if unknown.
        ability: What a query of a day needs of a memory; None for others.
    """

    episode_id: EpisodeId
    condition: str
    sessions: tuple[Session, ...]
    adjacent: NDArray[np.float32]
    alike: NDArray[np.float32]
    typical: float
    embeddings: Callable[[], NDArray[np.float32]]
    evidence: tuple[Evidence, ...] | None = None
    ability: str | None = None

    @property
    def lesson(self) -> tuple[FrameSpan, ...]:
        """The parts of the true lesson, in the buffer's order; none where it is absent."""
        return tuple(
            (session.start, session.stop) for session in self.sessions if session.role == "lesson"
        )

    def borders(self, width: int) -> NDArray[np.float32]:
        """Return the cosines of both sides of each border, see `side_cosines`."""
        return self.adjacent if width == 1 else side_cosines(self.embeddings(), width)


def measure(
    buffer: Buffer,
    encoder: str,
    camera: str | None = None,
    query: NDArray[np.floating] | None = None,
) -> Similarities:
    """Return the similarities of a buffer from its stored embeddings.

    `query` is the embedding of the first live observation, `(D,)`, of length 1, such as under a
    shift; None for the stored one.
    """
    embeddings = buffer.embeddings(encoder, camera)
    return Similarities(
        buffer.episode_id,
        buffer.condition,
        buffer.sessions,
        adjacent_cosines(embeddings),
        cosines(embeddings, buffer.query_embedding(encoder, camera) if query is None else query),
        buffer.index(encoder, camera).units.typical_cosine,
        lambda: buffer.embeddings(encoder, camera),
        buffer.evidence,
        buffer.query.record.ability,
    )


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
