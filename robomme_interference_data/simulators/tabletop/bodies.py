"""The bodies that all families are built from.

sapien is imported only where a body is built, so that scenes can be drawn up without it.

Lengths are in m. The table's top is z = 0, the arm stands at x = −0.615 and faces +x; the front
camera looks back at it. Colors are RGB from 0 to 1.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .motion import Point

if TYPE_CHECKING:
    import sapien

Color = tuple[float, float, float]
Box = tuple[Sequence[float], Sequence[float], Color]
"""Its middle, half its size, its color."""

Disc = tuple[float, float, float, Color]
"""z of its bottom, radius, height, color."""

COLORS: dict[str, Color] = {
    "red": (0.85, 0.08, 0.08),
    "green": (0.10, 0.62, 0.16),
    "blue": (0.10, 0.22, 0.85),
    "yellow": (0.95, 0.78, 0.08),
    "purple": (0.52, 0.16, 0.66),
    "orange": (0.95, 0.45, 0.05),
}

CUBE = 0.04
"""Edge of a cube."""

SIDE = 0.036
"""Half the width of a container."""

UPRIGHT = (math.sqrt(0.5), 0, math.sqrt(0.5), 0)
"""The rotation, as a quaternion, that stands up sapien's cylinders, which lie along x."""

_ROOM = 2  # bodies of the room, which are built first
_HIDDEN_Z = -0.5  # inside the table's block, where lamps wait until they are lit


@dataclass(frozen=True)
class Placement:
    """A position, `(3,)` in m, and a rotation about the vertical in rad."""

    p: tuple[float, float, float]
    yaw: float = 0.0

    @property
    def pose(self) -> "sapien.Pose":
        """The same as sapien's pose."""
        import sapien

        return sapien.Pose(self.p, [math.cos(self.yaw / 2), 0, 0, math.sin(self.yaw / 2)])


class Body:
    """A body on the table.

    `home` is where it is when the demonstration and the live part begin; `size` is the one length
    that its family needs, such as a height.
    """

    def __init__(self, entity: Any, home: Placement, size: float = 0.0):
        import sapien

        self.home = home
        self.size = size
        self._entity = entity
        self._rigid = entity.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent)
        self._movable = self._rigid is not None and not self._rigid.kinematic

    @property
    def p(self) -> NDArray[np.float64]:
        """Position, `(3,) float64`."""
        return np.asarray(self._entity.pose.p, dtype=np.float64)

    @property
    def pose(self) -> "sapien.Pose":
        """Position and rotation."""
        return self._entity.pose

    @pose.setter
    def pose(self, pose: "sapien.Pose") -> None:
        self._entity.set_pose(pose)

    @property
    def materials(self) -> "list[sapien.render.RenderMaterial]":
        """The materials of its surfaces."""
        import sapien

        drawn = self._entity.find_component_by_type(sapien.render.RenderBodyComponent)
        return [shape.material for shape in drawn.render_shapes]

    def point(self, x: float, y: float, z: float) -> NDArray[np.float64]:
        """Convert a point from the body's own axes to the table's, `(3,) float64`."""
        import sapien

        return np.asarray((self._entity.pose * sapien.Pose([x, y, z])).p, dtype=np.float64)

    @property
    def touched(self) -> bool:
        """Whether a part of the arm presses on the body."""
        import sapien

        arm = sapien.physx.PhysxArticulationLinkComponent
        return any(
            self._rigid in contact.bodies
            and any(isinstance(body, arm) for body in contact.bodies)
            and any(np.any(point.impulse) for point in contact.points)
            for contact in self._entity.scene.physx_system.get_contacts()
        )

    def put(self, placement: Placement) -> None:
        """Set the body somewhere, at rest."""
        self._entity.set_pose(placement.pose)
        if self._movable and not self._rigid.kinematic:
            self._rigid.set_linear_velocity([0, 0, 0])
            self._rigid.set_angular_velocity([0, 0, 0])

    def hold(self, held: bool) -> None:
        """Take the body out of the physics, so that a script can move it, or give it back."""
        if self._movable:
            self._rigid.set_kinematic(held)

    def restore(self) -> None:
        """Return the body to its home, free and at rest."""
        self.hold(False)
        self.put(self.home)


class SceneBuilder:
    """Builds bodies in a ManiSkill scene and keeps a list of them."""

    def __init__(self, scene: Any):
        self._scene = scene
        self.bodies: list[Body] = []

    @property
    def things(self) -> list[Body]:
        """The bodies on the table."""
        return self.bodies[_ROOM:]

    def restore(self) -> None:
        """Return all bodies to their homes."""
        for body in self.bodies:
            body.restore()

    # --- the room ----------------------------------------------------------------------------

    def room(self, table: Color, floor: Color) -> None:
        """Build the table with the arm on it, the floor around it, and a wall at the back."""
        top: Box = ((0, 0, -0.45), (0.55, 0.75, 0.45), table)
        self._body("table", (-0.25, 0), boxes=[top], moves="never")
        # No floor under the table: hidden pixels would cost as much as visible ones.
        boxes: list[Box] = [
            ((-4.8, 0, -0.05), (4, 8, 0.05), floor),
            ((4.3, 0, -0.05), (4, 8, 0.05), floor),
            ((-5, 0, 3), (0.05, 8, 3), _dark(floor, 0.8)),
        ]
        self._body("floor", (0, 0), -0.9, boxes=boxes, moves="never", solid=False)

    def panel(self, xy: Point, half: Sequence[float], color: Color) -> Body:
        """Build a thin plate on the table that sets things apart by its color."""
        boxes: list[Box] = [((0, 0, 0.0005), (half[0], half[1], 0.0005), color)]
        return self._body("panel", xy, boxes=boxes, moves="by script", solid=False)

    # --- bodies that move freely ---------------------------------------------------------------

    def cube(self, xy: Point, color: str, yaw: float = 0.0) -> Body:
        """Build a cube of 4 cm on the table."""
        half = CUBE / 2
        boxes: list[Box] = [((0, 0, 0), (half, half, half), COLORS[color])]
        return self._body(f"{color} cube", xy, half, yaw, boxes=boxes, size=CUBE)

    def container(self, xy: Point, color: Color) -> Body:
        """Build an opaque box without a bottom, 7 cm wide and high, with a knob to grasp."""
        outer, wall, height = SIDE, 0.003, 0.065
        side, mid = outer - wall, height / 2
        boxes: list[Box] = [
            ((0, side, mid), (outer, wall, mid), color),
            ((0, -side, mid), (outer, wall, mid), color),
            ((side, 0, mid), (wall, outer, mid), color),
            ((-side, 0, mid), (wall, outer, mid), color),
            ((0, 0, height - wall), (outer, outer, wall), color),
            ((0, 0, height + 0.014), (0.011, 0.011, 0.014), _dark(color, 0.45)),
        ]
        return self._body("container", xy, boxes=boxes, size=height + 0.014)

    def peg(self, xy: Point, head: Color, tail: Color, length: float = 0.14) -> Body:
        """Build a peg of 2.4 cm across along x: its head towards +x, its tail towards −x."""
        half, thick = length / 4, 0.012
        boxes: list[Box] = [
            ((half, 0, 0), (half, thick, thick), head),
            ((-half, 0, 0), (half, thick, thick), tail),
        ]
        return self._body("peg", xy, thick, boxes=boxes, size=length, density=300)

    def hook(self, xy: Point, color: Color, length: float, reach: float) -> Body:
        """Build a hook: the handle lies along x, the crosspiece at its +x end, towards +y."""
        thick = 0.009
        boxes: list[Box] = [
            ((length / 2, 0, 0), (length / 2, thick, thick), color),
            ((length - thick, reach / 2, 0), (thick, reach / 2, thick), color),
        ]
        return self._body("hook", xy, thick, boxes=boxes, size=length, density=300)

    # --- bodies that only a script moves -------------------------------------------------------

    def target(self, xy: Point, color: Color, radius: float) -> Body:
        """Build a flat disc on the table: a ring of the color around a white middle."""
        discs: list[Disc] = [(0.0, radius, 0.002, color), (0.0, 0.55 * radius, 0.003, (0.95,) * 3)]
        return self._body("target", xy, discs=discs, size=radius, moves="by script")

    def lamp(self, color: Color, radius: float, height: float) -> Body:
        """Build a disc that covers the target or grid button that is lit; see `light`."""
        discs = [(0.0, radius, height, color)]
        return self._body("lamp", (0, 0), _HIDDEN_Z, discs=discs, size=height, moves="by script")

    def button(self, xy: Point) -> Body:
        """Build a red push button of 4 cm height; `home.p` is the middle of its top."""
        base: Box = ((0, 0, 0.01), (0.035, 0.035, 0.01), (0.12, 0.12, 0.13))
        self._body("button base", xy, boxes=[base], moves="by script")
        discs: list[Disc] = [(-0.024, 0.022, 0.024, (0.9, 0.1, 0.1))]
        return self._body("button", xy, 0.04, discs=discs, size=0.022, moves="by script")

    def post(self, xy: Point, color: Color, radius: float, height: float) -> Body:
        """Build an upright post that stops nothing: its family detects collisions with it."""
        discs = [(0.0, radius, height, color)]
        return self._body("post", xy, discs=discs, size=radius, moves="by script")

    def socket(self, xy: Point, color: Color, hole: float, depth: float) -> Body:
        """Build a box with a square hole along y, open at both sides."""
        half, wall, middle = hole / 2, 0.02, 0.05
        dark, low = _dark(color, 0.6), middle - half
        boxes: list[Box] = [
            ((0, 0, low / 2), (half + wall, depth / 2, low / 2), color),
            ((0, 0, middle + half + wall / 2), (half + wall, depth / 2, wall / 2), color),
            ((half + wall / 2, 0, middle), (wall / 2, depth / 2, half), dark),
            ((-half - wall / 2, 0, middle), (wall / 2, depth / 2, half), dark),
        ]
        return self._body("socket", xy, boxes=boxes, size=middle, moves="by script")

    @staticmethod
    def light(lamp: Body, at: Point | None) -> None:
        """Show a lamp at a point of the table, or hide it."""
        lamp.put(lamp.home if at is None else Placement((at[0], at[1], 0.0)))

    def _body(
        self,
        name: str,
        xy: Point,
        z: float = 0.0,
        yaw: float = 0.0,
        *,
        boxes: Iterable[Box] = (),
        discs: Iterable[Disc] = (),
        size: float = 0.0,
        moves: str = "freely",
        density: float = 500.0,
        solid: bool = True,
    ) -> Body:
        """Build a body of boxes and of discs; discs are drawn but not solid."""
        import sapien

        builder = self._scene.create_actor_builder()
        for middle, half, color in boxes:
            pose = sapien.Pose(middle)
            if solid:
                builder.add_box_collision(pose, half, density=density)
            builder.add_box_visual(pose, half, material(color))
        for bottom, radius, height, color in discs:
            pose = sapien.Pose([0, 0, bottom + height / 2], UPRIGHT)
            builder.add_cylinder_visual(pose, radius, height / 2, material(color))
        home = Placement((xy[0], xy[1], z), yaw)
        builder.set_initial_pose(home.pose)
        build = {
            "freely": builder.build,
            "by script": builder.build_kinematic,
            "never": builder.build_static,
        }[moves]
        actor = build(name=f"{len(self.bodies)} {name}")
        body = Body(actor._objs[0], home, size)
        self.bodies.append(body)
        return body


def _dark(color: Color, part: float) -> Color:
    red, green, blue = color
    return red * part, green * part, blue * part


def material(color: Color, roughness: float = 0.9, specular: float = 0.1) -> Any:
    """Return a plain material of a color, matte by default."""
    import sapien

    return sapien.render.RenderMaterial(
        base_color=[*color, 1.0], roughness=roughness, specular=specular
    )
