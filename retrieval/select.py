"""Choose the part of a history that the policy receives, by a rule: a method and its number.

Every rule is a function of the history's embeddings and that of the first live observation. Only
`oracle`, a reference, uses the true sessions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Self, cast

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import InvalidOptionError, UnknownNameError

from .measure import Similarities
from .methods import METHODS, Method, Parts
from .segment import FrameSpan, segments

ADAPTIVE: Final = "adaptive"

MIN_FRAMES = 4
"""Minimum length of a segment that may be chosen, in frames (released reference)."""


@dataclass(frozen=True)
class Rule:
    """A method of choosing, and its number; validates itself.

    Attributes:
        name: Name of the method, one of `METHODS`.
        number: For a method that cuts, the cosine of the two sides of a border below which it cuts,
            or `adaptive` (ours): the middle between the cosine of unrelated frames and 1. The
            latter has no free parameter, and uses the train pool but no test episode. For a method
            without cuts its number of frames, if it has one. None means the default: `adaptive`, or
            the method's number of frames.
    """

    name: str = "max"
    number: float | Literal["adaptive"] | None = None

    def __post_init__(self) -> None:
        if self.name not in METHODS:
            raise UnknownNameError.none("method", self.name, METHODS)
        if self.number is None:
            default = self.method.frames if self.method.sides is None else ADAPTIVE
            object.__setattr__(self, "number", default)
        elif not self._fits(self.number):
            what = "number of frames" if self.method.sides is None else "threshold"
            raise InvalidOptionError.expected(
                f"the {what} of {self.name}", self.number, self._expected
            )

    @property
    def method(self) -> Method:
        """The method."""
        return METHODS[self.name]

    def _fits(self, number: Any) -> bool:
        if self.method.sides is not None:
            return number == ADAPTIVE or (isinstance(number, float | int) and -1 <= number <= 1)
        return self.method.frames is not None and isinstance(number, int) and number >= 1

    @property
    def _expected(self) -> str:
        if self.method.sides is not None:
            return f"a cosine, from −1 to 1, or {ADAPTIVE}, such as {self.name}/0.923"
        if self.method.frames is not None:
            return f"a number of frames, from 1, such as {self.name}/{self.method.frames}"
        return f"none: write {self.name}"

    @classmethod
    def parse(cls, text: str, published: float | None = None) -> Self:
        """Read `METHOD` or `METHOD/NUMBER`, such as `max`, `mean/0.9`, `max/adaptive`, `window/64`.

        Without a number, a method that cuts between adjacent frames has the threshold `published`
        for the encoder if there is one, and others their default.
        """
        name, slash, text = text.partition("/")
        rule = cls(name)
        if not slash:
            return cls(name, published) if rule.method.sides == 1 else rule
        number: Any = text
        for kind in (int, float):
            try:
                number = kind(text)
                break
            except ValueError:
                pass  # a word, or a number of the next kind
        return cls(name, number)

    def cosine(self, typical: float) -> float:
        """Return the cosine below which a method that cuts does so.

        Unrelated frames have the cosine `typical`.
        """
        return (1 + typical) / 2 if self.number == ADAPTIVE else float(cast("float", self.number))

    def __str__(self) -> str:
        """Return the text that `parse` reads, with every digit of the number."""
        if self.number is None:
            return self.name
        if isinstance(self.number, str):
            return f"{self.name}/{self.number}"
        return f"{self.name}/{float(self.number)!r}".removesuffix(".0")


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
class Choice:
    """The chosen part of a history.

    Attributes:
        rule: The rule that chose.
        spans: The runs of chosen frames, in order, with a gap between two; at least one.
        threshold: Cosine of the two sides of a border below which the history was cut; None if it
            was not.
        segments: All segments in order; none if it was not cut.
        scores: Score of each segment that may be chosen; empty if the method has no scores.
    """

    rule: Rule
    spans: tuple[FrameSpan, ...]
    threshold: float | None
    segments: tuple[FrameSpan, ...]
    scores: Mapping[FrameSpan, float]

    @property
    def frames(self) -> NDArray[np.int64]:
        """The chosen frames, ascending, `(n,) int64`, n at least 1."""
        return np.concatenate([np.arange(*span) for span in self.spans])


def choose(measured: Similarities, rule: Rule) -> Choice:
    """Choose the part of a history that matches the first live observation."""
    if not len(measured.alike):
        raise InvalidOptionError(
            f"{measured.episode_id} under {measured.condition}: the history is empty",
            "Retrieval needs a condition with a history, such as k0; leave out no-history.",
        )
    method = rule.method
    threshold: float | None = None
    cut: tuple[FrameSpan, ...] = ()
    if method.sides is not None:
        threshold = rule.cosine(measured.typical)
        cut = segments(measured.borders(method.sides), threshold, method.sides)
    # If all segments are short, all may be chosen (ours).
    candidates = [(a, b) for a, b in cut if b - a >= MIN_FRAMES] or list(cut)
    scores: dict[FrameSpan, float] = {}
    if method.score is not None:
        scores = {span: method.score(measured.alike[slice(*span)]) for span in candidates}
    frames = 0 if method.frames is None or rule.number is None else int(rule.number)
    chosen = method.choose(measured, Parts(candidates, scores, frames))
    return Choice(rule, _merged(chosen), threshold, cut, scores)


def _merged(spans: Sequence[FrameSpan]) -> tuple[FrameSpan, ...]:
    """Return spans in order, adjoining ones as one."""
    merged: list[FrameSpan] = []
    for start, stop in spans:
        if merged and merged[-1][1] == start:
            start, _ = merged.pop()  # noqa: PLW2901
        merged.append((start, stop))
    return tuple(merged)
