"""Choose the part of a history that the policy receives: the released rule and others.

Every rule is a function of the history's cosines and a threshold. Only `oracle`, a reference, uses
the true sessions.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any, Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import SAMPLE_FRAMES
from robomme_interference_data.data.buffer import Buffer
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.evidence import Evidence
from robomme_interference_data.schema.manifest import Session
from robomme_interference_data.schema.sampling import runs

from .segment import FrameSpan, adjacent_cosines, closest_cosines, cosines, segments

ADAPTIVE: Final = "adaptive"

MIN_FRAMES = 4
"""Minimum length of a segment that may be chosen, in frames (released reference)."""

_FOLLOWING = 0.1
"""Quantile of a segment's adjacent cosines from which other frames count as similar (ours)."""

METHODS = {
    "max": "the segment with the frame closest to the first live observation (released rule)",
    "latest": "the segment of max, or the last segment with an equally close frame",
    "joined": "the segment of max, and all segments with a similar frame (ours)",
    "mean": "the segment with the highest mean cosine with the first live observation",
    "last": "the last segment",
    "random": "a random segment",
    "top32": "the 32 frames closest to the first live observation, without segments",
    "oracle": "the true lesson, or its first part",
}
"""What each method chooses. Ties go to the earliest segment, except for `latest`; segments of fewer
than `MIN_FRAMES` frames are skipped.

`joined` finds a session that is in several parts: two frames are similar if their cosine reaches
that of nine in ten adjacent frames of the segment of `max`.
"""

_SCORES: dict[str, Callable[[NDArray[np.float32]], float]] = {
    **dict.fromkeys(("max", "latest", "joined"), lambda values: float(values.max())),
    "mean": lambda values: float(np.round(values.mean(dtype=np.float64), 6)),
}


@dataclass(frozen=True)
class Rule:
    """A method of choosing, and the threshold of segments; validates itself.

    Attributes:
        method: One of `METHODS`.
        threshold: Cosine of adjacent frames below which a history is cut, or `adaptive` (ours): the
            middle between the cosine of unrelated frames and 1. It has no free parameter, and uses
            the train pool but no test episode.
    """

    method: str = "max"
    threshold: float | Literal["adaptive"] = ADAPTIVE

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UnknownNameError.none("method", self.method, METHODS)
        cosine = isinstance(self.threshold, float | int) and -1 <= self.threshold <= 1
        if self.threshold != ADAPTIVE and not cosine:
            expected = f"a cosine, from −1 to 1, or {ADAPTIVE}, such as max/0.923"
            raise InvalidOptionError.expected(
                f"the threshold of {self.method}", self.threshold, expected
            )

    @classmethod
    def parse(cls, text: str, published: float | None = None) -> Self:
        """Read `METHOD` or `METHOD/THRESHOLD`, such as `max`, `mean/0.9` or `max/adaptive`.

        Without a threshold it is `published`, the one published for the encoder, or else adaptive.
        """
        method, slash, text = text.partition("/")
        if not slash:
            return cls(method, ADAPTIVE if published is None else published)
        try:
            threshold: Any = float(text)
        except ValueError:
            threshold = text
        return cls(method, threshold)

    def cosine(self, typical: float) -> float:
        """Return the cosine below which it cuts; unrelated frames have the cosine `typical`."""
        return (1 + typical) / 2 if self.threshold == ADAPTIVE else float(self.threshold)

    def __str__(self) -> str:
        """Return the text that `parse` reads, with every digit of the threshold."""
        if self.threshold == ADAPTIVE:
            return f"{self.method}/{ADAPTIVE}"
        return f"{self.method}/{float(self.threshold)!r}".removesuffix(".0")


def parse_rules(texts: Sequence[str], published: float | None) -> list[Rule]:
    """Read rules as `Rule.parse` does, without duplicates.

    A text may hold several, separated by commas; `all` is every method, and `max` with both
    thresholds.
    """
    names: list[str] = []
    for name in (name for text in texts for name in text.split(",")):
        names += [*METHODS, f"max/{ADAPTIVE}"] if name == "all" else [name]
    return list(dict.fromkeys(Rule.parse(name, published) for name in names))


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
        closest: Returns for a span the cosine of each frame with the closest frame of the span,
            `(T,) float32`. It reads the embeddings again, which take much memory for many buffers.
        evidence: Frames that show the hidden answer; None if unknown.
    """

    episode_id: EpisodeId
    condition: str
    sessions: tuple[Session, ...]
    adjacent: NDArray[np.float32]
    alike: NDArray[np.float32]
    typical: float
    closest: Callable[[FrameSpan], NDArray[np.float32]]
    evidence: tuple[Evidence, ...] | None = None

    @property
    def lesson(self) -> tuple[FrameSpan, ...]:
        """The parts of the true lesson, in the buffer's order; none where it is absent."""
        return tuple(
            (session.start, session.stop) for session in self.sessions if session.role == "lesson"
        )


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
        lambda span: closest_cosines(buffer.embeddings(encoder, camera), span),
        buffer.evidence,
    )


@dataclass(frozen=True, eq=False)
class Choice:
    """The chosen part of a history.

    Attributes:
        threshold: Cosine of adjacent frames below which the history was cut.
        frames: The chosen frames, ascending, `(n,) int64`, n at least 1.
        segments: All segments in order.
        scores: Score of each segment that may be chosen; empty if the method has no scores.
    """

    threshold: float
    frames: NDArray[np.int64]
    segments: tuple[FrameSpan, ...]
    scores: Mapping[FrameSpan, float]

    @property
    def spans(self) -> tuple[FrameSpan, ...]:
        """The runs of chosen frames, in order."""
        return runs(self.frames.tolist())


def choose(measured: Similarities, rule: Rule) -> Choice:
    """Choose the part of a history that matches the first live observation."""
    name = f"{measured.episode_id} under {measured.condition}"
    if not len(measured.alike):
        raise InvalidOptionError(
            f"{name}: the history is empty",
            "Retrieval needs a condition with a history, such as k0; leave out no-history.",
        )
    threshold = rule.cosine(measured.typical)
    spans = segments(measured.adjacent, threshold)
    # If all segments are short, all may be chosen (ours).
    candidates = [(a, b) for a, b in spans if b - a >= MIN_FRAMES] or list(spans)
    scores: dict[FrameSpan, float] = {}
    if rule.method == "top32":
        closest = np.argsort(-measured.alike, kind="stable")[:SAMPLE_FRAMES]
        return Choice(threshold, np.sort(closest), spans, scores)
    if score := _SCORES.get(rule.method):
        scores = {span: score(measured.alike[slice(*span)]) for span in candidates}
        order = candidates[::-1] if rule.method == "latest" else candidates
        chosen = max(order, key=lambda span: scores[span])
        if rule.method == "joined":
            return Choice(threshold, _joined(measured, chosen, candidates), spans, scores)
    elif rule.method == "last":
        chosen = candidates[-1]
    elif rule.method == "random":
        seed = f"robomme-interference random\n{measured.episode_id} {measured.condition}"
        number = int.from_bytes(sha256(seed.encode()).digest())
        chosen = candidates[number % len(candidates)]
    elif measured.lesson:
        chosen = measured.lesson[0]
    else:
        raise InvalidOptionError(f"{name}: oracle needs a lesson, and the history holds none")
    return Choice(threshold, np.arange(*chosen), spans, scores)


def _joined(
    measured: Similarities, first: FrameSpan, candidates: Sequence[FrameSpan]
) -> NDArray[np.int64]:
    """Return the frames of a segment, and of all segments with a similar frame."""
    following = measured.adjacent[first[0] : first[1] - 1]
    if not len(following):  # a single frame has no adjacent cosine
        return np.arange(*first)
    alike = measured.closest(first) >= np.quantile(following, _FOLLOWING, method="lower")
    chosen = (span for span in candidates if span == first or alike[slice(*span)].any())
    return np.concatenate([np.arange(*span) for span in chosen])
