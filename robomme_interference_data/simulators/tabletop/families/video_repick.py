"""VideoRepick: remember which of several cubes was picked."""

from numpy.random import RandomState

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.tabletop.family import Option, Step
from robomme_interference_data.simulators.tabletop.kit import CUBE, Kit
from robomme_interference_data.simulators.tabletop.motion import Arm, Script
from robomme_interference_data.simulators.tabletop.stage import push_down, row
from robomme_interference_data.simulators.tabletop.swaps import SwapFamily

LIFTED = 0.06  # m, height of the cube's middle
OPEN = 0.03  # m, way of a finger that holds nothing
TIMES = ("once", "twice, putting it down in between", "three times, putting it down in between")


class VideoRepick(SwapFamily):
    """The arm picks one of several cubes; pick the same one again, n times, then press the button.

    Easy: three cubes, each of its own colour. Medium: five of the same colour. Hard: they change
    places after the demonstration, in pairs, until each lies elsewhere.
    """

    table = (0.26, 0.30, 0.34)
    cubes_at = (3, 5, 5)
    gap = 0.055
    button_at = (0.06, 0.0)

    def draw(self, rng: RandomState) -> None:
        self.count = count = self.cubes_at[self.level]
        self.spots = row(rng, count, -0.10, 0.09, zigzag=0.025)
        names = [str(name) for name in rng.permutation(["red", "green", "blue", "yellow"])]
        self.colours = names[:count] if self.level == 0 else [names[0]] * count
        self.times = int(rng.randint(1, 4))
        if self.level == 2:
            self.draw_swaps(rng)
        self.answers = list(range(count))
        self.lifts, self.raised, self.held = 0, False, False

    def build(self, kit: Kit) -> None:
        self.cubes = [kit.cube(s, c) for s, c in zip(self.spots, self.colours, strict=True)]
        self.button = kit.button(self.button_at)

    def goals(self) -> tuple[str, ...]:
        times = TIMES[self.times - 1]
        return (f"pick up the same cube as in the video, {times}, then press the button",)

    def told(self, answer: int) -> tuple[str, ...]:
        return (f"lifts cube {answer}",)

    def question(self) -> str:
        return "Which of the marked cubes was picked up?"

    def option(self, choice: int) -> Option:
        return Option("", ((*self.spots[choice], CUBE / 2),))

    def demonstrate(self, arm: Arm, answer: int) -> Script:
        yield from arm.wait(5)
        yield from self.lift(arm, answer)
        yield from arm.go_home()
        for cube in self.cubes:
            cube.restore()
            cube.hold(True)
        yield from self.swap(arm, [[cube] for cube in self.cubes], 1)

    def lift(self, arm: Arm, number: int) -> Script:
        """Pick a cube up and put it down where it was."""
        yield from self.pick_up(arm, number)
        yield from self.put_down(arm)

    def pick_up(self, arm: Arm, number: int) -> Script:
        self.taken = self.cubes[number].p
        yield from arm.go_above(self.taken)
        self.showing = (0,)
        yield from arm.take(self.taken)
        yield from arm.wait(5)

    def put_down(self, arm: Arm) -> Script:
        yield from arm.put((self.taken[0], self.taken[1], CUBE / 2 + 0.002))
        self.showing = ()

    def react(self, arm: Arm) -> None:
        self.pressed = push_down(self.button, arm)

    def steps(self) -> int:
        return 2 * self.times + 1

    def step(self, answer: int, number: int) -> Step:
        cube = self.cubes[answer]
        if number == self.steps() - 1:
            top = self.button.home.p
            return Step("press the button at <point>", (top,), lambda arm: arm.press(top))
        if number % 2:
            return Step("put it down at <point>", (cube.home.p,), self.put_down)
        return Step("pick up the cube at <point>", (cube.p,), lambda arm: self.pick_up(arm, answer))

    def progress(self) -> int:
        return 2 * self.lifts - self.held

    def judge(self, arm: Arm, answer: int) -> Status:
        heights = [cube.p[2] for cube in self.cubes]
        if any(z > LIFTED for number, z in enumerate(heights) if number != answer):
            return Status.FAIL
        if heights[answer] > LIFTED and not self.raised:
            self.lifts, self.raised = self.lifts + 1, True
        elif heights[answer] < CUBE:
            self.raised = False
        self.held = self.raised or (self.held and arm.opening < OPEN)
        if self.lifts > self.times:
            return Status.FAIL
        if self.pressed:
            return Status.SUCCESS if self.lifts == self.times else Status.FAIL
        return Status.ONGOING
