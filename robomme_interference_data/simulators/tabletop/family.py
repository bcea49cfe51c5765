"""What a task family is: a scene, a hidden answer, a script that shows it, and a judge."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Any, ClassVar

from numpy.random import RandomState

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.subgoal import Pixel

from .bodies import Color, SceneBuilder
from .camera import SIZE, to_pixels
from .episodes import turn_of
from .motion import Arm, Point, Script

_RECALLED = 2
"""Stream of random numbers; `episodes.turn_of` uses the others."""


@dataclass(frozen=True)
class Step:
    """One of the steps that carry out an answer.

    `text` says what to do, with `<point>` for each thing (see `Subgoal`); `at` is where these
    things are now, in m; `do` is the script.
    """

    text: str
    at: tuple[Point, ...]
    do: Callable[[Arm], Script]


@dataclass(frozen=True)
class Option:
    """An option of a multiple-choice question.

    `words` is empty where only the location distinguishes it; `marks` are points of the live
    scene in m: one for a thing, several for a path.
    """

    words: str
    marks: tuple[Point, ...] = ()


class Family(ABC):
    """One episode of a task family.

    Only the demonstration, the solution and the judge receive the answer. Goal and first live
    scene are made without it, so they cannot reveal it.

    Args:
        difficulty: `easy`, `medium` or `hard`.
        rng: Source of everything in the scene but the answer. `RandomState`, because its numbers
            are the same in every version of NumPy.

    Attributes:
        table: Color of the table; `floor` that of the floor.
        side: Pixels of the front image, vertically and horizontally.
        stick: Length in m of the stick that the gripper holds; 0 for none.
        pace: Speed of the scripted motion: 1 is 0.25 m/s at the middle of a move.
        goal: The goal.
        question: The question about the demonstration; it is asked together with the goal.
        steps: Number of steps of the task.
        answers: All answers that the scene allows; one is the hidden one.
        showing: Numbers of the parts of the answer that the demonstration shows now; set by its
            script.
    """

    table: ClassVar[Color]
    floor: ClassVar[Color] = (0.55, 0.57, 0.60)
    side: ClassVar[int] = SIZE
    stick: ClassVar[float] = 0.0
    pace: ClassVar[float] = 0.6
    goal: str
    question: str
    steps: int
    answers: Sequence[Any]
    showing: tuple[int, ...] = ()

    def __init__(self, difficulty: str, rng: RandomState):
        self.level = DIFFICULTIES.index(difficulty)
        self.draw(rng)

    @abstractmethod
    def draw(self, rng: RandomState) -> None:
        """Draw the scene, and set those of `goal`, `question`, `steps` and `answers` that vary."""

    @abstractmethod
    def build(self, builder: SceneBuilder) -> None:
        """Build the scene's bodies."""

    @abstractmethod
    def answer_texts(self, answer: Any) -> tuple[str, ...]:
        """Return the parts of an answer as texts, in the order of the demonstration."""

    def choice(self, answer: Any) -> Any:
        """Return the part of an answer that the question asks for."""
        return answer

    @abstractmethod
    def option(self, choice: Any) -> Option:
        """Return how a choice is presented in the live scene."""

    def pixels(self, marks: Sequence[Point]) -> tuple[Pixel, ...]:
        """Project points of the live scene into the front image, (y, x) in pixels."""
        return to_pixels(marks)

    def own_answer(self, seed: int) -> Any:
        """Return the answer of the episode of a seed."""
        return self.answers[turn_of(seed, len(self.answers))]

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

    @abstractmethod
    def demonstrate(self, arm: Arm, answer: Any) -> Script:
        """Show the answer, and keep `showing` current."""

    def go_home(self, arm: Arm, steps: int) -> Script:
        """Return to the home pose in a number of time steps; the last one shows nothing more."""
        script = arm.lasting(steps, arm.go_home())
        yield from islice(script, steps - 1)
        self.showing = ()
        yield from script

    def react(self, arm: Arm) -> None:
        """Update the scene after a step: lamps, the cap of a button."""

    def solve(self, arm: Arm, answer: Any) -> Script:
        """Solve the task with an answer, step by step."""
        for number in range(self.steps):
            yield from self.step(answer, number).do(arm)

    @abstractmethod
    def step(self, answer: Any, number: int) -> Step:
        """Return one of these steps, counted from 0."""

    def progress(self) -> int:
        """Return how many steps are done, according to the judge."""
        return 0

    @abstractmethod
    def judge(self, arm: Arm, answer: Any) -> Status:
        """Return the status of the episode after a live step."""


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
            left = [one for one in left if one[1][index] == (text,)] or left
    return [candidate for candidate, _ in left]
