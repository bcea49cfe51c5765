"""Scripted motion: straight lines of the gripper, solved with sapien's inverse kinematics.

A script is a generator that yields once per time step of 0.1 s, after it has set `Arm.action`.
The gripper always points straight down; `yaw` rotates it about the vertical, and at yaw 0 the
fingers open along y.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import FPS
from robomme_interference_data.errors import RunError

Script = Iterator[None]

Point = Sequence[float] | NDArray[np.float64]
"""Three coordinates, or two on the table, in m."""

BASE = (-0.615, 0.0, 0.0)
"""Position of the arm's base in m; the table's top is the plane z = 0."""

HOME = (-0.30, 0.0, 0.26)
"""Gripper's position when demonstration and live part begin, clear of all objects, in m."""

REST_QPOS = (0.0, math.pi / 8, 0.0, -math.pi * 5 / 8, 0.0, math.pi * 3 / 4, math.pi / 4)
"""Joint positions in rad from which the solver searches for the home pose."""

ROD = 0.006
"""Radius of the stick that the gripper holds in some families, in m."""

HELD = 0.03
"""A finger that is open less than this, in m, may hold something."""

SPEED = 0.25  # m/s, at the middle of a move
SLOW = 0.12  # m/s, close to objects
TURN = 1.2  # rad/s
CLEARANCE = 0.10  # m above an object before the gripper goes down to it
_SAFE = 0.18  # m above the table, higher than what stands on it
SETTLE = 3  # time steps until the arm has caught up with its command
GRIP = 5  # time steps until the fingers have closed or opened


class Arm:
    """The arm, as scripts command it; `action` is the commanded action, `(8,) float32`.

    `pace` scales the speed of all moves. With a `stick` of some length in m, positions are those
    of its tip.
    """

    def __init__(self, articulation: Any, pace: float, stick: float):
        self._robot = articulation
        self._model = articulation.create_pinocchio_model()
        names = [link.name for link in articulation.links]
        self._tcp = next(i for i, name in enumerate(names) if name.endswith("panda_hand_tcp"))
        self._limits = np.array(articulation.qlimits[:7], dtype=np.float64)
        self._mask = np.array([1] * 7 + [0] * (articulation.dof - 7), dtype=np.int32)
        self._pace, self._stick = pace, stick
        rest = np.zeros(articulation.dof)
        rest[:7] = REST_QPOS
        self.home_qpos = self._solve(np.array(HOME), 0.0, rest)
        self.reset()

    def reset(self) -> None:
        """Command the home pose: gripper open, or closed around its stick."""
        self._qpos = self.home_qpos
        self._goal = np.array(HOME)
        self._yaw = 0.0
        self._gripper = -1.0 if self._stick else 1.0
        self._command()

    # --- current state -------------------------------------------------------------------------

    @property
    def state(self) -> NDArray[np.float32]:
        """`(8,) float32`: 7 joint positions in rad, opening of one finger in m."""
        return np.asarray(self._robot.qpos[:8], dtype=np.float32)

    @property
    def tip(self) -> NDArray[np.float64]:
        """Point between the fingertips, or the stick's tip: `(3,) float64`, in m."""
        pose = self._robot.links[self._tcp].entity_pose
        down = pose.to_transformation_matrix()[:3, 2]
        return np.asarray(pose.p + self._stick * down, dtype=np.float64)

    @property
    def opening(self) -> float:
        """Distance that one finger is open, 0 to 0.04 m."""
        return float(self._robot.qpos[7])

    @property
    def commanded(self) -> tuple[NDArray[np.float64], float]:
        """Commanded position, `(3,) float64` in m, and yaw in rad."""
        return self._goal, self._yaw

    # --- scripts ---------------------------------------------------------------------------------

    def wait(self, steps: int) -> Script:
        """Hold the commanded pose."""
        for _ in range(steps):
            yield

    def lasting(self, steps: int, script: Script) -> Script:
        """Run a script, then hold its last pose until `steps` time steps have passed.

        So a phase of a demonstration lasts equally long for every answer.

        Raises:
            RunError: The script takes longer.
        """
        used = 0
        for _ in script:
            used += 1
            yield
        if used > steps:
            raise RunError(
                f"a phase of the demonstration took {used} time steps, more than {steps}"
            )
        yield from self.wait(steps - used)

    def move(self, to: Point, yaw: float | None = None, speed: float = SPEED) -> Script:
        """Move in a straight line, slower at both ends; `speed` in m/s is that of the middle."""
        start, turn = self._goal, 0.0 if yaw is None else yaw - self._yaw
        way = np.asarray(to, dtype=np.float64) - start
        first_yaw = self._yaw
        seconds = 1.5 * max(float(np.linalg.norm(way)) / speed, abs(turn) / TURN) / self._pace
        steps = max(1, math.ceil(FPS * seconds))
        for step in range(1, steps + 1):
            part = eased(step / steps)
            self._goal = start + part * way
            self._yaw = first_yaw + part * turn
            self._qpos = self._solve(self._goal, self._yaw, self._qpos)
            self._command()
            yield

    def grip(self, *, close: bool) -> Script:
        """Close or open the fingers."""
        self._gripper = -1.0 if close else 1.0
        self._command()
        yield from self.wait(GRIP)

    def pick(self, at: Point, yaw: float = 0.0, lift: float = CLEARANCE) -> Script:
        """Grasp the object at a point from above, and lift it by `lift`, in m."""
        yield from self.go_above(at, yaw)
        yield from self.take(at, yaw, lift)

    def go_above(self, at: Point, yaw: float = 0.0) -> Script:
        """Move to where `take` begins."""
        x, y, z = at
        yield from self.move((x, y, max(z + CLEARANCE, self._goal[2])), yaw)
        yield from self.move((x, y, z + CLEARANCE), yaw)

    def take(self, at: Point, yaw: float = 0.0, lift: float = CLEARANCE) -> Script:
        """Move down to the object at a point, grasp it, and lift it by `lift`, in m."""
        x, y, z = at
        if self._gripper < 0:
            yield from self.grip(close=False)
        yield from self.move((x, y, z), yaw, SLOW)
        yield from self.wait(SETTLE)
        yield from self.grip(close=True)
        yield from self.move((x, y, z + lift), yaw, SLOW)

    def put(self, at: Point, yaw: float | None = None) -> Script:
        """Bring the held object to a point, release it there, and move up."""
        yield from self.carry(at, yaw)
        yield from self.lower(at)
        yield from self.carry(at)

    def carry(self, at: Point, yaw: float | None = None) -> Script:
        """Move above a point, to where `lower` begins."""
        x, y, z = at
        yield from self.move((x, y, z + CLEARANCE), yaw)

    def lower(self, at: Point) -> Script:
        """Lower the held object to a point and release it."""
        yield from self.move(at, speed=SLOW)
        yield from self.wait(SETTLE)
        yield from self.grip(close=False)

    def press(self, top: Point, depth: float = 0.015) -> Script:
        """Press a button, `top` being the middle of its top, with the closed gripper."""
        x, y, z = top
        yield from self.move((x, y, z + CLEARANCE), 0.0)
        yield from self.grip(close=True)
        yield from self.move((x, y, z - depth), speed=SLOW)
        yield from self.wait(SETTLE)
        yield from self.move((x, y, z + CLEARANCE))

    def rise(self, height: float) -> Script:
        """Move straight up to at least a height."""
        x, y, z = self._goal
        yield from self.move((x, y, max(z, height)))

    def go_home(self) -> Script:
        """Move up, then to the home pose, and open the gripper."""
        yield from self.rise(_SAFE)
        yield from self.move(HOME, 0.0)
        self._qpos = self.home_qpos  # without the elbow's angle, which depends on the way
        self._command()
        if not self._stick and self._gripper < 0:
            yield from self.grip(close=False)
        yield from self.wait(SETTLE)

    def leave_home(self, to: Point, yaw: float) -> Script:
        """Move from the home pose to a point, the last part straight down."""
        x, y, z = to
        yield from self.move((x, y, max(z, _SAFE)), yaw)
        yield from self.move(to, yaw, SLOW)

    # --- inverse kinematics ----------------------------------------------------------------------

    def _command(self) -> None:
        self.action = np.append(self._qpos[:7], self._gripper).astype(np.float32)

    def _solve(
        self, tip: NDArray[np.float64], yaw: float, start: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        import sapien

        tcp = tip + np.array([0.0, 0.0, self._stick])
        down = [0.0, math.cos(yaw / 2), math.sin(yaw / 2), 0.0]
        pose = sapien.Pose(tcp - np.array(BASE), down)
        qpos, solved, _ = self._model.compute_inverse_kinematics(
            self._tcp, pose, initial_qpos=start, active_qmask=self._mask, max_iterations=200
        )
        arm = np.asarray(qpos[:7])
        inside = (self._limits[:, 0] <= arm) & (arm <= self._limits[:, 1])
        if not solved or not inside.all():
            joint = int(np.argmin(inside)) + 1
            reason = f"joint {joint} at its limit" if solved else "no solution"
            raise RunError(
                f"the arm cannot reach {np.round(tcp, 3).tolist()} m, rotated by "
                f"{math.degrees(yaw):.0f}°: {reason}",
                "Keep targets within 0.3 to 0.72 m of the arm's base and clear of its limits.",
            )
        return np.asarray(qpos, dtype=np.float64)


def eased(part: float) -> float:
    """Map a fraction of the time to a fraction of the path: slower at both ends."""
    return part * part * (3 - 2 * part)
