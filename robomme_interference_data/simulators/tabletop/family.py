"""What a task family is: a scene, a hidden answer, a script that shows it, and a judge.

At the end is geometry that several families share.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.subgoal import Pixel
from robomme_interference_data.simulators.scene import Scene

from .bodies import Body, Color, Placement, SceneBuilder
from .camera import SIZE, to_pixels
from .episodes import turn_of
from .motion import Arm, Point, Script, eased

TablePoint = tuple[float, float]
"""x and y on the table, in m."""

Vector = NDArray[np.float64]
"""The same, `(2,)` or `(3,)`, to calculate with."""

ABOVE = 0.001
"""How far above a surface the stick's tip stops when it touches it, in m."""


@dataclass(frozen=True)
class Step:
    """One of the steps that carry out an answer.

    `text` says what to do, with `<point>` for each thing (see `Subgoal`); `at` is where these
    things are now, in m; `do` is the script.
    """

    text: str
    at: tuple[Point, ...]
    do: Callable[[Arm], Script]


class Layout(Protocol):
    """What stands on the table: an episode of a family, or a scene between two; see `Family`."""

    table: ClassVar[Color]
    floor: ClassVar[Color]
    stick: ClassVar[float]
    pace: ClassVar[float]
    showing: tuple[int, ...]

    def build(self, builder: SceneBuilder) -> None:
        """Build the bodies."""

    def react(self, arm: Arm) -> None:
        """Update the scene after a step."""


class Family(Scene):
    """One episode of a task family.

    Only the demonstration, the solution and the judge receive the answer. Goal and first live
    scene are made without it, so they cannot reveal it.

    Args:
        difficulty: `easy`, `medium` or `hard`.
        rng: Source of everything in the scene but the answer. `RandomState`, because its numbers
            are the same in every version of NumPy.

    Attributes:
        table: Color of the table; `floor` that of the floor.
        stick: Length in m of the stick that the gripper holds; 0 for none.
        pace: Speed of the scripted motion: 1 is 0.25 m/s at the middle of a move.
        goal: The goal.
        steps: Number of steps of the task.
        showing: Numbers of the parts of the answer that the demonstration shows now; set by its
            script.
    """

    table: ClassVar[Color]
    floor: ClassVar[Color] = (0.55, 0.57, 0.60)
    side = SIZE
    stick: ClassVar[float] = 0.0
    pace: ClassVar[float] = 0.6
    goal: str
    steps: int
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

    def pixels(self, marks: Sequence[Point]) -> tuple[Pixel, ...]:
        """Project points of the live scene into the front image, (y, x) in pixels."""
        return to_pixels(marks)

    def own_answer(self, seed: int) -> Any:
        """Return the answer of the episode of a seed."""
        return self.answers[turn_of(seed, len(self.answers))]

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


def row(
    rng: RandomState, count: int, x: float, spacing: float, jitter: float = 0.01, zigzag: float = 0
) -> list[TablePoint]:
    """Return spots in a row across the table, each displaced by up to `jitter`, in m."""
    spots = []
    for number in range(count):
        dx, dy = rng.uniform(-jitter, jitter, 2)
        side = zigzag if number % 2 else -zigzag
        spots.append((x + side + dx, (number - (count - 1) / 2) * spacing + dy))
    return spots


def shuffled(rng: RandomState, count: int) -> list[int]:
    """Return the numbers from 0 to `count` − 1 in random order."""
    return [int(number) for number in rng.permutation(count)]


def along(body: Body, to: Placement, steps: int) -> list[Placement]:
    """Return the placements of a body on a straight path, one per time step."""
    start, way = body.p, np.array(to.p) - body.p
    placements = []
    for step in range(1, steps + 1):
        x, y, z = start + eased(step / steps) * way
        placements.append(Placement((float(x), float(y), float(z)), body.home.yaw))
    return placements


def is_near(body: Body, other: Body, distance: float) -> bool:
    """Whether two bodies are within a distance of each other, seen from above."""
    return math.dist(body.p[:2], other.p[:2]) < distance


def distance_to_segment(point: Vector, one: Vector, other: Vector) -> float:
    """Return the distance of a point from the segment between two points, in m."""
    way = other - one
    part = float(np.clip((point - one) @ way / max(float(way @ way), 1e-12), 0, 1))
    return float(np.linalg.norm(point - one - part * way))


def push_down(button: Body, arm: Arm) -> bool:
    """Move the cap of a button with the closed gripper; return whether it is pressed."""
    x, y, top = button.home.p
    tip = arm.tip
    above = abs(tip[0] - x) < button.size and abs(tip[1] - y) < button.size and arm.opening < 0.01
    z = min(top, max(float(tip[2]), top - 0.015)) if above else top
    button.put(Placement((x, y, z)))
    return z < top - 0.006
