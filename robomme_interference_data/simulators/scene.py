"""The possible answers of an episode's scene: pure rules for all simulators."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from numpy.random import RandomState

from robomme_interference_data.schema.subgoal import Pixel

Pair = tuple[int, int]

_RECALLED = 2
"""Stream of random numbers; `tabletop.episodes.turn_of` uses the others."""


@dataclass(frozen=True)
class Option:
    """An option of a multiple-choice question.

    `words` is empty where only the location distinguishes it; `marks` are points of the live
    scene, as `Scene.pixels` takes them: one for a thing, several for a path.
    """

    words: str
    marks: tuple[Any, ...] = ()


class Scene(ABC):
    """What may be hidden in one episode, and what a demonstration shows of it.

    Attributes:
        question: The question about the demonstration; it is asked together with the goal.
        answers: All answers that the scene allows; one is the hidden one.
        side: Pixels of the front image, vertically and horizontally.
    """

    question: str
    answers: Sequence[Any]
    side: int

    @abstractmethod
    def answer_texts(self, answer: Any) -> tuple[str, ...]:
        """Return the parts of an answer as texts, in the order of the demonstration."""

    @abstractmethod
    def own_answer(self, seed: int) -> Any:
        """Return the hidden answer of the episode of a seed."""

    def choice(self, answer: Any) -> Any:
        """Return the part of an answer that the question asks for."""
        return answer

    @abstractmethod
    def option(self, choice: Any) -> Option:
        """Return how a choice is presented in the live scene."""

    @abstractmethod
    def pixels(self, marks: Sequence[Any]) -> tuple[Pixel, ...]:
        """Return where points of the live scene are in the front image, (y, x) in pixels."""

    def parts(self, answer: Any) -> tuple[str, ...]:
        """Return everything that one must see to know the answer, as texts, in order."""
        return self.answer_texts(answer)

    def lessons(self) -> Iterable[tuple[Any, tuple[str, ...]]]:
        """Return all pairs of an answer and its texts; an answer may have several texts."""
        return ((answer, self.answer_texts(answer)) for answer in self.answers)

    def agreeing(self, known: Mapping[int, str]) -> list[Any]:
        """Return the answers that are consistent with the known parts of a demonstration.

        With no known part these are all answers, with every part only the right one. Where parts
        of several demonstrations contradict each other, the earlier ones take precedence.

        Args:
            known: Number of a part to its text.
        """
        fitting = set(consistent(self._lessons, known))
        return [answer for answer in self.answers if answer in fitting]

    def recalled(self, known: Mapping[int, str], seed: int) -> Any:
        """Draw an agreeing answer: the first in an order that depends on the seed alone.

        So an answer that was drawn and is right stays drawn when more parts are known.
        """
        left = set(self.agreeing(known))
        return next(answer for answer in self.shuffled(seed) if answer in left)

    def shuffled(self, seed: int) -> list[Any]:
        """Return the answers in an order that depends on the seed alone."""
        order = RandomState([seed, _RECALLED]).permutation(len(self.answers))
        return [self.answers[number] for number in order]

    @cached_property
    def _lessons(self) -> list[tuple[Any, tuple[str, ...]]]:
        return list(self.lessons())


class SwapScene(Scene):
    """A scene whose answer is the number of a thing, or the numbers of several.

    Things may swap places in pairs after the answer was shown. Each swap is then a part to
    remember: without it, one knows where a thing was, but not where it is.

    Attributes:
        swaps: Pairs of things that swap places, one pair after the other.
    """

    swaps: Sequence[Pair] = ()

    @abstractmethod
    def possible_swaps(self) -> Mapping[tuple[Pair, ...], tuple[str, ...]]:
        """Return every possible series of swaps, as pairs of places, with its texts."""

    def parts(self, answer: Any) -> tuple[str, ...]:
        """Return the texts of the answer, then one text per swap; see `Scene.parts`."""
        return (*self.answer_texts(answer), *swap_texts(swapped_places(self.swaps)))

    def choice(self, answer: Any) -> int:
        """Return the place where the thing ends that is asked for; of several, the first."""
        return final_places(answer, swapped_places(self.swaps))[0]

    def agreeing(self, known: Mapping[int, str]) -> list[Any]:
        """Return the answers that may end where the right one does; see `Scene.agreeing`."""
        actual = swapped_places(self.swaps)
        first = len(self.answer_texts(self.answers[0]))
        shown = {part: text for part, text in known.items() if part < first}
        fitting = consistent([*self.possible_swaps().items()], known, first)
        ends = {
            final_places(answer, swaps) for answer in super().agreeing(shown) for swaps in fitting
        }
        return [answer for answer in self.answers if final_places(answer, actual) in ends]


def consistent[T](
    candidates: Sequence[tuple[T, tuple[str, ...]]], known: Mapping[int, str], first: int = 0
) -> list[T]:
    """Return the candidates whose texts agree with the known ones.

    A known text that no remaining candidate has is ignored. `first` is the part number of a
    candidate's first text.
    """
    left = candidates
    for part, text in known.items():
        if part >= first:
            index = slice(part - first, part - first + 1)
            left = [pair for pair in left if pair[1][index] == (text,)] or left
    return [candidate for candidate, _ in left]


def swapped_places(swaps: Iterable[Pair]) -> tuple[Pair, ...]:
    """Return the pairs of places of the swaps: all that is visible when things look alike."""
    at: dict[int, int] = {}
    pairs = []
    for one, other in swaps:
        places = at.get(one, one), at.get(other, other)
        at[other], at[one] = places
        pairs.append((min(places), max(places)))
    return tuple(pairs)


def final_places(answer: Any, pairs: Iterable[Pair]) -> tuple[int, ...]:
    """Return the places where the things of an answer end."""
    places = [answer] if isinstance(answer, int) else list(answer)
    for one, other in pairs:
        places = [other if at == one else one if at == other else at for at in places]
    return tuple(places)


def swap_texts(pairs: Iterable[Pair]) -> tuple[str, ...]:
    """Return a text per swap of two places."""
    return tuple(f"those at places {one} and {other} change places" for one, other in pairs)
