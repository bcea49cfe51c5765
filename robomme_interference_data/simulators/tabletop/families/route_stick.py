"""RouteStick: remember a route round posts."""

from functools import cache
from itertools import pairwise, product

import numpy as np
from numpy.random import RandomState
from numpy.typing import NDArray

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.tabletop.family import Option, Step
from robomme_interference_data.simulators.tabletop.kit import Kit
from robomme_interference_data.simulators.tabletop.motion import ROD, Arm, Point, Script
from robomme_interference_data.simulators.tabletop.stage import ABOVE, off_line

from .pattern_lock import StickFamily

Route = tuple[tuple[int, ...], tuple[int, ...]]

COUNT, SPACING = 5, 0.105  # targets; m from one to the next, with a post in the middle
RADIUS, POST, TALL = 0.024, 0.010, 0.07  # m
ASIDE = 0.06  # m, how far from a post the stick goes round it
FLAT = 0.003  # m, the height of a target
_SIDES = {1: "far", -1: "near"}  # seen from the arm
LOW, HIGH = FLAT + ABOVE, 0.13  # m, the stick's tip on the targets and above the posts


class RouteStick(StickFamily):
    """The stick goes from target to target, round the post between them on one side or the other.

    An answer is the targets' numbers, and for each post that is passed the side: 1 away from the
    arm, −1 towards it. Seen from above, that is clockwise or counter-clockwise round the post.
    """

    table = (0.48, 0.30, 0.30)
    stick = 0.12
    flat = (RADIUS, FLAT)
    turns = (2, 3, 4)

    def draw(self, rng: RandomState) -> None:
        x, y = np.array([-0.08, 0.0]) + rng.uniform(-0.02, 0.02, 2)
        self.spots = [(x, y + (n - (COUNT - 1) / 2) * SPACING) for n in range(COUNT)]
        self.posts = [(x, y + (n - (COUNT - 2) / 2) * SPACING) for n in range(COUNT - 1)]
        self.answers = routes(self.turns[self.level])
        self.reached: list[int] = []
        self.passed: list[int] = []
        self.before: NDArray[np.float64] | None = None

    def build(self, kit: Kit) -> None:
        for spot in self.spots:
            kit.target(spot, (0.95, 0.92, 0.85), RADIUS)
        for spot in self.posts:
            kit.post(spot, (0.12, 0.12, 0.14), POST, TALL)
        self.lamp = kit.lamp((0.35, 0.90, 0.45), RADIUS, FLAT + ABOVE / 2)

    def goals(self) -> tuple[str, ...]:
        return ("follow the same path round the posts with the stick as in the video",)

    def told(self, answer: Route) -> tuple[str, ...]:
        targets, sides = answer
        turns = zip(pairwise(targets), sides, strict=True)
        return (
            f"starts on target {targets[0]}",
            *(
                f"goes round post {min(pair)} on the {_SIDES[side]} side to target {pair[1]}"
                for pair, side in turns
            ),
        )

    def question(self) -> str:
        return "Which path did the stick take round the posts? Each picture shows one."

    def option(self, choice: Route) -> Option:
        targets, sides = choice
        marks: list[Point] = [(*self.spots[targets[0]], FLAT)]
        for (one, other), side in zip(pairwise(targets), sides, strict=True):
            x, y = self.posts[min(one, other)]
            marks += [(x + side * ASIDE, y, FLAT), (*self.spots[other], FLAT)]
        return Option("", tuple(marks))

    def steps(self) -> int:
        return self.turns[self.level] + 1

    def step(self, answer: Route, number: int) -> Step:
        targets, sides = answer
        to = (*self.spots[targets[number]], FLAT)
        if number == 0:
            return Step("go to the target at <point>", (to,), lambda arm: self.go(arm, answer, 0))
        post = (*self.posts[min(targets[number - 1 : number + 1])], TALL / 2)
        side = _SIDES[sides[number - 1]]
        text = f"go round the post at <point> on the {side} side to the target at <point>"
        return Step(text, (post, to), lambda arm: self.go(arm, answer, number))

    def progress(self) -> int:
        return len(self.reached)

    def go(self, arm: Arm, answer: Route, number: int) -> Script:
        targets, sides = answer
        spot = self.spots[targets[number]]
        if number == 0:
            yield from arm.move((*spot, HIGH))
        self.showing = (number,)
        if number:
            x, y = self.posts[min(targets[number - 1 : number + 1])]
            yield from arm.move((x + sides[number - 1] * ASIDE, y, LOW), speed=0.15)
        yield from arm.move((*spot, LOW), speed=0.15)
        yield from arm.wait(3)
        if number == self.steps() - 1:
            self.showing = ()
            yield from arm.move((*spot, HIGH))

    def judge(self, arm: Arm, answer: Route) -> Status:
        targets, sides = answer
        if self.follow(arm):
            return Status.FAIL
        if self.now is not None and (not self.reached or self.now != self.reached[-1]):
            self.reached.append(self.now)
            if len(self.passed) != len(self.reached) - 1:
                return Status.FAIL  # came over the posts, or went round one more
        if tuple(self.reached) != targets[: len(self.reached)]:
            return Status.FAIL
        if tuple(self.passed) != sides[: len(self.passed)]:
            return Status.FAIL
        return Status.SUCCESS if len(self.reached) == len(targets) else Status.ONGOING

    def follow(self, arm: Arm) -> bool:
        """Note on which side the tip has passed a post in this step; tell whether it hit one."""
        tip = arm.tip
        before = tip if self.before is None else self.before
        self.before = tip
        if tip[2] > TALL:
            return False
        for post in self.posts:
            if off_line(np.array(post), before[:2], tip[:2]) < POST + ROD:
                return True
            x, y = post
            if self.reached and (before[1] - y) * (tip[1] - y) < 0:
                part = (y - before[1]) / (tip[1] - before[1])
                off = before[0] + part * (tip[0] - before[0]) - x
                self.passed.append(1 if off > 0 else -1)
        return False


@cache
def routes(turns: int) -> list[Route]:
    """All routes with a number of turns: targets, and the sides on which posts are passed."""
    walks: list[tuple[int, ...]] = [(start,) for start in range(COUNT)]
    for _ in range(turns):
        walks = [(*w, to) for w in walks for to in (w[-1] - 1, w[-1] + 1) if 0 <= to < COUNT]
    return list(product(walks, product((1, -1), repeat=turns)))
