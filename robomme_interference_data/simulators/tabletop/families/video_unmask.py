"""VideoUnmask: remember which container hides a cube."""

from collections.abc import Sequence
from itertools import chain, islice, permutations, product

from numpy.random import RandomState

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.tabletop.family import Family, Option, Step
from robomme_interference_data.simulators.tabletop.kit import CUBE, SIDE, Body, Kit, Place
from robomme_interference_data.simulators.tabletop.motion import Arm, Script
from robomme_interference_data.simulators.tabletop.stage import along, row, shuffled

HIGH = 0.72  # m, above what the cameras see
FALL, SEEN = 55, 49  # time steps: of the containers' way down, and until they hide the cubes
LIFTED = 0.05  # m, of the right container
OPEN = 0.03  # m, way of a finger that holds nothing
PEEKED = 0.010  # m, of a wrong one: its cube comes into sight at 0.02


class VideoUnmask(Family):
    """Cubes lie in the open; opaque containers come down over them; lift the right one.

    An answer names the container of each colour that is asked for, in that order.
    """

    table = (0.60, 0.44, 0.28)
    pace = 0.4
    shell = (0.30, 0.34, 0.42)
    containers = (3, 4, 5)

    def draw(self, rng: RandomState) -> None:
        count = self.containers[self.level]
        colours = [str(colour) for colour in rng.permutation(["red", "green", "blue"])]
        self.asked = colours[: 2 if self.level == 2 else 1]
        self.colours = colours
        self.spots = row(rng, count, -0.04, 0.105, zigzag=0.02)
        self.order = shuffled(rng, count)
        self.answers = list(permutations(range(count), len(self.asked)))
        self.found, self.held = 0, False

    def build(self, kit: Kit) -> None:
        self.shells = [kit.container(spot, self.shell) for spot in self.spots]
        self.cubes = [kit.cube(spot, c) for spot, c in zip(self.spots, self.colours, strict=False)]

    def goals(self) -> tuple[str, ...]:
        first, *then = self.asked
        text = f"pick up the container that hides the {first} cube"
        for colour in then:
            text += f", put it down, then pick up the container that hides the {colour} cube"
        return (text,)

    def covered(self, answer: Sequence[int]) -> list[int]:
        """The containers that hide a cube, in the order of `colours`: those asked for, others."""
        rest = [number for number in self.order if number not in answer]
        return [*answer, *rest][: len(self.colours)]

    def told(self, answer: Sequence[int]) -> tuple[str, ...]:
        cubes = (f"the {c} cube at place {n}" for c, n in zip(self.asked, answer, strict=True))
        return (f"shows {' and '.join(cubes)}",)

    def question(self) -> str:
        return f"Which of the marked containers hides the {self.asked[0]} cube?"

    def choice(self, answer: Sequence[int]) -> int:
        return answer[0]

    def option(self, choice: int) -> Option:
        return Option("", ((*self.spots[choice], SIDE),))

    def demonstrate(self, arm: Arm, answer: Sequence[int]) -> Script:
        self.under = dict(zip(self.covered(answer), self.cubes, strict=True))
        for number, cube in self.under.items():
            cube.home = Place((*self.spots[number], CUBE / 2))
            cube.restore()
        for body in (*self.shells, *self.cubes):
            body.hold(True)
        for shell in self.shells:
            shell.put(Place((*shell.home.p[:2], HIGH)))
        cover = self.cover()
        self.showing = (0,)
        yield from chain(arm.wait(45), islice(cover, SEEN))
        self.showing = ()
        yield from chain(cover, arm.wait(50))

    def cover(self) -> Script:
        """The containers come down."""
        ways = [along(shell, shell.home, FALL) for shell in self.shells]
        for places in zip(*ways, strict=True):
            for shell, place in zip(self.shells, places, strict=True):
                shell.put(place)
            yield

    def steps(self) -> int:
        return 2 * len(self.asked)

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
        self.held = lifted or (self.held and arm.opening < OPEN)
        self.found += lifted
        return Status.SUCCESS if self.found == len(answer) else Status.ONGOING


def rim(shell: Body) -> float:
    """Height of the highest corner of a container's open side, in m: a tipped one counts too."""
    return max(float(shell.point(x, y, 0)[2]) for x, y in product((-SIDE, SIDE), repeat=2))
