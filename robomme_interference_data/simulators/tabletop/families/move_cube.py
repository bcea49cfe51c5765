"""MoveCube: remember in which manner a cube was moved."""

import math
from typing import ClassVar

import numpy as np
from numpy.random import RandomState

from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators.family_scenes import MoveScene
from robomme_interference_data.simulators.tabletop.bodies import CUBE, SceneBuilder
from robomme_interference_data.simulators.tabletop.family import (
    Family,
    Step,
    Vector,
    distance_to_segment,
    is_near,
)
from robomme_interference_data.simulators.tabletop.motion import SLOW, Arm, Script

HANDLE, CROSS = 0.17, 0.065  # m, of the hook
STILL, SLACK = 1e-5, 0.002  # m: motion per step of a resting cube; total motion in wrong manners
_STEPS = {
    "push": "push the cube at <point> to the target at <point> with the closed gripper",
    "grasp": "grasp the cube at <point> and put it on the target at <point>",
    "hook": "hook the cube at <point> with the hook at <point> to the target at <point>",
}
BESIDE = 0.034  # m, from the middle of the handle to the middle of the cube


class MoveCube(MoveScene, Family):
    """The arm moves a cube to the target: it pushes it, grasps it, or hooks it."""

    goal = "move the cube to the target in the same manner as in the video"
    words: ClassVar = {
        "push": "pushes the cube with the closed gripper",
        "grasp": "grasps the cube",
        "hook": "hooks the cube",
    }
    steps = 1
    table = (0.86, 0.83, 0.76)
    spread = (0.02, 0.05, 0.08)  # m, how far cube and target may lie from the middle
    frames = ((207, 67), (217, 75), (229, 80))  # time steps, enough for every manner

    def draw(self, rng: RandomState) -> None:
        wide = self.spread[self.level]
        # The path crosses the front camera's view, so that the hand does not hide the cube.
        self.cube_at = np.array([-0.05, 0.10]) + rng.uniform(-1, 1, 2) * (wide, 0.02)
        self.target_at = np.array([-0.05, -0.055]) + rng.uniform(-1, 1, 2) * (wide, 0.02)
        way = self.target_at - self.cube_at
        self.way = np.append(way / np.linalg.norm(way), 0.0)
        self.turn = math.atan2(-way[1], -way[0])  # yaw at which x points back along the path
        self.answers = list(self.words)
        self.moved: dict[str, float] = {}  # m, by manner, how far the cube has moved
        self.manner, self.opening = "", 0.04

    def build(self, builder: SceneBuilder) -> None:
        self.cube = builder.cube(self.cube_at, "orange", self.turn)
        self.target = builder.target(self.target_at, (0.20, 0.45, 0.75), 0.04)
        self.hook = builder.hook((-0.20, -0.23), (0.25, 0.55, 0.50), HANDLE, CROSS)
        self.last = self.cube.p

    def demonstrate(self, arm: Arm, answer: str) -> Script:
        move, home = self.frames[self.level]
        yield from arm.wait(20)
        self.showing = (0,)
        yield from arm.lasting(move, self.solve(arm, answer))
        yield from arm.lasting(home, self.release(arm, answer))

    def release(self, arm: Arm, answer: str) -> Script:
        """Release the hook, and return."""
        if answer == "hook":
            yield from arm.grip(close=False)
        yield from arm.go_home()

    def step(self, answer: str, number: int) -> Step:
        do = {"push": self.push, "grasp": self.grasp, "hook": self.use_hook}[answer]
        start, end = self.cube.p, self.target.p
        tool = (self.hook.point(HANDLE / 2, 0, 0),) if answer == "hook" else ()
        return Step(_STEPS[answer], (start, *tool, end), lambda arm: do(arm, start, end))

    def push(self, arm: Arm, start: Vector, end: Vector) -> Script:
        behind = start - 0.055 * self.way
        yield from arm.move((behind[0], behind[1], 0.12), self.turn)
        yield from arm.grip(close=True)
        yield from arm.move(behind, speed=SLOW)
        yield from arm.move(end - 0.031 * self.way + (0, 0, CUBE / 2), speed=SLOW)
        yield from arm.wait(6)

    def grasp(self, arm: Arm, start: Vector, end: Vector) -> Script:
        yield from arm.pick(start, self.turn)
        yield from arm.put((end[0], end[1], CUBE / 2 + 0.002))

    def use_hook(self, arm: Arm, start: Vector, end: Vector) -> Script:
        grip = 0.025  # m from the handle's end
        at = self.hook.point(grip, 0, 0.004)
        yield from arm.pick(at)
        left = np.array([math.sin(self.turn), -math.cos(self.turn), 0.0])
        reach = HANDLE - 0.018 - grip - CUBE / 2  # from the grip to the cube's middle
        hold = (BESIDE * left) + (0, 0, at[2] + 0.003)
        behind = np.array((start[0], start[1], 0.0)) + hold + (reach - 0.025) * self.way
        yield from arm.move((behind[0], behind[1], 0.12), self.turn)
        yield from arm.move(behind, speed=SLOW)
        yield from arm.move(end + hold + (reach + 0.003) * self.way, speed=SLOW)
        yield from arm.wait(6)

    def judge(self, arm: Arm, answer: str) -> Status:
        now = self.cube.p
        step = float(np.linalg.norm(now - self.last))
        if step > STILL:
            self.manner = self.name_manner(arm)
            self.moved[self.manner] = self.moved.get(self.manner, 0.0) + step
        self.last, self.opening = now, arm.opening
        if sum(way for manner, way in self.moved.items() if manner != answer) > SLACK:
            return Status.FAIL
        released = answer != "grasp" or (arm.opening > 0.025 and now[2] < CUBE)
        there = is_near(self.cube, self.target, 0.03)
        return Status.SUCCESS if there and released and answer in self.moved else Status.ONGOING

    def name_manner(self, arm: Arm) -> str:
        """Return how the cube is moved now: an answer, or "open" for open fingers."""
        ends = ((0.0, 0.0), (HANDLE, 0.0), (HANDLE, CROSS))
        end, corner, tip = (self.hook.point(x, y, 0) for x, y in ends)
        hook = (end, corner), (corner, tip)
        beside = min(distance_to_segment(self.cube.p, *part) for part in hook)
        if beside < 0.045 and distance_to_segment(arm.tip, end, corner) < 0.03:
            return "hook"
        if math.dist(self.cube.p, arm.tip) < 0.01 and (
            abs(arm.opening - CUBE / 2) < 0.003 or arm.opening < self.opening - 0.001
        ):
            return "grasp"  # the fingers hold it, or are closing on it
        if self.manner == "grasp" and not self.cube.touched:
            return "grasp"  # released, it still falls
        return "push" if arm.opening < 0.01 else "open"
