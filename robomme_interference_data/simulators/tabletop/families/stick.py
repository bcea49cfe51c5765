"""PatternLock and RouteStick: remember the path of a stick over buttons, or around posts."""

import math
from functools import cache
from itertools import islice, pairwise, product
from typing import Any, ClassVar

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.family_scenes import grid_paths, row_paths
from robomme_interference_data.simulators.scene import Option
from robomme_interference_data.simulators.tabletop.bodies import Body, SceneBuilder
from robomme_interference_data.simulators.tabletop.family import (
    ABOVE,
    Family,
    Step,
    TablePoint,
    distance_to_segment,
)
from robomme_interference_data.simulators.tabletop.motion import ROD, Arm, Point, Script

SpotPath = tuple[int, ...]
"""Numbers of the spots that the stick visits, in order."""

TurnedPath = tuple[SpotPath, tuple[int, ...]]
"""A path, and the direction in which each move passes the post: 1 or -1."""

TOUCH = 0.004  # m above a surface: a tip below that touches it
FAST = 0.15  # m/s


class StickFamily(Family):
    """Flat things, each lit while the tip of the arm's stick is on it.

    Attributes:
        spots: Positions of the things, in m.
        flat: Their radius and height, in m.
        high: Height of the tip before the path, in m.
        shows_start: Whether the way to a thing shows the part of the one before.
        pause: Time steps for which the tip stays on a thing.
        frames: Time steps of the ways of a demonstration: to the first thing, to each later one,
            and back home.
        lamp: Body that lights one.
        now: Number of the one that is lit, or None.
    """

    flat: ClassVar[TablePoint]
    high: ClassVar[float]
    shows_start: ClassVar[bool]
    pause: ClassVar[int]
    frames: ClassVar[tuple[int, int, int]]
    spots: list[TablePoint]
    lamp: Body
    now: int | None

    def demonstrate(self, arm: Arm, answer: Any) -> Script:
        yield from arm.wait(10)
        first, later, home = self.frames
        for number in range(self.steps):
            way = later if number else first
            step = arm.lasting(way + self.pause, self.step(answer, number).do(arm))
            self.showing = (number - 1, number) if number and self.shows_start else (number,)
            yield from islice(step, way)
            self.showing = (number,)
            yield from step
        yield from self.go_home(arm, home)

    def trace(self, arm: Arm, number: int, points: list[Point]) -> Script:
        """Do a step: lower the tip for the first, then move through points."""
        if number == 0:
            x, y, _ = points[-1]
            yield from arm.move((x, y, self.high))
        for point in points:
            yield from arm.move(point, speed=FAST)
        yield from arm.wait(self.pause)

    def react(self, arm: Arm) -> None:
        radius, height = self.flat
        x, y, z = arm.tip
        near = (n for n, spot in enumerate(self.spots) if math.dist((x, y), spot) < radius)
        self.now = next(near, None) if z < height + TOUCH else None
        SceneBuilder.light(self.lamp, None if self.now is None else self.spots[self.now])


class PatternLock(StickFamily):
    """The stick traces a path over a grid of buttons.

    An answer is the path: numbers of buttons, each adjacent to the one before it, straight or
    diagonally.
    """

    goal = "retrace the pattern with the stick, button by button in the same order"
    question = "Which path did the stick take over the buttons? Each picture shows one."
    table = (0.16, 0.34, 0.34)
    stick = 0.10
    side_buttons, spacing = 4, 0.075  # buttons in a row; m
    flat = (0.02, 0.010)
    high = 0.10
    shows_start = True
    pause = 8
    frames = (57, 18, 60)
    length = (4, 5, 6)

    def draw(self, rng: RandomState) -> None:
        x, y = np.array([-0.08, 0.0]) + rng.uniform(-0.02, 0.02, 2)
        half = (self.side_buttons - 1) / 2
        self.middle = (x, y)
        self.spots = [
            (x + (row - half) * self.spacing, y + (column - half) * self.spacing)
            for row, column in product(range(self.side_buttons), repeat=2)
        ]
        self.steps = self.length[self.level]
        self.answers = grid_paths(self.side_buttons, range(self.side_buttons**2), self.steps)
        self.done, self.last = 0, -1

    def build(self, builder: SceneBuilder) -> None:
        builder.panel(self.middle, (0.16, 0.16), (0.08, 0.14, 0.15))
        radius, height = self.flat
        for spot in self.spots:
            builder.post(spot, (0.85, 0.85, 0.80), radius, height)
        self.lamp = builder.lamp((1.0, 0.55, 0.10), radius, height + ABOVE / 2)

    def answer_texts(self, answer: SpotPath) -> tuple[str, ...]:
        return tuple(f"goes to button {number}" for number in answer)

    def option(self, choice: SpotPath) -> Option:
        return Option("", tuple((*self.spots[number], self.flat[1]) for number in choice))

    def step(self, answer: SpotPath, number: int) -> Step:
        x, y = self.spots[answer[number]]
        height = self.flat[1]
        points: list[Point] = [(x, y, height + ABOVE)]
        script = lambda arm: self.trace(arm, number, points)  # noqa: E731
        return Step("go to the button at <point>", ((x, y, height),), script)

    def progress(self) -> int:
        return self.done

    def judge(self, arm: Arm, answer: SpotPath) -> Status:
        if self.now is not None and self.now != self.last:
            if self.now != answer[self.done]:
                return Status.FAIL
            self.done, self.last = self.done + 1, self.now
        return Status.SUCCESS if self.done == len(answer) else Status.ONGOING


class RouteStick(StickFamily):
    """The stick moves from target to target, passing each post between them on one of two sides.

    An answer is the targets' numbers, and the side of each passed post: 1 away from the arm, −1
    towards it.
    """

    goal = "follow the same path round the posts with the stick as in the video"
    question = "Which path did the stick take round the posts? Each picture shows one."
    table = (0.48, 0.30, 0.30)
    stick = 0.12
    count, spacing = 5, 0.105  # targets; m from one to the next, with a post in the middle
    flat = (0.024, 0.003)
    high = 0.13
    shows_start = False  # but not on which side of a post it came there
    pause = 3
    frames = (59, 28, 57)
    post, tall = 0.010, 0.07  # m, radius and height of a post
    aside = 0.06  # m, distance at which the stick passes a post
    sides: ClassVar = {1: "far", -1: "near"}  # as seen from the arm
    turns = (2, 3, 4)

    def draw(self, rng: RandomState) -> None:
        x, y = np.array([-0.08, 0.0]) + rng.uniform(-0.02, 0.02, 2)
        count, spacing = self.count, self.spacing
        self.spots = [(x, y + (n - (count - 1) / 2) * spacing) for n in range(count)]
        self.posts = [(x, y + (n - (count - 2) / 2) * spacing) for n in range(count - 1)]
        self.steps = self.turns[self.level] + 1
        self.answers = routes(count, self.turns[self.level])
        self.reached: list[int] = []
        self.passed: list[int] = []
        self.before: NDArray[np.float64] | None = None

    def build(self, builder: SceneBuilder) -> None:
        radius, height = self.flat
        for spot in self.spots:
            builder.target(spot, (0.95, 0.92, 0.85), radius)
        for spot in self.posts:
            builder.post(spot, (0.12, 0.12, 0.14), self.post, self.tall)
        self.lamp = builder.lamp((0.35, 0.90, 0.45), radius, height + ABOVE / 2)

    def answer_texts(self, answer: TurnedPath) -> tuple[str, ...]:
        targets, sides = answer
        turns = zip(pairwise(targets), sides, strict=True)
        return (
            f"starts on target {targets[0]}",
            *(
                f"goes round post {min(pair)} on the {self.sides[side]} side to target {pair[1]}"
                for pair, side in turns
            ),
        )

    def option(self, choice: TurnedPath) -> Option:
        return Option("", tuple(p for n in range(self.steps) for p in self.leg(choice, n, 0.0)))

    def leg(self, answer: TurnedPath, number: int, above: float) -> list[Point]:
        """Return the points of a step, some m above the targets: beside the post, on the target."""
        targets, sides = answer
        z = self.flat[1] + above
        end: Point = (*self.spots[targets[number]], z)
        if number == 0:
            return [end]
        x, y = self.posts[min(targets[number - 1 : number + 1])]
        return [(x + sides[number - 1] * self.aside, y, z), end]

    def step(self, answer: TurnedPath, number: int) -> Step:
        targets, sides = answer
        text = "go to the target at <point>"
        at: tuple[Point, ...] = ((*self.spots[targets[number]], self.flat[1]),)
        if number:
            post = (*self.posts[min(targets[number - 1 : number + 1])], self.tall / 2)
            side = self.sides[sides[number - 1]]
            text = f"go round the post at <point> on the {side} side to the target at <point>"
            at = (post, *at)
        points = self.leg(answer, number, ABOVE)
        return Step(text, at, lambda arm: self.trace(arm, number, points))

    def progress(self) -> int:
        return len(self.reached)

    def judge(self, arm: Arm, answer: TurnedPath) -> Status:
        targets, sides = answer
        if self.follow(arm):
            return Status.FAIL
        if self.now is not None and (not self.reached or self.now != self.reached[-1]):
            self.reached.append(self.now)
            if len(self.passed) != len(self.reached) - 1:
                return Status.FAIL  # moved over the posts, or around another one
        if tuple(self.reached) != targets[: len(self.reached)]:
            return Status.FAIL
        if tuple(self.passed) != sides[: len(self.passed)]:
            return Status.FAIL
        return Status.SUCCESS if len(self.reached) == len(targets) else Status.ONGOING

    def follow(self, arm: Arm) -> bool:
        """Record the side on which the tip passed a post now; return whether it hit one."""
        tip = arm.tip
        before = tip if self.before is None else self.before
        self.before = tip
        if tip[2] > self.tall:
            return False
        for post in self.posts:
            if distance_to_segment(np.array(post), before[:2], tip[:2]) < self.post + ROD:
                return True
            x, y = post
            if self.reached and (before[1] - y) * (tip[1] - y) < 0:
                part = (y - before[1]) / (tip[1] - before[1])
                off = before[0] + part * (tip[0] - before[0]) - x
                self.passed.append(1 if off > 0 else -1)
        return False


@cache
def routes(count: int, turns: int) -> list[TurnedPath]:
    """Return all routes with a number of turns: targets, and the sides of the passed posts."""
    walks = row_paths(count, range(count), turns)
    return list(product(walks, product((1, -1), repeat=turns)))
