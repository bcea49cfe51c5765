"""The possible answers of RoboMME's episodes, and which lesson frames show them: pure rules.

`facts.py` records what they need, from the attributes and the task list of RoboMME's environment.
Things are numbered as RoboMME makes them; a place is where a thing is before any swap. How many
moves, placements or swaps a lesson shows is taken as known, since its length, which policies are
told, tells it.
"""

import json
from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from functools import cache, lru_cache
from itertools import combinations, pairwise, permutations, product
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.evidence import spans_of_parts
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.subgoal import Pixel
from robomme_interference_data.simulators.scene import (
    Option,
    Pair,
    Scene,
    SwapScene,
    final_places,
    swap_texts,
    swapped_places,
)

_SIDE = 256
_UNRECORDED = ("static", "NO RECORD")
"""Names of tasks in which the robot rests, or that RoboMME does not record."""

_ORDINALS = ("first", "second", "third", "fourth")


class OfficialScene(Scene):
    """The scene of one of RoboMME's episodes.

    Args:
        facts: What was recorded; see `facts.py`.
        difficulty: `easy`, `medium` or `hard`.

    Attributes:
        points: Where the things are in the first live front image, (y, x) in pixels.
    """

    side = _SIDE

    def __init__(self, facts: Mapping[str, Any], difficulty: str):
        self.facts, self.difficulty = facts, difficulty
        self.points = [(int(y), int(x)) for y, x in facts["points"]]
        self.set_up()

    def set_up(self) -> None:
        """Set `answers` and the other attributes."""

    def own_answer(self, seed: int) -> Any:
        """Return the recorded hidden answer; the seed does not matter."""
        return _frozen(self.facts["answer"])

    def option(self, choice: Any) -> Option:
        """Return the point of a thing, or of the things on a path."""
        things = [choice] if isinstance(choice, int) else choice
        return Option("", tuple(self.points[thing] for thing in things))

    def pixels(self, marks: Sequence[Pixel]) -> tuple[Pixel, ...]:
        """Return the points themselves."""
        return tuple(marks)

    def shown(self, moment: "Moment") -> Iterable[int]:
        """Return the parts of the answer that a lesson frame shows."""
        return ()

    def tasks_of(self, *names: str) -> list[int]:
        """Return the numbers of the demonstration's tasks with these names; all moves if none."""
        tasks = [name for name, demonstration in self.facts["tasks"] if demonstration]
        return [
            number
            for number, name in enumerate(tasks)
            if (name in names if names else name not in _UNRECORDED)
        ]


class Moment:
    """What RoboMME did at a lesson frame.

    Attributes:
        step: Number of steps executed since the reset.
        task: Number of its current task.
        revealed: Whether what containers hide is visible.
    """

    def __init__(self, step: int, task: int, revealed: int):
        self.step, self.task, self.revealed = int(step), int(task), bool(revealed)


def read_scene(family: str, recorded: str, difficulty: str) -> OfficialScene | None:
    """Return the scene that was recorded as JSON; None for another family.

    Raises:
        FormatError: The text is not what `facts.py` records.
    """
    return None if family not in _SCENES else _read_scene(family, recorded, difficulty)


@lru_cache(8)
def _read_scene(family: str, recorded: str, difficulty: str) -> OfficialScene:
    try:
        scene = _SCENES[family](json.loads(recorded), difficulty)
        if scene.own_answer(0) not in scene.answers:
            raise ValueError(f"the answer {scene.own_answer(0)} is not possible")
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise FormatError(f"the recorded scene of {family} is damaged: {error}") from error
    return scene


def evidence_of(scene: OfficialScene, moments: NDArray[np.int64]) -> tuple[EvidenceSpan, ...]:
    """Return which lesson frames show which part of the answer.

    Args:
        scene: The scene.
        moments: `(T, 3) int64`, per lesson frame: steps since the reset, number of the current
            task, 1 if what containers hide is visible.
    """
    shown = [frozenset(scene.shown(Moment(*row))) for row in moments.tolist()]
    return spans_of_parts(shown, scene.parts(scene.own_answer(0)))


class OfficialSwaps(SwapScene, OfficialScene):
    """A scene whose things may swap places."""

    def set_up(self) -> None:
        self.count = len(self.points)
        self.swaps = [(one, other) for one, other, _, _ in self.facts["swaps"]]
        self.answers: Sequence[Any] = range(self.count)

    def possible_swaps(self) -> Mapping[tuple[Pair, ...], tuple[str, ...]]:
        """Return every series of as many swaps."""
        return _swap_series(self.count, len(self.swaps))

    def option(self, choice: int) -> Option:
        """Return the point of the thing that is at a place now."""
        actual = swapped_places(self.swaps)
        [thing] = (one for one in range(self.count) if final_places(one, actual) == (choice,))
        return Option("", (self.points[thing],))

    def shown(self, moment: Moment) -> Iterable[int]:
        """Return the swaps that are under way."""
        first = len(self.answer_texts(self.answers[0]))
        for part, (_, _, start, stop) in enumerate(self.facts["swaps"], first):
            if start < moment.step <= stop:
                yield part


class VideoUnmask(OfficialScene):
    """Containers over cubes; an answer is the container of each color asked for, in order."""

    def set_up(self) -> None:
        self.colors = tuple(self.facts["colors"])
        self.question = f"Which of the marked containers hides the {self.colors[0]} cube?"
        self.answers = list(permutations(range(len(self.points)), len(self.colors)))

    def answer_texts(self, answer: Sequence[int]) -> tuple[str, ...]:
        cubes = (f"the {c} cube at place {n}" for c, n in zip(self.colors, answer, strict=True))
        return (f"shows {' and '.join(cubes)}",)

    def choice(self, answer: Sequence[int]) -> int:
        return answer[0]

    def shown(self, moment: Moment) -> Iterable[int]:
        return (0,) if moment.revealed else ()


class VideoUnmaskSwap(OfficialSwaps, VideoUnmask):
    """As `VideoUnmask`, then containers swap places."""

    def set_up(self) -> None:
        super().set_up()
        VideoUnmask.set_up(self)

    def shown(self, moment: Moment) -> Iterable[int]:
        return (*VideoUnmask.shown(self, moment), *OfficialSwaps.shown(self, moment))


class VideoRepick(OfficialSwaps):
    """The arm picks one of several cubes, which may then swap places."""

    question = "Which of the marked cubes was picked up?"

    def answer_texts(self, answer: int) -> tuple[str, ...]:
        return (f"lifts cube {answer}",)

    def shown(self, moment: Moment) -> Iterable[int]:
        yield from super().shown(moment)
        if moment.task in self.tasks_of("pick up the cube", "drop the cube on the table"):
            yield 0


class Place(OfficialSwaps):
    """A cube is placed on several targets; the goal asks for one of these placements.

    Attributes:
        asked: Which placement it asks for, from 0.
    """

    question = "Which of the marked targets does the goal mean?"

    def set_up(self) -> None:
        super().set_up()
        self.asked, self.visits = int(self.facts["asked"]), tuple(self.facts["visits"])

    @abstractmethod
    def visit_texts(self, visits: Sequence[int]) -> tuple[str, ...]:
        """Return a text per placement."""

    def answer_texts(self, answer: int) -> tuple[str, ...]:
        """Return a text per placement; those of another answer exchange it with the right one."""
        right = self.visits[self.asked]
        swap = {answer: right, right: answer}
        return self.visit_texts([swap.get(visit, visit) for visit in self.visits])

    def lessons(self) -> Iterable[tuple[int, tuple[str, ...]]]:
        orders = permutations(range(self.count), len(self.visits))
        return ((visits[self.asked], self.visit_texts(visits)) for visits in orders)

    def shown(self, moment: Moment) -> Iterable[int]:
        """Return the placement after which the cube lies on a target, and the swaps."""
        yield from super().shown(moment)
        for number, task in enumerate(self.tasks_of("drop the cube onto target")):
            later = (one for one in self.tasks_of("pick up the cube") if one > task)
            if task <= moment.task < next(later, task + 1):
                yield number


class VideoPlaceButton(Place):
    """The cube is placed on a target, a button is pressed, it is placed on another one."""

    def visit_texts(self, visits: Sequence[int]) -> tuple[str, ...]:
        times = ("before", "after")
        return tuple(
            f"puts the cube on target {visit} {time} the button is pressed"
            for visit, time in zip(visits, times, strict=True)
        )


class VideoPlaceOrder(Place):
    """The cube is placed on two to four targets in sequence."""

    def visit_texts(self, visits: Sequence[int]) -> tuple[str, ...]:
        return tuple(
            f"puts the cube on target {visit} as the {ordinal} one"
            for visit, ordinal in zip(visits, _ORDINALS, strict=False)
        )


class MoveCube(OfficialScene):
    """The arm moves a cube to the target in one of three manners."""

    question = "In which manner was the cube moved to the target?"
    words: ClassVar[dict[str, str]] = {
        "peg_push": "hooks the cube with the peg",
        "gripper_push": "pushes the cube with the closed gripper",
        "grasp_putdown": "grasps the cube",
    }

    def set_up(self) -> None:
        self.answers = list(self.words)

    def answer_texts(self, answer: str) -> tuple[str, ...]:
        return (self.words[answer],)

    def option(self, choice: str) -> Option:
        return Option(self.words[choice])

    def shown(self, moment: Moment) -> Iterable[int]:
        return (0,) if moment.task in self.tasks_of() else ()


class InsertPeg(OfficialScene):
    """The arm picks up one of three pegs by one end, and inserts it from one side of the box."""

    question = "Which peg was picked up, by which end, and from which side was it inserted?"

    def set_up(self) -> None:
        pegs, ends, sides = range(len(self.points)), ("near", "far"), ("left", "right")
        self.answers = list(product(pegs, ends, sides))

    def answer_texts(self, answer: tuple[int, str, str]) -> tuple[str, ...]:
        peg, end, side = answer
        return f"picks up peg {peg} by the {end} end", f"inserts it from the {side} side"

    def option(self, choice: tuple[int, str, str]) -> Option:
        peg, end, side = choice
        words = f"this peg, by the {end} end, from the {side} side"
        return Option(words, (self.points[peg],))

    def shown(self, moment: Moment) -> Iterable[int]:
        tasks = self.tasks_of()
        return (tasks.index(moment.task),) if moment.task in tasks else ()


class Moves(OfficialScene):
    """The stick moves from thing to thing; it begins the episode above the first one."""

    def shown(self, moment: Moment) -> Iterable[int]:
        """Return the move under way."""
        tasks = self.tasks_of()
        return (tasks.index(moment.task),) if moment.task in tasks else ()


class PatternLock(Moves):
    """A path over a grid of buttons; each is adjacent to the one before, straight or diagonally."""

    question = "Which path did the stick take over the buttons? Each picture shows one."

    def set_up(self) -> None:
        self.columns = round(len(self.points) ** 0.5)
        start, *moves = self.facts["answer"]
        self.answers = _grid_paths(self.columns, start, len(moves))

    def answer_texts(self, answer: Sequence[int]) -> tuple[str, ...]:
        spots = [divmod(button, self.columns) for button in answer]
        moves = pairwise(spots)
        return tuple(f"moves {_direction(r1 - r0, c1 - c0)}" for (r0, c0), (r1, c1) in moves)


class RouteStick(Moves):
    """A path past posts: from target to neighboring target, around the post between them.

    An answer is the targets, from right to left 0 to 4, and the direction of each move.
    """

    question = "Which path did the stick take around the posts? Each picture shows one."
    turns = ("clockwise", "counterclockwise")

    def set_up(self) -> None:
        (start, *moves), _ = self.facts["answer"]
        back = self.difficulty == "hard"
        routes = _row_paths(len(self.points), start, len(moves), back=back)
        self.answers = [*product(routes, product(self.turns, repeat=len(moves)))]

    def answer_texts(self, answer: tuple[Sequence[int], Sequence[str]]) -> tuple[str, ...]:
        route, turns = answer
        moves = zip(route, route[1:], turns, strict=False)
        return tuple(
            f"moves to the {'left' if to > at else 'right'}, {turn}" for at, to, turn in moves
        )

    def option(self, choice: tuple[Sequence[int], Sequence[str]]) -> Option:
        return Option("; ".join(self.answer_texts(choice)))


_SCENES: dict[str, type[OfficialScene]] = {
    each.__name__: each
    for each in (
        *(VideoRepick, VideoPlaceOrder, VideoPlaceButton, VideoUnmask, VideoUnmaskSwap),
        *(MoveCube, InsertPeg, PatternLock, RouteStick),
    )
}


@cache
def _swap_series(count: int, swaps: int) -> dict[tuple[Pair, ...], tuple[str, ...]]:
    series = product(combinations(range(count), 2), repeat=swaps)
    return {one: swap_texts(one) for one in series}


@cache
def _grid_paths(columns: int, start: int, moves: int) -> list[tuple[int, ...]]:
    """Return the paths over a square grid that visit no button twice."""
    paths: list[tuple[int, ...]] = [(start,)]
    for _ in range(moves):
        paths = [
            (*path, button)
            for path in paths
            for button in _neighbors(columns, path[-1])
            if button not in path
        ]
    return paths


@cache
def _neighbors(columns: int, button: int) -> list[int]:
    row, column = divmod(button, columns)
    near = product(range(row - 1, row + 2), range(column - 1, column + 2))
    inside = ((r, c) for r, c in near if 0 <= r < columns and 0 <= c < columns)
    return [r * columns + c for r, c in inside if (r, c) != (row, column)]


def _row_paths(count: int, start: int, moves: int, *, back: bool) -> list[tuple[int, ...]]:
    """Return the paths along a row; they turn back only where `back`, or at an end of the row."""
    paths: list[tuple[int, ...]] = [(start,)]
    for _ in range(moves):
        longer = []
        for path in paths:
            near = [one for one in (path[-1] - 1, path[-1] + 1) if 0 <= one < count]
            onward = [one for one in near if back or one not in path[-2:-1]] or near
            longer += [(*path, one) for one in onward]
        paths = longer
    return paths


def _direction(rows: int, columns: int) -> str:
    """Return the words for a step on the grid, as RoboMME says them."""
    along = {1: "forward", -1: "backward"}.get(rows)
    across = {1: "left", -1: "right"}.get(columns)
    return "-".join(word for word in (along, across) if word)


def _frozen(value: Any) -> Any:
    """Return JSON's lists as tuples."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value
