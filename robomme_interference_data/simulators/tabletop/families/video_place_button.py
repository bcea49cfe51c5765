"""VideoPlaceButton: remember where a cube was before, or after, a button was pressed."""

from numpy.random import RandomState

from robomme_interference_data.records import Status
from robomme_interference_data.simulators.tabletop.family import Family
from robomme_interference_data.simulators.tabletop.kit import CUBE, Body, Kit
from robomme_interference_data.simulators.tabletop.motion import Arm, Script
from robomme_interference_data.simulators.tabletop.stage import (
    exchanges,
    is_near,
    push_down,
    row,
    shuffled,
    swap,
)

RADIUS = 0.035  # m, of a target


class PlaceFamily(Family):
    """Cubes, targets that look alike, and a goal to place one cube on the right target.

    When hard, the targets change places after the demonstration, in pairs, until each is elsewhere.
    """

    pace = 1.6
    targets_at = (3, 4, 5)
    colours_at = (1, 2, 3)
    row_of_targets = 0.01  # m, their x
    gap = 0.075  # m, from the targets to the lanes beside them
    bow = 0.0  # m, how far the outer targets lie nearer to the arm
    paint = (0.80, 0.30, 0.55)

    def draw(self, rng: RandomState) -> None:
        count, colours = self.targets_at[self.level], self.colours_at[self.level]
        names = [str(name) for name in rng.permutation(["red", "green", "blue"])]
        self.colours = names[:colours]  # the first one is asked for
        flat = row(rng, count, self.row_of_targets, 0.1)
        self.target_spots = [(x - self.bow * (y / 0.2) ** 2, y) for x, y in flat]
        self.cube_spots = row(rng, colours, -0.18, 0.12)
        self.order = shuffled(rng, count)
        self.swaps = exchanges(rng, count) if self.level == 2 else []
        self.answers = list(range(count))

    def build(self, kit: Kit) -> None:
        self.targets = [kit.target(spot, self.paint, RADIUS) for spot in self.target_spots]
        self.cubes = [kit.cube(s, c) for s, c in zip(self.cube_spots, self.colours, strict=True)]

    def place(self, arm: Arm, cube: Body, target: Body) -> Script:
        """Take a cube from where it is to a target."""
        yield from arm.pick(cube.p)
        x, y, _ = target.p
        yield from arm.put((x, y, CUBE / 2 + 0.004))

    def exchange_targets(self, arm: Arm) -> Script:
        """With the cubes back where they were, let targets change places."""
        yield from arm.go_home()
        for cube in self.cubes:
            cube.restore()
        yield from arm.wait(15)
        for pair in self.swaps:
            yield from swap([[target] for target in self.targets], pair, self.gap)
            yield from arm.wait(5)

    def solve(self, arm: Arm, answer: int) -> Script:
        yield from self.place(arm, self.cubes[0], self.targets[answer])

    def judge(self, arm: Arm, answer: int) -> Status:
        cube = self.cubes[0]
        if cube.p[2] > CUBE or arm.opening < 0.03:
            return Status.ONGOING
        for number, target in enumerate(self.targets):
            if is_near(cube, target, RADIUS):
                return Status.SUCCESS if number == answer else Status.FAIL
        return Status.ONGOING


class VideoPlaceButton(PlaceFamily):
    """The arm places cubes on targets, presses a button, and places them again."""

    table = (0.72, 0.78, 0.70)
    button_at = (-0.20, 0.22)

    def draw(self, rng: RandomState) -> None:
        super().draw(rng)
        self.when = str(rng.choice(["before", "after"]))

    def build(self, kit: Kit) -> None:
        super().build(kit)
        self.button = kit.button(self.button_at)

    def goals(self) -> tuple[str, ...]:
        return (
            f"put the {self.colours[0]} cube on the target where it was right {self.when} the "
            "button was pressed",
        )

    def demonstrate(self, arm: Arm, answer: int) -> Script:
        others = [self.targets[number] for number in self.order if number != answer]
        places = [self.targets[answer], others[0]]
        before, after = places if self.when == "before" else places[::-1]
        starts = [before, *others[1:]]
        yield from arm.wait(15)
        for cube, target in zip(self.cubes, starts, strict=False):
            yield from self.place(arm, cube, target)
        yield from arm.press(self.button.home.p)
        # The second cube moves to the target that the first one has just left; a third one stays.
        for cube, target in zip(self.cubes[:2], [after, before], strict=False):
            yield from self.place(arm, cube, target)
        yield from self.exchange_targets(arm)

    def react(self, arm: Arm) -> None:
        push_down(self.button, arm)
