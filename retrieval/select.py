"""Choose which part of a history to hand to the policy: pure. The released rule and others.

Every rule is a function of the history's embeddings, the query's embedding and a threshold. The
true sessions are known to `oracle` alone, which is there to compare with.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import SAMPLE_FRAMES
from robomme_interference_data.errors import InvalidOptionError, UnknownNameError, nearest
from robomme_interference_data.retrieval.segment import (
    Span,
    adaptive_threshold,
    adjacent_cosines,
    cosines,
    long_enough,
    segments,
)

__all__ = [
    "ADAPTIVE",
    "METHODS",
    "SEGMENT_METHODS",
    "Choice",
    "Rule",
    "choose",
    "parse_rules",
    "pick",
]

ADAPTIVE: Final = "adaptive"


@dataclass(frozen=True, eq=False)
class Choice:
    """What was chosen of a history, and what it was chosen by.

    Attributes:
        method: One of `METHODS`.
        threshold: Cosine of adjacent frames below which the history was cut.
        frames: The chosen frames, ascending, `(n,) int64`, n at least 1.
        segments: All segments in order.
        scores: What each segment was scored by; None for those too short to be chosen, and for
            all if the method scores none.
        adjacent: Cosine of each frame with the next, `(T - 1,) float32`.
        query_cosines: Cosine of each frame with the query, `(T,) float32`.
    """

    method: str
    threshold: float
    frames: NDArray[np.int64]
    segments: tuple[Span, ...]
    scores: tuple[float | None, ...]
    adjacent: NDArray[np.float32]
    query_cosines: NDArray[np.float32]

    @property
    def span(self) -> Span:
        """First chosen frame, and the one after the last.

        Raises:
            InvalidOptionError: The chosen frames are not consecutive.
        """
        start, stop = int(self.frames[0]), int(self.frames[-1]) + 1
        if stop - start != len(self.frames):
            raise InvalidOptionError(
                f"method {self.method!r} chose {len(self.frames)} single frames, not a span",
                f"Choose a method that takes whole segments: {', '.join(SEGMENT_METHODS)}.",
            )
        return start, stop


def _highest(values: NDArray[np.float32]) -> float:
    return float(values.max())


def _mean(values: NDArray[np.float32]) -> float:
    return float(np.round(values.mean(dtype=np.float64), 6))


_SCORES: dict[str, Callable[[NDArray[np.float32]], float]] = {"max": _highest, "mean": _mean}

METHODS = {
    "max": "the segment with the frame closest to the query (released rule)",
    "mean": "the segment with the highest mean cosine with the query",
    "last": "the last segment",
    "random": "a segment by lot",
    "top32": "the 32 frames closest to the query, without segments",
    "oracle": "the true lesson",
}
"""What each method chooses. Ties go to the earliest."""

SEGMENT_METHODS = tuple(name for name in METHODS if name != "top32")


@dataclass(frozen=True)
class Rule:
    """A way to choose, and where to cut before; checks itself.

    Attributes:
        method: One of `METHODS`.
        cut: Cosine of adjacent frames below which a history is cut; `adaptive` for the cut that
            adapts to the encoder; None for the one published for the encoder, or, where there is
            none, the adaptive one.

    Raises:
        UnknownNameError: There is no such method.
        InvalidOptionError: The cut is no cosine.
    """

    method: str = "max"
    cut: float | Literal["adaptive"] | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UnknownNameError(
                f"there is no method {self.method!r}", nearest(self.method, METHODS)
            )
        if isinstance(self.cut, float | int) and not -1 <= self.cut <= 1:
            raise InvalidOptionError(
                f"threshold {self.cut} is no cosine; expected −1 to 1",
                "Leave it out for the encoder's own.",
            )

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `METHOD` or `METHOD/CUT`, such as `max`, `mean/0.9` or `max/adaptive`.

        Raises:
            UnknownNameError, InvalidOptionError: See the class.
        """
        method, slash, cut = text.partition("/")
        if not slash:
            return cls(method)
        if cut == ADAPTIVE:
            return cls(method, ADAPTIVE)
        try:
            return cls(method, float(cut))
        except ValueError as error:
            if isinstance(error, InvalidOptionError):
                raise
            raise InvalidOptionError(
                f"rule {text!r} cuts at {cut!r}; expected a cosine or {ADAPTIVE}",
                "For example: max/0.923",
            ) from None

    def settled(self, published: float | None) -> Self:
        """Return the rule with its cut named, given the one published for the encoder, if any."""
        own: float | Literal["adaptive"] = ADAPTIVE if published is None else published
        return type(self)(self.method, own if self.cut is None else self.cut)

    def threshold(self, typical: float) -> float:
        """Return the cosine below which a settled rule cuts data of this typical cosine."""
        if self.cut is None:
            raise InvalidOptionError("the rule's cut is not settled")
        return adaptive_threshold(typical) if self.cut == ADAPTIVE else float(self.cut)

    def __str__(self) -> str:
        """Return what `parse` reads, with every digit of the cut."""
        if self.cut is None:
            return self.method
        cut = ADAPTIVE if self.cut == ADAPTIVE else repr(float(self.cut)).removesuffix(".0")
        return f"{self.method}/{cut}"


def parse_rules(texts: Sequence[str], published: float | None) -> list[Rule]:
    """Read rules, and settle their cuts; `all` stands for every method, and for both cuts.

    Args:
        texts: What `Rule.parse` reads, or `all`.
        published: The cut that was published for the encoder, or None.

    Returns:
        The rules in the order given, each once.
    """
    rules: list[Rule] = []
    for text in texts:
        if text == "all":
            rules += [*map(Rule, METHODS), Rule("max", ADAPTIVE)]
        else:
            rules.append(Rule.parse(text))
    return list(dict.fromkeys(rule.settled(published) for rule in rules))


def choose(
    history: NDArray[np.float16],
    query: NDArray[np.floating],
    *,
    threshold: float,
    method: str = "max",
    lesson: Span | None = None,
    lot: str = "",
) -> Choice:
    """Choose the part of a history that a query needs.

    Args:
        history: `(T, D) float16`, each of length 1; T at least 1; may be a memory map.
        query: `(D,)`, of length 1: what the robot sees now.
        threshold: Cosine of adjacent frames below which the history is cut.
        method: One of `METHODS`.
        lesson: The true lesson; only `oracle` looks at it.
        lot: What `random` draws by, such as the query's id: the same text, the same segment.

    Raises:
        UnknownNameError: There is no such method.
        InvalidOptionError: The history is empty, or `oracle` is not told the lesson.
    """
    if not len(history):
        raise InvalidOptionError(
            "the history is empty: there is nothing to choose from",
            "Retrieval needs a condition with history, such as k0; leave out no-history.",
        )
    return pick(
        adjacent_cosines(history),
        cosines(history, query),
        threshold=threshold,
        method=method,
        lesson=lesson,
        lot=lot,
    )


def pick(
    adjacent: NDArray[np.float32],
    alike: NDArray[np.float32],
    *,
    threshold: float,
    method: str = "max",
    lesson: Span | None = None,
    lot: str = "",
) -> Choice:
    """Choose as `choose` does, from cosines that are known: several rules need them once.

    Args:
        adjacent: Cosine of each frame with the next, `(T - 1,) float32`.
        alike: Cosine of each frame with the query, `(T,) float32`.
        threshold: As for `choose`.
        method: As for `choose`.
        lesson: As for `choose`.
        lot: As for `choose`.

    Raises:
        UnknownNameError: There is no such method.
        InvalidOptionError: `oracle` is not told the lesson.
    """
    if method not in METHODS:
        raise UnknownNameError(f"there is no method {method!r}", nearest(method, METHODS))
    spans = segments(adjacent, threshold)
    candidates = list(long_enough(spans))
    scores: tuple[float | None, ...] = (None,) * len(spans)
    if method in _SCORES:
        score = _SCORES[method]
        found = {span: score(alike[slice(*span)]) for span in candidates}
        scores = tuple(found.get(span) for span in spans)
        chosen = max(candidates, key=lambda span: found[span])  # the first of equal ones
    elif method == "last":
        chosen = candidates[-1]
    elif method == "random":
        number = int.from_bytes(sha256(f"robomme-interference random\n{lot}".encode()).digest())
        chosen = candidates[number % len(candidates)]
    elif method == "oracle":
        if lesson is None:
            raise InvalidOptionError("method 'oracle' was not told the lesson")
        chosen = lesson
    else:
        order = np.argsort(-alike, kind="stable")[:SAMPLE_FRAMES]
        return Choice(method, threshold, np.sort(order), spans, scores, adjacent, alike)
    frames = np.arange(*chosen, dtype=np.int64)
    return Choice(method, threshold, frames, spans, scores, adjacent, alike)
