"""VideoRepick: remember which of several cubes was picked."""

from numpy.random import RandomState

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.family_scenes import RepickScene
from robomme_interference_data.simulators.scene import Option
from robomme_interference_data.simulators.tabletop.bodies import CUBE, SceneBuilder
from robomme_interference_data.simulators.tabletop.family import Step, push_down, row
from robomme_interference_data.simulators.tabletop.motion import HELD, Arm, Script
from robomme_interference_data.simulators.tabletop.swaps import SwapFamily

PICK, RETURN = 98, 44  # time steps of these phases of a demonstration, enough for every cube
LIFTED = 0.06  # m, height of the cube's middle
TIMES = ("once", "twice, putting it down in between", "three times, putting it down in between")


class VideoRepick(RepickScene, SwapFamily):
    """The arm picks one of several cubes; the task is to pick it n times, then press the button.

    Easy: three cubes of different colors. Medium: five of the same color. Hard: all five swap
    places after the demonstration.
    """

    table = (0.26, 0.30, 0.34)
    cubes_at = (3, 5, 5)
    gap = 0.055
    button_at = (0.06, 0.0)

    def draw(self, rng: RandomState) -> None:
        self.count = count = self.cubes_at[self.level]
        self.spots = row(rng, count, -0.10, 0.09, zigzag=0.025)
        names = [str(name) for name in rng.permutation(["red", "green", "blue", "yellow"])]
        self.colors = names[:count] if self.level == 0 else [names[0]] * count
        self.times = int(rng.randint(1, 4))
        self.steps = 2 * self.times + 1
        times = TIMES[self.times - 1]
        self.goal = f"pick up the same cube as in the video, {times}, then press the button"
        if self.level == 2:
            self.draw_swaps(rng)
        self.answers = list(range(count))
        self.lifts, self.raised, self.held = 0, False, False

    def build(self, builder: SceneBuilder) -> None:
        self.cubes = [builder.cube(s, c) for s, c in zip(self.spots, self.colors, strict=True)]
        self.button = builder.button(self.button_at)

    def option(self, choice: int) -> Option:
        return Option("", ((*self.spots[choice], CUBE / 2),))

    def demonstrate(self, arm: Arm, answer: int) -> Script:
        yield from arm.wait(5)
        self.showing = (0,)
        yield from arm.lasting(PICK, self.pick_up(arm, answer))
        yield from self.put_down(arm)
        yield from self.go_home(arm, RETURN)
        for cube in self.cubes:
            cube.restore()
            cube.hold(True)
        yield from self.swap(arm, [[cube] for cube in self.cubes], 1)

    def pick_up(self, arm: Arm, number: int) -> Script:
        self.taken = self.cubes[number].p
        yield from arm.pick(self.taken)
        yield from arm.wait(5)

    def put_down(self, arm: Arm) -> Script:
        yield from arm.put((self.taken[0], self.taken[1], CUBE / 2 + 0.002))

    def react(self, arm: Arm) -> None:
        self.pressed = push_down(self.button, arm)

    def step(self, answer: int, number: int) -> Step:
        cube = self.cubes[answer]
        if number == self.steps - 1:
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
        self.held = self.raised or (self.held and arm.opening < HELD)
        if self.lifts > self.times:
            return Status.FAIL
        if self.pressed:
            return Status.SUCCESS if self.lifts == self.times else Status.FAIL
        return Status.ONGOING
