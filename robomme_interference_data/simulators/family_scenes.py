"""The answers that families have in all simulators."""

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import permutations, product
from typing import ClassVar

from .scene import Option, Scene, SwapScene


class UnmaskScene(Scene):
    """A scene of containers; an answer is the container of each color asked for, in order."""

    def hide(self, count: int, asked: Sequence[str]) -> None:
        """Set question and answers, for a number of containers and the colors asked for."""
        self.asked = tuple(asked)
        self.question = f"Which of the marked containers hides the {self.asked[0]} cube?"
        self.answers = list(permutations(range(count), len(self.asked)))

    def answer_texts(self, answer: Sequence[int]) -> tuple[str, ...]:
        """Return one text."""
        cubes = (f"the {c} cube at place {n}" for c, n in zip(self.asked, answer, strict=True))
        return (f"shows {' and '.join(cubes)}",)

    def choice(self, answer: Sequence[int]) -> int:
        """Return the container of the first color."""
        return answer[0]


class RepickScene(SwapScene):
    """A scene of cubes, one of which is picked up; an answer is its number."""

    question = "Which of the marked cubes was picked up?"

    def answer_texts(self, answer: int) -> tuple[str, ...]:
        """Return one text."""
        return (f"lifts cube {answer}",)


class PlaceScene(SwapScene):
    """A scene in which a cube visits several targets; the goal asks for one of these visits.

    Attributes:
        count: How many targets there are.
        cube: The cube, in words.
        times: Texts of when it visits a target, in order.
        asked: Which visit the goal asks for, from 0.
    """

    question = "Which of the marked targets does the goal mean?"
    count: int
    cube: str
    times: Sequence[str]
    asked: int

    @abstractmethod
    def visits(self, answer: int) -> Sequence[int]:
        """Return the targets that the cube visits, in order."""

    def visit_texts(self, visits: Sequence[int]) -> tuple[str, ...]:
        """Return a text per visit."""
        steps = zip(visits, self.times, strict=True)
        return tuple(f"puts {self.cube} on target {target} {time}" for target, time in steps)

    def answer_texts(self, answer: int) -> tuple[str, ...]:
        """Return a text per visit."""
        return self.visit_texts(self.visits(answer))

    def lessons(self) -> Iterable[tuple[int, tuple[str, ...]]]:
        """Return all visits of targets in any order; see `Scene.lessons`."""
        orders = permutations(range(self.count), len(self.times))
        return ((visits[self.asked], self.visit_texts(visits)) for visits in orders)


class MoveScene(Scene):
    """A scene whose answer is the manner in which a cube is moved to a target.

    Attributes:
        words: Manner to its text.
    """

    question = "In which manner was the cube moved to the target?"
    words: ClassVar[Mapping[str, str]]

    def answer_texts(self, answer: str) -> tuple[str, ...]:
        """Return one text."""
        return (self.words[answer],)

    def option(self, choice: str) -> Option:
        """Return the text."""
        return Option(self.words[choice])


@cache
def grid_paths(side: int, starts: Iterable[int], count: int) -> list[tuple[int, ...]]:
    """Return all paths of `count` different fields of a square grid, from one of `starts`.

    Each field is adjacent to the one before it, straight or diagonally.
    """
    paths: list[tuple[int, ...]] = [(start,) for start in starts]
    for _ in range(count - 1):
        paths = [(*path, to) for path in paths for to in _near(side, path[-1]) if to not in path]
    return paths


@cache
def _near(side: int, field: int) -> list[int]:
    """Return a field of a square grid and those around it, in order."""
    row, column = divmod(field, side)
    rows, columns = (range(max(at - 1, 0), min(at + 2, side)) for at in (row, column))
    return [r * side + c for r, c in product(rows, columns)]


def row_paths(
    count: int, starts: Iterable[int], moves: int, *, back: bool = True
) -> list[tuple[int, ...]]:
    """Return all paths along a row of `count` places, from one of `starts` to its neighbor.

    They turn back only where `back`, or at an end of the row.
    """
    paths: list[tuple[int, ...]] = [(start,) for start in starts]
    for _ in range(moves):
        longer = []
        for path in paths:
            near = [place for place in (path[-1] - 1, path[-1] + 1) if 0 <= place < count]
            onward = [place for place in near if back or place not in path[-2:-1]] or near
            longer += [(*path, place) for place in onward]
        paths = longer
    return paths
