"""The possible answers of RoboMME's episodes, and which lesson frames show them: pure rules.

`facts.py` records what they need, from the attributes and the task list of RoboMME's environment.
Things are numbered as RoboMME makes them; a place is where a thing is before any swap. The numbers
of moves, placements and swaps of a lesson are taken as known: nearly all follow from its length,
which policies know.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from itertools import combinations, pairwise, product
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.schema.evidence import spans_of_parts
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.subgoal import Pixel
from robomme_interference_data.simulators.family_scenes import (
    MoveScene,
    PlaceScene,
    RepickScene,
    UnmaskScene,
    grid_paths,
    row_paths,
)
from robomme_interference_data.simulators.scene import (
    Option,
    Pair,
    Scene,
    SwapScene,
    final_places,
    swap_texts,
    swapped_places,
)

_UNRECORDED = ("static", "NO RECORD")
"""Names of tasks in which the robot rests, or that RoboMME does not record."""

_MAX_SWAPPING = 5  # things where some swap places: an untrusted scene may state any number


class Moment(NamedTuple):
    """What RoboMME did at a lesson frame.

    Attributes:
        step: Number of steps executed since the reset.
        task: Number of its current task.
        revealed: 1 if what containers hide is visible.
    """

    step: int
    task: int
    revealed: int


class OfficialScene(Scene):
    """The scene of one of RoboMME's episodes.

    Args:
        facts: What was recorded; see `facts.py`.
        difficulty: `easy`, `medium` or `hard`.

    Attributes:
        points: Where the things are in the first live front image, (y, x) in pixels.
    """

    side = 256

    def __init__(self, facts: Mapping[str, Any], difficulty: str):
        self.facts, self.difficulty = facts, difficulty
        self.points = [(int(y), int(x)) for y, x in facts["points"]]
        self.count = len(self.points)
        self.set_up()

    def set_up(self) -> None:
        """Set `answers` and the other attributes; by default, an answer is a thing's number."""
        self.answers = range(self.count)

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

    def evidence(self, moments: NDArray[np.int64]) -> tuple[EvidenceSpan, ...]:
        """Return which lesson frames show which part of the answer.

        Args:
            moments: `(T, 3) int64`, a `Moment` per lesson frame.
        """
        shown = [[*self.shown(Moment(*row))] for row in moments.tolist()]
        return spans_of_parts(shown, self.parts(self.own_answer(0)))

    def shown(self, moment: Moment) -> Iterable[int]:
        """Return the parts of the answer that a lesson frame shows; by default, one per task."""
        tasks = self.tasks_of()
        return (tasks.index(moment.task),) if moment.task in tasks else ()

    def tasks_of(self, *names: str) -> list[int]:
        """Return the numbers of the demonstration's tasks with these names; all moves if none."""
        tasks = [name for name, demonstration in self.facts["tasks"] if demonstration]
        return [
            number
            for number, name in enumerate(tasks)
            if (name in names if names else name not in _UNRECORDED)
        ]


class OfficialSwaps(SwapScene, OfficialScene):
    """A scene whose things may swap places."""

    def __init__(self, facts: Mapping[str, Any], difficulty: str):
        self.swaps = [(one, other) for one, other, _, _ in facts["swaps"]]
        super().__init__(facts, difficulty)
        if self.swaps and self.count > _MAX_SWAPPING:
            raise ValueError(f"{self.count} things swap places")

    def possible_swaps(self) -> Mapping[tuple[Pair, ...], tuple[str, ...]]:
        """Return every series of as many swaps."""
        return _swap_series(self.count, len(self.swaps))

    def option(self, choice: int) -> Option:
        """Return the point of the thing that is at a place now."""
        actual = swapped_places(self.swaps)
        [thing] = (
            candidate
            for candidate in range(self.count)
            if final_places(candidate, actual) == (choice,)
        )
        return super().option(thing)

    def shown(self, moment: Moment) -> Iterable[int]:
        """Return the swaps that are under way."""
        first = len(self.answer_texts(self.answers[0]))
        for part, (_, _, start, stop) in enumerate(self.facts["swaps"], first):
            if start < moment.step <= stop:
                yield part


class OfficialVideoUnmask(UnmaskScene, OfficialScene):
    """Containers over cubes."""

    def set_up(self) -> None:
        self.hide(self.count, self.facts["colors"])

    def shown(self, moment: Moment) -> Iterable[int]:
        return (0,) if moment.revealed else ()


class OfficialVideoUnmaskSwap(OfficialSwaps, OfficialVideoUnmask):
    """As `VideoUnmask`, then containers swap places."""

    def shown(self, moment: Moment) -> Iterable[int]:
        return (*OfficialVideoUnmask.shown(self, moment), *OfficialSwaps.shown(self, moment))


class OfficialVideoRepick(RepickScene, OfficialSwaps):
    """The arm picks one of several cubes, which may then swap places."""

    def shown(self, moment: Moment) -> Iterable[int]:
        yield from super().shown(moment)
        if moment.task in self.tasks_of("pick up the cube", "drop the cube on the table"):
            yield 0


class OfficialVideoPlaceButton(PlaceScene, OfficialSwaps):
    """The cube is placed on a target, a button is pressed, it is placed on another one."""

    cube = "the cube"
    times: Sequence[str] = ("before the button is pressed", "after the button is pressed")

    def set_up(self) -> None:
        super().set_up()
        self.asked = int(self.facts["asked"])

    def visits(self, answer: int) -> Sequence[int]:
        """Return those of another answer by exchanging it with the right one."""
        visits = self.facts["visits"]
        right = visits[self.asked]
        swap = {answer: right, right: answer}
        return [swap.get(visit, visit) for visit in visits]

    def shown(self, moment: Moment) -> Iterable[int]:
        """Return the placement after which the cube lies on a target, and the swaps."""
        yield from super().shown(moment)
        for number, task in enumerate(self.tasks_of("drop the cube onto target")):
            later = (
                later_task for later_task in self.tasks_of("pick up the cube") if later_task > task
            )
            if task <= moment.task < next(later, task + 1):
                yield number


class OfficialVideoPlaceOrder(OfficialVideoPlaceButton):
    """The cube is placed on two to four targets in sequence."""

    def set_up(self) -> None:
        super().set_up()
        ordinals = ("first", "second", "third", "fourth")[: len(self.facts["visits"])]
        self.times = [f"as the {ordinal} one" for ordinal in ordinals]


class OfficialMoveCube(MoveScene, OfficialScene):
    """The arm moves a cube to the target in one of three manners."""

    words: ClassVar = {
        "peg_push": "hooks the cube with the peg",
        "gripper_push": "pushes the cube with the closed gripper",
        "grasp_putdown": "grasps the cube",
    }

    def set_up(self) -> None:
        self.answers = list(self.words)

    def shown(self, moment: Moment) -> Iterable[int]:
        return (0,) if moment.task in self.tasks_of() else ()


class OfficialInsertPeg(OfficialScene):
    """The arm picks up one of three pegs by one end, and inserts it from one side of the box."""

    question = "Which peg was picked up, by which end, and from which side was it inserted?"

    def set_up(self) -> None:
        self.answers = list(product(range(self.count), ("near", "far"), ("left", "right")))

    def answer_texts(self, answer: tuple[int, str, str]) -> tuple[str, ...]:
        peg, end, side = answer
        return f"picks up peg {peg} by the {end} end", f"inserts it from the {side} side"

    def option(self, choice: tuple[int, str, str]) -> Option:
        peg, end, side = choice
        return Option(f"this peg, by the {end} end, from the {side} side", (self.points[peg],))


class OfficialPatternLock(OfficialScene):
    """A path over a grid of buttons; the stick begins the episode above the first one."""

    question = "Which path did the stick take over the buttons? Each picture shows one."

    def set_up(self) -> None:
        self.side_buttons = round(self.count**0.5)
        answer = self.facts["answer"]
        self.answers = grid_paths(self.side_buttons, (answer[0],), len(answer))

    def answer_texts(self, answer: Sequence[int]) -> tuple[str, ...]:
        spots = [divmod(button, self.side_buttons) for button in answer]
        moves = pairwise(spots)
        return tuple(f"moves {_direction(r1 - r0, c1 - c0)}" for (r0, c0), (r1, c1) in moves)


class OfficialRouteStick(OfficialScene):
    """A path past posts: from target to neighboring target, around the post between them.

    An answer is the targets, from right to left 0 to 4, and the direction of each move. The stick
    begins the episode above the first target.
    """

    question = "Which path did the stick take around the posts? Each picture shows one."

    def set_up(self) -> None:
        (start, *moves), _ = self.facts["answer"]
        routes = row_paths(self.count, (start,), len(moves), back=self.difficulty == "hard")
        turns = product(("clockwise", "counterclockwise"), repeat=len(moves))
        self.answers = list(product(routes, turns))

    def answer_texts(self, answer: tuple[Sequence[int], Sequence[str]]) -> tuple[str, ...]:
        route, turns = answer
        moves = zip(pairwise(route), turns, strict=True)
        return tuple(
            f"moves to the {'left' if to > at else 'right'}, {turn}" for (at, to), turn in moves
        )

    def option(self, choice: tuple[Sequence[int], Sequence[str]]) -> Option:
        return Option("; ".join(self.answer_texts(choice)))


@cache
def _swap_series(count: int, swaps: int) -> dict[tuple[Pair, ...], tuple[str, ...]]:
    series = product(combinations(range(count), 2), repeat=swaps)
    return {swaps_made: swap_texts(swaps_made) for swaps_made in series}


def _direction(rows: int, columns: int) -> str:
    """Return the words for a step on the grid, as RoboMME writes them."""
    along = {1: "forward", -1: "backward"}.get(rows)
    across = {1: "left", -1: "right"}.get(columns)
    return "-".join(word for word in (along, across) if word)


def _frozen(value: Any) -> Any:
    """Return JSON's lists as tuples."""
    return tuple(map(_frozen, value)) if isinstance(value, list) else value
