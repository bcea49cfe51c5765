"""Choose which part of a history to hand to the policy: the released rule and others.

Every rule is a function of the history's cosines and a threshold. The true sessions are known to
`oracle` alone, which is there to compare with.
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

from .segment import (
    Span,
    adjacent_cosines,
    closest_cosines,
    cosines,
    segments,
)

ADAPTIVE: Final = "adaptive"

MIN_FRAMES = 4
"""Frames of the shortest segment that may be chosen (released reference)."""

_FOLLOWING = 0.1
"""Quantile of a segment's adjacent cosines from which on frames are like those that follow each
other (ours)."""

METHODS = {
    "max": "the segment with the frame closest to what the robot sees now (released rule)",
    "latest": "the segment that max takes, or the last of those with equally close frames",
    "joined": "the segment that max takes, and all that hold a frame like one of its own (ours)",
    "mean": "the segment with the highest mean cosine with what the robot sees now",
    "last": "the last segment",
    "random": "a segment by lot",
    "top32": "the 32 frames closest to what the robot sees now, without segments",
    "oracle": "the true lesson, or its first part",
}
"""What each method takes. Ties go to the earliest but for `latest`; segments of fewer than
`MIN_FRAMES` frames are left aside.

`joined` finds a session that is in several parts: two frames are alike if their cosine is that of
nine in ten adjacent frames of the segment that `max` takes, or more.
"""

_SCORES: dict[str, Callable[[NDArray[np.float32]], float]] = {
    **dict.fromkeys(("max", "latest", "joined"), lambda values: float(values.max())),
    "mean": lambda values: float(np.round(values.mean(dtype=np.float64), 6)),
}


@dataclass(frozen=True)
class Rule:
    """A way to choose, and where to cut before; checks itself.

    Attributes:
        method: One of `METHODS`.
        boundary: Cosine of adjacent frames below which a history is cut, or `adaptive`: halfway
            from what unrelated frames share to equality. That is ours; it has no free parameter,
            and knows the train pool but no test episode.
    """

    method: str = "max"
    boundary: float | Literal["adaptive"] = ADAPTIVE

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UnknownNameError.none("method", self.method, METHODS)
        cosine = isinstance(self.boundary, float | int) and -1 <= self.boundary <= 1
        if self.boundary != ADAPTIVE and not cosine:
            expected = f"a cosine, from −1 to 1, or {ADAPTIVE}, such as max/0.923"
            raise InvalidOptionError.expected(f"the cut of {self.method}", self.boundary, expected)

    @classmethod
    def parse(cls, text: str, published: float | None = None) -> Self:
        """Read `METHOD` or `METHOD/CUT`, such as `max`, `mean/0.9` or `max/adaptive`.

        Where the text names no cut it is `published`, the encoder's own, or adaptive if that is
        None.
        """
        method, slash, text = text.partition("/")
        if not slash:
            return cls(method, ADAPTIVE if published is None else published)
        try:
            cut: Any = float(text)
        except ValueError:
            cut = text
        return cls(method, cut)

    def threshold(self, typical: float) -> float:
        """Return the cosine below which it cuts, where unrelated frames have cosine `typical`."""
        return (1 + typical) / 2 if self.boundary == ADAPTIVE else float(self.boundary)

    def __str__(self) -> str:
        """Return what `parse` reads, with every digit of the cut."""
        adaptive = self.boundary == ADAPTIVE
        at = ADAPTIVE if adaptive else repr(float(self.boundary)).removesuffix(".0")
        return f"{self.method}/{at}"


def parse_rules(texts: Sequence[str], published: float | None) -> list[Rule]:
    """Read rules as `Rule.parse` does, each once, in the order given.

    A text may hold several, with commas between them; `all` is every method, and both cuts.
    """
    every = [*METHODS, f"max/{ADAPTIVE}"]
    given = (name for text in texts for name in text.split(","))
    named = (name for text in given for name in (every if text == "all" else [text]))
    return list(dict.fromkeys(Rule.parse(name, published) for name in named))


@dataclass(frozen=True, eq=False)
class Similarities:
    """A buffer whose frames are compared with each other and with a query frame.

    All rules and cuts share it.

    Attributes:
        episode_id: The query episode.
        condition: Name of the condition.
        sessions: The true sessions in order.
        adjacent: Cosine of each frame with the next, `(T - 1,) float32`.
        alike: Cosine of each frame with the query frame, `(T,) float32`.
        typical: Median cosine of two frames of different distractor units.
        closest: From a span to the cosine of each frame with the closest one of that span,
            `(T,) float32`; looked up when asked for, as embeddings of many buffers take much room.
        evidence: Which frames show the hidden answer; None where that is unknown.
    """

    episode_id: EpisodeId
    condition: str
    sessions: tuple[Session, ...]
    adjacent: NDArray[np.float32]
    alike: NDArray[np.float32]
    typical: float
    closest: Callable[[Span], NDArray[np.float32]]
    evidence: tuple[Evidence, ...] | None = None

    @property
    def lesson(self) -> tuple[Span, ...]:
        """The parts of the true lesson, in the buffer's order; none where it is absent."""
        return tuple((one.start, one.stop) for one in self.sessions if one.role == "lesson")


def measure(
    buffer: Buffer,
    encoder: str,
    camera: str = "front",
    query: NDArray[np.floating] | None = None,
) -> Similarities:
    """Look up the embeddings of a buffer and compare them.

    Args:
        buffer: The buffer.
        encoder: Name of the encoder.
        camera: Name of the camera.
        query: Embedding of the query frame, `(D,)`, of length 1; None for the stored first live
            observation.
    """
    embeddings = buffer.embeddings(encoder, camera)
    return Similarities(
        buffer.episode_id,
        buffer.condition,
        buffer.sessions,
        adjacent_cosines(embeddings),
        cosines(embeddings, buffer.query_embedding(encoder, camera) if query is None else query),
        buffer.index(encoder, camera).typical_cosine,
        lambda span: closest_cosines(buffer.embeddings(encoder, camera), span),
        buffer.evidence,
    )


@dataclass(frozen=True, eq=False)
class Choice:
    """What was chosen of a history, and what it was chosen by.

    Attributes:
        threshold: Cosine of adjacent frames below which the history was cut.
        frames: The chosen frames, ascending, `(n,) int64`, n at least 1.
        segments: All segments in order.
        scores: What segments were scored by; without those too short to be chosen, and empty if
            the method scores none.
    """

    threshold: float
    frames: NDArray[np.int64]
    segments: tuple[Span, ...]
    scores: Mapping[Span, float]

    @property
    def spans(self) -> tuple[Span, ...]:
        """The runs of chosen frames, in order."""
        return runs(self.frames.tolist())


def choose(measured: Similarities, rule: Rule) -> Choice:
    """Choose the part of a history that goes with the query frame.

    Args:
        measured: The buffer; only `oracle` looks at its sessions.
        rule: How to choose.
    """
    about = f"{measured.episode_id} under {measured.condition}"
    if not len(measured.alike):
        raise InvalidOptionError(
            f"{about}: the history is empty, there is nothing to choose from",
            "Retrieval needs a condition with history, such as k0; leave out no-history.",
        )
    threshold = rule.threshold(measured.typical)
    spans = segments(measured.adjacent, threshold)
    # Where all segments are short, all may be chosen (ours).
    candidates = [(a, b) for a, b in spans if b - a >= MIN_FRAMES] or list(spans)
    scores: dict[Span, float] = {}
    if rule.method == "top32":
        closest = np.argsort(-measured.alike, kind="stable")[:SAMPLE_FRAMES]
        return Choice(threshold, np.sort(closest), spans, scores)
    if score := _SCORES.get(rule.method):
        scores = {span: score(measured.alike[slice(*span)]) for span in candidates}
        # The first of equal ones, or the last.
        order = candidates[::-1] if rule.method == "latest" else candidates
        chosen = max(order, key=lambda span: scores[span])
        if rule.method == "joined":
            return Choice(threshold, _joined(measured, chosen, candidates), spans, scores)
    elif rule.method == "last":
        chosen = candidates[-1]
    elif rule.method == "random":
        lot = f"{measured.episode_id} {measured.condition}"
        number = int.from_bytes(sha256(f"robomme-interference random\n{lot}".encode()).digest())
        chosen = candidates[number % len(candidates)]
    elif measured.lesson:
        chosen = measured.lesson[0]
    else:
        raise InvalidOptionError(f"{about}: there is no lesson that oracle could choose")
    return Choice(threshold, np.arange(*chosen), spans, scores)


def _joined(measured: Similarities, first: Span, candidates: Sequence[Span]) -> NDArray[np.int64]:
    """Return the frames of a segment, and of those that hold a frame like one of its own."""
    following = measured.adjacent[first[0] : first[1] - 1]
    if not len(following):  # a single frame tells nothing of what frames that follow are like
        return np.arange(*first)
    alike = measured.closest(first) >= np.quantile(following, _FOLLOWING, method="lower")
    chosen = (span for span in candidates if span == first or alike[slice(*span)].any())
    return np.concatenate([np.arange(*span) for span in chosen])
