"""What a task family is: a scene, a hidden answer, a script that shows it, and a judge."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

from numpy.random import RandomState

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.subgoal import Pixel

from .camera import SIZE, to_pixels
from .episodes import turn_of
from .kit import Colour, Kit
from .motion import Arm, Point, Script

_RECALLED = 2
"""Stream of random numbers; see `episodes.turn_of` for the others."""


@dataclass(frozen=True)
class Step:
    """One of the steps in which an answer is carried out.

    Attributes:
        text: What is to be done, with `<point>` for the place of each thing (see `Subgoal`).
        at: These places as the scene stands now, in m.
        do: Does it.
    """

    text: str
    at: tuple[Point, ...]
    do: Callable[[Arm], Script]


@dataclass(frozen=True)
class Option:
    """How one of the possible answers is told in a question about the past.

    Attributes:
        words: In words, as far as they do; empty where only its place tells it.
        marks: Where it is in the live scene, in m: one point of a thing, or those of a path.
    """

    words: str
    marks: tuple[Point, ...] = ()


class Family(ABC):
    """One episode of a task family.

    The answer is handed only to what may know it: the demonstration, the solution and the judge.
    Goal and first live scene are made without it, so they cannot give it away.

    Args:
        difficulty: `easy`, `medium` or `hard`.
        rng: Source of everything in the scene but the answer. `RandomState`, because its numbers
            are the same in every version of NumPy.

    Attributes:
        answers: All answers that the scene allows; one is the hidden one.
        showing: Numbers of the parts of the answer that the demonstration shows now; its script
            sets them.
    """

    table: ClassVar[Colour]
    floor: ClassVar[Colour] = (0.55, 0.57, 0.60)
    side: ClassVar[int] = SIZE
    """Pixels of the front image, down and across."""

    stick: ClassVar[float] = 0.0
    """Length in m of the stick that the gripper holds; 0 for none."""

    pace: ClassVar[float] = 0.6
    """Speed of the scripted motion: 1 is 0.25 m/s at the middle of a move."""

    answers: Sequence[Any]
    showing: tuple[int, ...] = ()

    def __init__(self, difficulty: str, rng: RandomState):
        self.level = DIFFICULTIES.index(difficulty)
        self.draw(rng)

    @abstractmethod
    def draw(self, rng: RandomState) -> None:
        """Choose the scene, and set `answers`."""

    @abstractmethod
    def build(self, kit: Kit) -> None:
        """Build the scene's bodies at their places."""

    @abstractmethod
    def goals(self) -> tuple[str, ...]:
        """The goal in words, in one wording or more."""

    @abstractmethod
    def told(self, answer: Any) -> tuple[str, ...]:
        """The parts of an answer in words, in the order in which the demonstration shows them."""

    @abstractmethod
    def question(self) -> str:
        """What is asked about the past, beside the goal."""

    def choice(self, answer: Any) -> Any:
        """What the question asks for of an answer."""
        return answer

    @abstractmethod
    def option(self, choice: Any) -> Option:
        """How such a choice is told in the live scene."""

    def pixels(self, marks: Sequence[Point]) -> tuple[Pixel, ...]:
        """Where points are in the front image of the live scene, which is `side` pixels wide."""
        return to_pixels(marks)

    def own_answer(self, seed: int) -> Any:
        """The answer of the episode of a seed."""
        return self.answers[turn_of(seed, len(self.answers))]

    def parts(self, answer: Any) -> tuple[str, ...]:
        """All that must be seen of a demonstration to know the answer, in words, in order."""
        return self.told(answer)

    def lessons(self) -> Iterable[tuple[Any, tuple[str, ...]]]:
        """Every answer with what is told of it; several times, if in several ways."""
        return ((answer, self.told(answer)) for answer in self.answers)

    def agreeing(self, known: Mapping[int, str]) -> list[Any]:
        """The answers that somebody cannot rule out who has seen some parts of a demonstration.

        The more is known of one, the fewer they are: from all answers down to the one that was
        shown, which is always among them. Parts of several demonstrations may contradict each
        other: then those that come first are believed.

        Args:
            known: What was seen: the number of a part, and the part in words.
        """
        fits = set(narrowed(self._told, known))
        return [answer for answer in self.answers if answer in fits]

    def recalled(self, known: Mapping[int, str], seed: int) -> Any:
        """Draw one of the agreeing answers.

        It is the first of them in an order that the seed alone decides: who knows more keeps to
        the right answer, if it was drawn.
        """
        left = set(self.agreeing(known))
        return next(answer for answer in self.shuffled(seed) if answer in left)

    def shuffled(self, seed: int) -> list[Any]:
        """Return the answers in an order that the seed alone decides."""
        order = RandomState([seed, _RECALLED]).permutation(len(self.answers))
        return [self.answers[place] for place in order]

    @cached_property
    def _told(self) -> list[tuple[Any, tuple[str, ...]]]:
        return list(self.lessons())

    @abstractmethod
    def demonstrate(self, arm: Arm, answer: Any) -> Script:
        """Show the answer, and keep `showing`: it must not change what is done."""

    def react(self, arm: Arm) -> None:
        """Let the scene answer to the arm after a step: lamps, the cap of a button."""

    def solve(self, arm: Arm, answer: Any) -> Script:
        """Do the task as the answer says, step by step."""
        for number in range(self.steps()):
            yield from self.step(answer, number).do(arm)

    @abstractmethod
    def steps(self) -> int:
        """How many steps the task takes, whatever the answer."""

    @abstractmethod
    def step(self, answer: Any, number: int) -> Step:
        """One of these steps, from 0."""

    @abstractmethod
    def progress(self) -> int:
        """How many steps are done, as far as the judge has seen."""

    @abstractmethod
    def judge(self, arm: Arm, answer: Any) -> Status:
        """Say how the episode stands after a live step."""


def narrowed[T](
    told: Sequence[tuple[T, tuple[str, ...]]], known: Mapping[int, str], first: int = 0
) -> list[T]:
    """Return those that agree with what is known, passing over what none of them would.

    Args:
        told: What is possible, each with its parts in words.
        known: Parts by number, in words.
        first: Number of the first of these parts.
    """
    left = told
    for part, text in known.items():
        if part >= first:
            place, wanted = slice(part - first, part - first + 1), (text,)
            left = [one for one in left if one[1][place] == wanted] or left
    return [one for one, _ in left]
