"""The retrieval step of a rollout: embed what the robot sees, look its session up."""

from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.buffer import Buffer
from robomme_interference_data.constants import CAMERA_PREFIX, INDEX_CENTRE
from robomme_interference_data.draw import even_sample
from robomme_interference_data.embeddings import (
    EmbeddingIndex,
    encoder_id,
    index_folder,
    normalised,
)
from robomme_interference_data.errors import InvalidOptionError, StaleIndexError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.retrieval.encoders import make_encoder, published_threshold
from robomme_interference_data.retrieval.encoders.base import fingerprint_digest
from robomme_interference_data.retrieval.segment import Span
from robomme_interference_data.retrieval.select import SEGMENT_METHODS, Choice, Rule, choose

__all__ = ["Selection", "Selector", "lot_of", "select", "true_lesson"]


@dataclass(frozen=True, eq=False)
class Selection:
    """The span of a history that is handed to the policy, and what it was chosen by.

    Attributes:
        start: First frame in the buffer.
        stop: Frame after the last one.
        choice: Segments, scores and cosines, for the picture.
        lesson_fraction: Share of lesson frames in an even 32-frame sample of the span and the
            first live observation, as in the released CSV.
        filler_fraction: The same for frames of other sessions.
        query_fraction: The same for the first live observation.
    """

    start: int
    stop: int
    choice: Choice
    lesson_fraction: float
    filler_fraction: float
    query_fraction: float


class Selector:
    """Chooses the span of a history that goes with what the robot sees.

    The history's embeddings are looked up in the index beside the data; only the live image is
    embedded. True sessions are read after the choice, to grade it, and by `oracle`.

    Args:
        encoder: Name of the encoder, see `make_encoder`.
        rule: How to choose, as `Rule.parse` reads it; a method that chooses a segment.
        camera: Camera whose frames it compares.
        device: Where to compute; None for a GPU if there is one.

    Raises:
        UnknownNameError: There is no such encoder or method.
        InvalidOptionError: The method chooses single frames, or the cut is no cosine.
        MissingExtraError, MissingWeightsError, FormatError: See `make_encoder`.
    """

    def __init__(
        self,
        encoder: str,
        *,
        rule: str = "max",
        camera: str = "front",
        device: str | None = None,
    ):
        self.rule = Rule.parse(rule).settled(published_threshold(encoder))
        if self.rule.method == "top32":
            raise InvalidOptionError(
                "method 'top32' chooses single frames; a policy is handed a span",
                f"Choose one of {', '.join(SEGMENT_METHODS)}.",
            )
        self.camera = camera.removeprefix(CAMERA_PREFIX)
        self._encoder = make_encoder(encoder, device=device)

    @property
    def name(self) -> str:
        """Encoder, camera if it is not the front one, and rule, such as `siglip/max/0.923`."""
        return f"{PurePath(index_folder(self._encoder.name, self.camera)).name}/{self.rule}"

    def identity(self, buffer: Buffer) -> dict[str, Any]:
        """Return what its choices depend on besides the buffers, as plain values.

        Two selectors of one identity choose alike from the same split.

        Args:
            buffer: Any buffer of the split whose index it looks up.

        Returns:
            `encoder`, its name; `fingerprint`, the SHA-256 over all that determines the embeddings
            (weights, settings, preprocessing, centre); `camera`; `method`; `cut`, a cosine or
            `adaptive`; and `threshold`, the cosine that it comes to.

        Raises:
            MissingIndexError, StaleIndexError, FormatError: As for `select`.
        """
        index = buffer.query_index(self._encoder.name, self.camera)
        self._check(index)
        return {
            "encoder": encoder_id(self._encoder.name),
            "fingerprint": index.fingerprint,
            "camera": self.camera,
            "method": self.rule.method,
            "cut": self.rule.cut,
            "threshold": self.rule.threshold(index.typical_cosine),
        }

    def select(self, buffer: Buffer, image: NDArray[np.uint8]) -> Selection:
        """Choose the span of a buffer that goes with an image.

        Args:
            buffer: The history.
            image: The first live observation, `(H, W, 3) uint8` RGB.

        Raises:
            MissingIndexError: The data has no embeddings of this encoder.
            StaleIndexError: They were made of other data, or with another version of the encoder.
            InvalidOptionError: The buffer is empty, or the image has another shape.
        """
        index = buffer.query_index(self._encoder.name, self.camera)
        self._check(index)
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise InvalidOptionError(
                f"image of shape {image.shape}, {image.dtype}; expected (H, W, 3) uint8"
            )
        features = self._encoder.features(self._encoder.prepare(image[None]))
        query = normalised(features, index.centre)[0]
        return select(buffer, self._encoder.name, self.rule, query, camera=self.camera)

    def _check(self, index: EmbeddingIndex) -> None:
        """Check that the index was made with this very encoder."""
        centre = index.header["files"].get(INDEX_CENTRE, {}).get("sha256")
        if index.fingerprint != fingerprint_digest(self._encoder.fingerprint, centre):
            raise StaleIndexError(
                f"the embeddings of {self._encoder.name!r} beside the data were made with another "
                "version of the encoder: its weights, settings, preprocessing or code differ",
                "Make them again: robomme-interference index --data SPLIT --encoder "
                f"{self._encoder.name} --camera {self.camera}",
            )


def select(
    buffer: Buffer,
    encoder: str,
    rule: Rule,
    query: NDArray[np.floating] | None = None,
    *,
    camera: str = "front",
) -> Selection:
    """Choose the span of a buffer by embeddings that are there; no encoder is needed.

    Args:
        buffer: The history.
        encoder: Name of the encoder whose index is looked up.
        rule: How to choose, its cut settled.
        query: Embedding of the live observation, `(D,)`; None for the stored first one.
        camera: Camera whose index is looked up.

    Raises:
        MissingIndexError, StaleIndexError, FormatError: See `Buffer.embeddings`.
        InvalidOptionError: The buffer is empty, or the rule chooses single frames.
    """
    choice = choose(
        buffer.embeddings(encoder, camera),
        buffer.query_embedding(encoder, camera) if query is None else query,
        threshold=rule.threshold(buffer.query_index(encoder, camera).typical_cosine),
        method=rule.method,
        lesson=true_lesson(buffer) if rule.method == "oracle" else None,
        lot=lot_of(buffer.episode_id, buffer.k),
    )
    start, stop = choice.span
    return Selection(start, stop, choice, *_fractions(buffer, start, stop))


def lot_of(episode_id: EpisodeId, k: int) -> str:
    """Return what the method `random` draws by for one buffer."""
    return f"{episode_id} k{k}"


def true_lesson(buffer: Buffer) -> Span:
    """Return the span of the lesson in a buffer, for grading.

    Raises:
        InvalidOptionError: The buffer has no lesson, or has it in several parts.
    """
    found = [session.span for session in buffer.sessions if session.role == "lesson"]
    if len(found) != 1:
        raise InvalidOptionError(
            f"the buffer of {buffer.episode_id} at k={buffer.k} has {len(found)} lesson sessions; "
            "expected 1"
        )
    return found[0]


def _fractions(buffer: Buffer, start: int, stop: int) -> tuple[float, float, float]:
    """Return the shares of lesson, other sessions and live observation in an even sample."""
    sample = even_sample(stop - start)
    lessons = [session.span for session in buffer.sessions if session.role == "lesson"]
    history = [start + index for index in sample if index < stop - start]
    lesson = sum(any(first <= frame < last for first, last in lessons) for frame in history)
    counts = (lesson, len(history) - lesson, len(sample) - len(history))
    return counts[0] / len(sample), counts[1] / len(sample), counts[2] / len(sample)
