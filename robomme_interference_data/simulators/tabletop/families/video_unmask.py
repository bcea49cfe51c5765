"""VideoUnmask and VideoUnmaskSwap: remember which container hides a cube."""

from collections.abc import Sequence
from itertools import chain, islice, product

from numpy.random import RandomState

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.family_scenes import UnmaskScene
from robomme_interference_data.simulators.scene import Option
from robomme_interference_data.simulators.tabletop.bodies import (
    CUBE,
    SIDE,
    Body,
    Placement,
    SceneBuilder,
)
from robomme_interference_data.simulators.tabletop.family import Family, Step, along, row, shuffled
from robomme_interference_data.simulators.tabletop.motion import HELD, Arm, Script
from robomme_interference_data.simulators.tabletop.swaps import SwapFamily

HIGH = 0.72  # m, above the cameras' view
FALL, SEEN = 55, 49  # time steps in which the containers descend, and until they hide the cubes
LIFTED = 0.05  # m, of the right container
PEEKED = 0.010  # m, of a wrong one: its cube becomes visible at 0.02


class VideoUnmask(UnmaskScene, Family):
    """Opaque containers descend over cubes; the task is to lift the right one."""

    table = (0.60, 0.44, 0.28)
    pace = 0.4
    shell = (0.30, 0.34, 0.42)
    containers = (3, 4, 5)

    def draw(self, rng: RandomState) -> None:
        count = self.containers[self.level]
        colors = [str(color) for color in rng.permutation(["red", "green", "blue"])]
        self.hide(count, colors[: 2 if self.level == 2 else 1])
        hiding = (f"pick up the container that hides the {color} cube" for color in self.asked)
        self.goal = ", put it down, then ".join(hiding)
        self.steps = 2 * len(self.asked)
        self.colors = colors
        self.spots = row(rng, count, -0.04, 0.105, zigzag=0.02)
        self.order = shuffled(rng, count)
        self.found, self.held = 0, False

    def build(self, builder: SceneBuilder) -> None:
        self.shells = [builder.container(spot, self.shell) for spot in self.spots]
        cubes = zip(self.spots, self.colors, strict=False)
        self.cubes = [builder.cube(spot, color) for spot, color in cubes]

    def covered(self, answer: Sequence[int]) -> list[int]:
        """Return the containers that hide a cube, in the order of `colors`."""
        rest = [number for number in self.order if number not in answer]
        return [*answer, *rest][: len(self.colors)]

    def option(self, choice: int) -> Option:
        return Option("", ((*self.spots[choice], SIDE),))

    def demonstrate(self, arm: Arm, answer: Sequence[int]) -> Script:
        self.under = dict(zip(self.covered(answer), self.cubes, strict=True))
        for number, cube in self.under.items():
            cube.home = Placement((*self.spots[number], CUBE / 2))
            cube.restore()
        for body in (*self.shells, *self.cubes):
            body.hold(True)
        for shell in self.shells:
            shell.put(Placement((*shell.home.p[:2], HIGH)))
        cover = self.cover()
        self.showing = (0,)
        yield from chain(arm.wait(45), islice(cover, SEEN))
        self.showing = ()
        yield from chain(cover, arm.wait(50))

    def cover(self) -> Script:
        """Lower the containers."""
        paths = [along(shell, shell.home, FALL) for shell in self.shells]
        for placements in zip(*paths, strict=True):
            for shell, placement in zip(self.shells, placements, strict=True):
                shell.put(placement)
            yield

    def step(self, answer: Sequence[int], number: int) -> Step:
        shell = self.shells[answer[number // 2]]
        if number % 2:
            return Step("put it down at <point>", (shell.home.p,), self.put_down)
        knob = shell.point(0, 0, shell.size)
        return Step(
            "pick up the container at <point>", (knob,), lambda arm: self.pick_up(arm, shell)
        )

    def progress(self) -> int:
        return 2 * self.found - self.held

    def pick_up(self, arm: Arm, shell: Body) -> Script:
        self.taken = shell.point(0, 0, shell.size)
        yield from arm.pick(self.taken)
        yield from arm.wait(5)

    def put_down(self, arm: Arm) -> Script:
        yield from arm.lower(self.taken)
        yield from arm.move((self.taken[0], self.taken[1], 0.25))

    def judge(self, arm: Arm, answer: Sequence[int]) -> Status:
        done = answer[: self.found]
        for number, shell in enumerate(self.shells):
            if number not in (*done, answer[self.found]) and rim(shell) > PEEKED:
                return Status.FAIL
        lifted = self.shells[answer[self.found]].p[2] > LIFTED
        self.held = lifted or (self.held and arm.opening < HELD)
        self.found += lifted
        return Status.SUCCESS if self.found == len(answer) else Status.ONGOING


def rim(shell: Body) -> float:
    """Return the height in m of the highest corner of a container's open side."""
    return max(float(shell.point(x, y, 0)[2]) for x, y in product((-SIDE, SIDE), repeat=2))


class VideoUnmaskSwap(SwapFamily, VideoUnmask):
    """As VideoUnmask, then containers swap places in pairs, once, twice or three times.

    Of three containers one stays; of four and five each ends elsewhere.
    """

    gap = 0.078

    def draw(self, rng: RandomState) -> None:
        super().draw(rng)
        self.count = len(self.spots)
        self.draw_swaps(rng)

    def demonstrate(self, arm: Arm, answer: Sequence[int]) -> Script:
        yield from super().demonstrate(arm, answer)
        cubes = {number: [cube] for number, cube in self.under.items()}
        groups = [[shell, *cubes.get(number, ())] for number, shell in enumerate(self.shells)]
        yield from self.swap(arm, groups, 1)
        yield from arm.wait(10)
