"""InsertPeg: remember which peg was inserted, held at which end, into which side."""

import math
from itertools import product

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.scene import Option
from robomme_interference_data.simulators.tabletop.bodies import COLORS, SceneBuilder
from robomme_interference_data.simulators.tabletop.family import Family, Step, row
from robomme_interference_data.simulators.tabletop.motion import SLOW, Arm, Script

LENGTH, GRIP = 0.14, 0.04  # m: a peg, and from its middle to where it is grasped
HOLE, DEPTH = 0.036, 0.08  # m, of the box
TAKE, INSERT, RETURN = 103, 114, 52  # time steps of the phases of a demonstration
LIFTED = 0.03  # m, height of the peg's middle
HEAD, TAIL = 1, -1
LEFT, RIGHT = 1, -1
_ENDS = {HEAD: "head", TAIL: "tail"}
_SIDES = {LEFT: "left", RIGHT: "right"}


class InsertPeg(Family):
    """The arm grasps one of several pegs at one end and inserts it into one side of a box.

    An answer is `(peg, end, side)`: the peg's number, its grasped end, the side of the box.
    """

    goal = (
        "insert the same peg as in the video, held at the same end, into the same side of the box"
    )
    question = (
        "Which peg was inserted, held at which end, from which side? Each picture shows a way "
        "from where a peg is held to where it goes in."
    )
    steps = 2
    table = (0.40, 0.28, 0.56)
    pegs_at = (2, 3, 4)

    def draw(self, rng: RandomState) -> None:
        count = self.pegs_at[self.level]
        self.box_at = rng.uniform(-0.01, 0.01, 2)
        self.spots = row(rng, count, -0.20, 0.12)
        self.tails = [str(n) for n in rng.permutation(["red", "green", "blue", "purple"])][:count]
        self.answers = list(product(range(count), (HEAD, TAIL), (LEFT, RIGHT)))

    def build(self, builder: SceneBuilder) -> None:
        self.box = builder.socket(self.box_at, (0.55, 0.40, 0.25), HOLE, DEPTH)
        self.pegs = [
            builder.peg(spot, COLORS["yellow"], COLORS[tail], LENGTH)
            for spot, tail in zip(self.spots, self.tails, strict=True)
        ]

    def answer_texts(self, answer: tuple[int, int, int]) -> tuple[str, ...]:
        number, end, side = answer
        return (
            f"takes peg {number}",
            f"holds it at its {_ENDS[end]}",
            f"inserts it from the {_SIDES[side]}",
        )

    def option(self, choice: tuple[int, int, int]) -> Option:
        number, end, side = choice
        x, y = self.spots[number]
        mouth = (self.box_at[0], self.box_at[1] + side * (DEPTH / 2 + 0.03), HOLE)
        words = f"held at its {_ENDS[end]}, inserted from the {_SIDES[side]}"
        return Option(words, ((x + end * GRIP, y, 0.02), mouth))

    def demonstrate(self, arm: Arm, answer: tuple[int, int, int]) -> Script:
        peg, end, side = answer
        yield from arm.wait(5)
        self.showing = (0, 1)
        yield from arm.lasting(TAKE, self.take(arm, peg, end))
        self.showing = (0, 1, 2)  # the peg stays visible in the box
        yield from arm.lasting(INSERT, self.insert(arm, end, side))
        yield from arm.grip(close=False)
        yield from arm.lasting(RETURN, arm.go_home())

    def step(self, answer: tuple[int, int, int], number: int) -> Step:
        peg, end, side = answer
        if number == 0:
            at = self.pegs[peg].point(end * GRIP, 0, 0)
            text = f"pick up the peg at <point> by its {_ENDS[end]}"
            return Step(text, (at,), lambda arm: self.take(arm, peg, end))
        mouth = self.box.point(0, side * DEPTH / 2, self.box.size)
        text = f"insert it into the box at <point> from the {_SIDES[side]}"
        return Step(text, (mouth,), lambda arm: self.insert(arm, end, side))

    def progress(self) -> int:
        return int(any(peg.p[2] >= LIFTED for peg in self.pegs))

    def take(self, arm: Arm, number: int, end: int) -> Script:
        at = self.pegs[number].point(end * GRIP, 0, 0)
        yield from arm.pick(at, lift=0.15)

    def insert(self, arm: Arm, end: int, side: int) -> Script:
        x, y, _ = self.box.p
        free = GRIP + LENGTH / 2  # from the grip to the end that is inserted
        yaw = math.copysign(math.pi / 2, end * side)
        ready = y + side * (DEPTH / 2 + 0.03 + free)
        yield from arm.move((x, ready, 0.16), yaw)
        yield from arm.move((x, ready, self.box.size), speed=SLOW)
        yield from arm.wait(3)
        yield from arm.move((x, y + side * (DEPTH / 2 - 0.05 + free), self.box.size), speed=0.06)
        yield from arm.wait(5)

    def judge(self, arm: Arm, answer: tuple[int, int, int]) -> Status:
        number, end, side = answer
        for other, peg in enumerate(self.pegs):
            if peg.p[2] < LIFTED:
                continue
            ends = {e: peg.point(e * LENGTH / 2, 0, 0) for e in (HEAD, TAIL)}
            held = min(ends, key=lambda e: math.dist(ends[e], arm.tip))
            if other != number or held != end:
                return Status.FAIL
            from_side = LEFT if peg.p[1] > self.box.p[1] else RIGHT
            depth = self.inserted(ends[-end], from_side)
            if depth > 0.01 and from_side != side:
                return Status.FAIL
            if depth > 0.04:
                return Status.SUCCESS
        return Status.ONGOING

    def inserted(self, point: NDArray[np.float64], side: int) -> float:
        """Return how deep a point is in the hole, in m from its mouth; below 0 if outside."""
        x, y, z = point - self.box.p - (0, 0, self.box.size)
        return DEPTH / 2 - side * y if max(abs(x), abs(z)) < HOLE / 2 else -1.0
