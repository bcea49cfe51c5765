"""VideoPlaceButton: remember where a cube was before, or after, a button was pressed."""

from abc import abstractmethod
from collections.abc import Iterable
from itertools import permutations
from typing import ClassVar

from numpy.random import RandomState

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.tabletop.family import Option, Step
from robomme_interference_data.simulators.tabletop.kit import CUBE, Kit
from robomme_interference_data.simulators.tabletop.motion import Arm, Script
from robomme_interference_data.simulators.tabletop.stage import (
    is_near,
    push_down,
    row,
    shuffled,
)
from robomme_interference_data.simulators.tabletop.swaps import SwapFamily

RADIUS = 0.035  # m, of a target
OPEN = 0.03  # m, way of a finger that holds nothing
WHEN = ("before", "after")


class PlaceFamily(SwapFamily):
    """Cubes, targets that look alike, and a goal to place one cube on the right target.

    When hard, the targets change places after the demonstration, in pairs, until each is elsewhere.

    Attributes:
        asked: Which of the targets that the cube comes to is asked for, from 0.
    """

    asked: int
    times: ClassVar[tuple[str, ...]]
    """When the cube comes to each target, in words."""

    pace = 1.6
    targets_at = (3, 4, 5)
    colours_at = (1, 2, 3)
    row_of_targets = 0.01  # m, their x
    gap = 0.075
    bow = 0.0  # m, how far the outer targets lie nearer to the arm
    paint = (0.80, 0.30, 0.55)

    def draw(self, rng: RandomState) -> None:
        self.count = count = self.targets_at[self.level]
        colours = self.colours_at[self.level]
        names = [str(name) for name in rng.permutation(["red", "green", "blue"])]
        self.colours = names[:colours]  # the first one is asked for
        flat = row(rng, count, self.row_of_targets, 0.1)
        self.target_spots = [(x - self.bow * (y / 0.2) ** 2, y) for x, y in flat]
        self.cube_spots = row(rng, colours, -0.18, 0.12)
        self.order = shuffled(rng, count)
        if self.level == 2:
            self.draw_swaps(rng)
        self.answers = list(range(count))
        self.held = False

    def build(self, kit: Kit) -> None:
        self.targets = [kit.target(spot, self.paint, RADIUS) for spot in self.target_spots]
        self.cubes = [kit.cube(s, c) for s, c in zip(self.cube_spots, self.colours, strict=True)]

    @abstractmethod
    def way(self, answer: int) -> tuple[int, ...]:
        """The targets that the asked cube comes to, one after the other."""

    def words(self, way: Iterable[int]) -> tuple[str, ...]:
        """Such a way in words, target by target."""
        steps = zip(way, self.times, strict=True)
        return tuple(f"puts the {self.colours[0]} cube on target {n} {time}" for n, time in steps)

    def told(self, answer: int) -> tuple[str, ...]:
        return self.words(self.way(answer))

    def question(self) -> str:
        return "Which of the marked targets does the goal mean?"

    def option(self, choice: int) -> Option:
        return Option("", ((*self.target_spots[choice], 0.0),))

    def lessons(self) -> Iterable[tuple[int, tuple[str, ...]]]:
        ways = permutations(range(self.count), len(self.times))
        return ((way[self.asked], self.words(way)) for way in ways)

    def place(self, arm: Arm, cube: int, target: int, part: int = 0) -> Script:
        """Take a cube from where it is to a target; there the asked one is a part of its way."""
        yield from arm.pick(self.cubes[cube].p)
        if cube == 0:
            self.showing = (part,)
        yield from self.put(arm, target)

    def put(self, arm: Arm, target: int) -> Script:
        """Put the cube that is held on a target."""
        x, y, _ = self.targets[target].p
        yield from arm.put((x, y, CUBE / 2 + 0.004))

    def exchange_targets(self, arm: Arm) -> Script:
        """With the cubes back where they were, let targets change places."""
        yield from arm.go_home()
        for cube in self.cubes:
            cube.restore()
        self.showing = ()
        yield from arm.wait(15)
        yield from self.swap(arm, [[target] for target in self.targets], len(self.times))

    def steps(self) -> int:
        return 2

    def step(self, answer: int, number: int) -> Step:
        if number == 0:
            text, at = f"pick up the {self.colours[0]} cube at <point>", self.cubes[0].p
            return Step(text, (at,), lambda arm: arm.pick(self.cubes[0].p))
        text = "put it on the target at <point>"
        return Step(text, (self.targets[answer].p,), lambda arm: self.put(arm, answer))

    def progress(self) -> int:
        return int(self.held)

    def judge(self, arm: Arm, answer: int) -> Status:
        cube = self.cubes[0]
        self.held = cube.p[2] > CUBE or (self.held and arm.opening < OPEN)
        if cube.p[2] > CUBE or arm.opening < OPEN:
            return Status.ONGOING
        for number, target in enumerate(self.targets):
            if is_near(cube, target, RADIUS):
                return Status.SUCCESS if number == answer else Status.FAIL
        return Status.ONGOING


class VideoPlaceButton(PlaceFamily):
    """The arm places cubes on targets, presses a button, and places them again."""

    table = (0.72, 0.78, 0.70)
    button_at = (-0.20, 0.22)
    times = ("before the button is pressed", "after the button is pressed")

    def draw(self, rng: RandomState) -> None:
        super().draw(rng)
        self.asked = WHEN.index(str(rng.choice(WHEN)))

    def build(self, kit: Kit) -> None:
        super().build(kit)
        self.button = kit.button(self.button_at)

    def goals(self) -> tuple[str, ...]:
        cube, when = self.colours[0], WHEN[self.asked]
        return (
            f"put the {cube} cube on the target where it was right {when} the button was pressed",
        )

    def way(self, answer: int) -> tuple[int, ...]:
        other = next(number for number in self.order if number != answer)
        return (answer, other) if self.asked == 0 else (other, answer)

    def demonstrate(self, arm: Arm, answer: int) -> Script:
        before, after = self.way(answer)
        others = [number for number in self.order if number not in (before, after)]
        yield from arm.wait(15)
        for cube, number in enumerate([before, *others][: len(self.cubes)]):
            yield from self.place(arm, cube, number, 0)
        yield from arm.press(self.button.home.p)
        # The second cube moves to the target that the first one has just left; a third one stays.
        for cube, number in enumerate([after, before][: len(self.cubes)]):
            yield from self.place(arm, cube, number, 1)
        yield from self.exchange_targets(arm)

    def react(self, arm: Arm) -> None:
        push_down(self.button, arm)
