"""VideoPlaceButton and VideoPlaceOrder: remember on which target a cube was placed when."""

from numpy.random import RandomState

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.family_scenes import PlaceScene
from robomme_interference_data.simulators.scene import Option
from robomme_interference_data.simulators.tabletop.bodies import CUBE, SceneBuilder
from robomme_interference_data.simulators.tabletop.family import (
    Step,
    is_near,
    push_down,
    row,
    shuffled,
)
from robomme_interference_data.simulators.tabletop.motion import HELD, Arm, Point, Script
from robomme_interference_data.simulators.tabletop.swaps import SwapFamily

# Time steps of the phases of a demonstration, enough for every cube and target.
REACH, CARRY, PRESS, RETURN = 21, 17, 42, 28
RADIUS = 0.035  # m, of a target
WHEN = ("before", "after")
ORDINALS = ("first", "second", "third")


class PlaceFamily(PlaceScene, SwapFamily):
    """Cubes, identical targets, and a goal to place one cube on the right target.

    In hard episodes all targets swap places after the demonstration.
    """

    steps = 2
    pace = 1.6
    targets_at = (3, 4, 5)
    colors_at = (1, 2, 3)
    row_of_targets = 0.01  # m, their x
    gap = 0.075
    bow = 0.0  # m, how much nearer to the arm the outer targets are
    paint = (0.80, 0.30, 0.55)

    def draw(self, rng: RandomState) -> None:
        self.count = self.targets_at[self.level]
        colors = self.colors_at[self.level]
        names = [str(name) for name in rng.permutation(["red", "green", "blue"])]
        self.colors = names[:colors]  # the goal asks for the first one
        self.cube = f"the {self.colors[0]} cube"
        flat = row(rng, self.count, self.row_of_targets, 0.1)
        self.target_spots = [(x - self.bow * (y / 0.2) ** 2, y) for x, y in flat]
        self.cube_spots = row(rng, colors, -0.18, 0.12)
        self.order = shuffled(rng, self.count)
        if self.level == 2:
            self.draw_swaps(rng)
        self.answers = list(range(self.count))
        self.held = False

    def build(self, builder: SceneBuilder) -> None:
        self.targets = [builder.target(spot, self.paint, RADIUS) for spot in self.target_spots]
        cubes = zip(self.cube_spots, self.colors, strict=True)
        self.cubes = [builder.cube(spot, color) for spot, color in cubes]

    def option(self, choice: int) -> Option:
        return Option("", ((*self.target_spots[choice], 0.0),))

    def reach(self, arm: Arm, cube: int) -> Script:
        """Move above a cube."""
        yield from arm.lasting(REACH, arm.go_above(self.cubes[cube].p))

    def place(self, arm: Arm, cube: int, target: int, parts: tuple[int, ...] = ()) -> Script:
        """Move the cube below to a target, which shows parts of the answer, or no new ones."""
        yield from arm.pick(self.cubes[cube].p)
        at = self.above(target)
        if parts:  # the way there shows from where, too
            self.showing = tuple(range(max(parts[-1] - 1, 0), parts[-1] + 1))
        yield from arm.lasting(CARRY, arm.carry(at))
        self.showing = parts or self.showing
        yield from arm.put(at)

    def put(self, arm: Arm, target: int) -> Script:
        """Put the held cube on a target."""
        yield from arm.put(self.above(target))

    def above(self, target: int) -> Point:
        """Return where a cube is released on a target."""
        x, y, _ = self.targets[target].p
        return x, y, CUBE / 2 + 0.004

    def swap_targets(self, arm: Arm) -> Script:
        """Return the cubes to their first positions, then swap the targets."""
        yield from arm.lasting(RETURN, arm.go_home())
        for cube in self.cubes:
            cube.restore()
        self.showing = ()
        yield from arm.wait(15)
        yield from self.swap(arm, [[target] for target in self.targets], len(self.times))

    def step(self, answer: int, number: int) -> Step:
        if number == 0:
            text, at = f"pick up {self.cube} at <point>", self.cubes[0].p
            return Step(text, (at,), lambda arm: arm.pick(self.cubes[0].p))
        text = "put it on the target at <point>"
        return Step(text, (self.targets[answer].p,), lambda arm: self.put(arm, answer))

    def progress(self) -> int:
        return int(self.held)

    def judge(self, arm: Arm, answer: int) -> Status:
        cube = self.cubes[0]
        self.held = cube.p[2] > CUBE or (self.held and arm.opening < HELD)
        if cube.p[2] > CUBE or arm.opening < HELD:
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
        self.goal = (
            f"put {self.cube} on the target where it was right {WHEN[self.asked]} "
            "the button was pressed"
        )

    def build(self, builder: SceneBuilder) -> None:
        super().build(builder)
        self.button = builder.button(self.button_at)

    def visits(self, answer: int) -> tuple[int, ...]:
        other = next(number for number in self.order if number != answer)
        return (answer, other) if self.asked == 0 else (other, answer)

    def demonstrate(self, arm: Arm, answer: int) -> Script:
        before, after = self.visits(answer)
        others = [number for number in self.order if number not in (before, after)]
        yield from arm.wait(15)
        for cube, number in enumerate([before, *others][: len(self.cubes)]):
            yield from self.reach(arm, cube)
            yield from self.place(arm, cube, number, () if cube else (0,))
        yield from arm.lasting(PRESS, arm.press(self.button.home.p))
        yield from self.reach(arm, 0)
        alone = len(self.cubes) == 1
        yield from self.place(arm, 0, after, (1,) if alone else (0, 1))
        if not alone:  # the second cube moves to the target that the first one left
            yield from self.reach(arm, 1)
            yield from self.place(arm, 1, before)
        yield from self.swap_targets(arm)

    def react(self, arm: Arm) -> None:
        push_down(self.button, arm)


class VideoPlaceOrder(PlaceFamily):
    """The arm places a cube on three targets in sequence."""

    table = (0.30, 0.36, 0.52)
    paint = (0.95, 0.72, 0.15)
    colors_at = (1, 2, 2)
    times = ORDINALS
    row_of_targets = 0.03
    bow = 0.04

    def draw(self, rng: RandomState) -> None:
        super().draw(rng)
        self.asked = int(rng.randint(3))
        self.second = shuffled(rng, self.count)
        self.goal = f"put {self.cube} on the {ORDINALS[self.asked]} target it was placed on"

    def build(self, builder: SceneBuilder) -> None:
        super().build(builder)
        builder.panel((-0.18, 0), (0.045, 0.15), (0.20, 0.24, 0.36))

    def visits(self, answer: int) -> tuple[int, ...]:
        visits = [number for number in self.order if number != answer]
        visits.insert(self.asked, answer)
        return tuple(visits[:3])

    def demonstrate(self, arm: Arm, answer: int) -> Script:
        first = self.visits(answer)
        # A second cube visits other targets, clear of where the first one stays; the first one's
        # earlier targets have no influence.
        second = [number for number in self.second if number != first[-1]][:3]
        yield from arm.wait(10)
        for cube, visits in zip(range(len(self.cubes)), (first, second), strict=False):
            yield from self.reach(arm, cube)
            for part, number in enumerate(visits):
                yield from self.place(arm, cube, number, () if cube else (part,))
        yield from self.swap_targets(arm)
