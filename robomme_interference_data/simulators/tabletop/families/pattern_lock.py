"""PatternLock: remember a path over a grid of buttons."""

import math
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.random import RandomState

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.tabletop.family import Family, Option, Step
from robomme_interference_data.simulators.tabletop.kit import Body, Kit
from robomme_interference_data.simulators.tabletop.motion import Arm, Script
from robomme_interference_data.simulators.tabletop.stage import ABOVE, Spot

SIDE, SPACING, RADIUS = 4, 0.075, 0.02  # buttons in a row; m; m
TALL, HIGH = 0.010, 0.10  # m, a button, and the stick's tip above the buttons

TOUCH = 0.004  # m above a thing, below which the stick's tip touches it


class StickFamily(Family):
    """Flat things, of which one is lit while the tip of a stick on the arm is on it.

    Attributes:
        spots: Where they are.
        flat: Their radius and height, in m.
        lamp: What lights one.
        now: Which one is lit, or None.
    """

    spots: list[Spot]
    flat: ClassVar[Spot]
    lamp: Body
    now: int | None

    def demonstrate(self, arm: Arm, answer: Any) -> Script:
        yield from arm.wait(10)
        yield from self.solve(arm, answer)
        yield from arm.go_home()

    def react(self, arm: Arm) -> None:
        radius, height = self.flat
        x, y, z = arm.tip
        near = (n for n, spot in enumerate(self.spots) if math.dist((x, y), spot) < radius)
        self.now = next(near, None) if z < height + TOUCH else None
        Kit.light(self.lamp, None if self.now is None else self.spots[self.now])


class PatternLock(StickFamily):
    """A stick on the arm traces a path over a grid of buttons; retrace it.

    An answer is the path: numbers of buttons, each beside the one before it, straight or diagonal.
    """

    table = (0.16, 0.34, 0.34)
    stick = 0.10
    flat = (RADIUS, TALL)
    length = (4, 5, 6)

    def draw(self, rng: RandomState) -> None:
        x, y = np.array([-0.08, 0.0]) + rng.uniform(-0.02, 0.02, 2)
        half = (SIDE - 1) / 2
        self.middle = (x, y)
        self.spots = [
            (x + (row - half) * SPACING, y + (column - half) * SPACING)
            for row in range(SIDE)
            for column in range(SIDE)
        ]
        self.answers = paths(self.length[self.level])
        self.done, self.last = 0, -1

    def build(self, kit: Kit) -> None:
        kit.panel(self.middle, (0.16, 0.16), (0.08, 0.14, 0.15))
        self.buttons = [kit.post(spot, (0.85, 0.85, 0.80), RADIUS, TALL) for spot in self.spots]
        self.lamp = kit.lamp((1.0, 0.55, 0.10), RADIUS, TALL + ABOVE / 2)

    def goals(self) -> tuple[str, ...]:
        return ("retrace the pattern with the stick, button by button in the same order",)

    def told(self, answer: tuple[int, ...]) -> tuple[str, ...]:
        return tuple(f"goes to button {number}" for number in answer)

    def question(self) -> str:
        return "Which path did the stick take over the buttons? Each picture shows one."

    def option(self, choice: tuple[int, ...]) -> Option:
        return Option("", tuple((*self.spots[number], TALL) for number in choice))

    def steps(self) -> int:
        return self.length[self.level]

    def step(self, answer: tuple[int, ...], number: int) -> Step:
        at = (*self.spots[answer[number]], TALL)
        return Step(
            "go to the button at <point>", (at,), lambda arm: self.touch(arm, answer, number)
        )

    def progress(self) -> int:
        return self.done

    def touch(self, arm: Arm, answer: tuple[int, ...], number: int) -> Script:
        spot = self.spots[answer[number]]
        if number == 0:
            yield from arm.move((*spot, HIGH))
        self.showing = (number,)
        yield from arm.move((*spot, TALL + ABOVE), speed=0.15)
        yield from arm.wait(8)
        if number == self.steps() - 1:
            self.showing = ()
            yield from arm.move((*spot, HIGH))

    def judge(self, arm: Arm, answer: tuple[int, ...]) -> Status:
        if self.now is not None and self.now != self.last:
            if self.now != answer[self.done]:
                return Status.FAIL
            self.done, self.last = self.done + 1, self.now
        return Status.SUCCESS if self.done == len(answer) else Status.ONGOING


@cache
def paths(length: int) -> list[tuple[int, ...]]:
    """All paths of `length` different buttons, each beside the one before it."""
    found: list[tuple[int, ...]] = [(start,) for start in range(SIDE * SIDE)]
    for _ in range(length - 1):
        found = [
            (*path, to)
            for path in found
            for to in range(SIDE * SIDE)
            if to not in path and math.dist(divmod(to, SIDE), divmod(path[-1], SIDE)) < 1.5
        ]
    return found
