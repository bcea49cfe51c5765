"""The scene kit: the bodies that the families are made of, built once here.

sapien is imported where something is built, so that families can be drawn without it.

Lengths are in m. The table's top is z = 0, the arm stands at x = −0.615 and faces +x; the front
camera looks back at it. Colours are RGB from 0 to 1.
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

Colour = tuple[float, float, float]

COLOURS: dict[str, Colour] = {
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

_LOW = -0.5  # z where things wait that are not to be seen, inside the table's block


@dataclass(frozen=True)
class Place:
    """A position, `(3,)` in m, and a turn about the vertical in rad."""

    p: tuple[float, float, float]
    yaw: float = 0.0

    @property
    def pose(self) -> "sapien.Pose":
        """The same for sapien."""
        import sapien

        return sapien.Pose(self.p, [math.cos(self.yaw / 2), 0, 0, math.sin(self.yaw / 2)])


class Body:
    """A thing on the table.

    Args:
        entity: sapien's entity.
        home: Where it is when the episode starts, and again when execution starts.
        size: Whatever its family wants to know of it, e.g. a height.
    """

    def __init__(self, entity: Any, home: Place, size: float = 0.0):
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

    def point(self, x: float, y: float, z: float) -> NDArray[np.float64]:
        """Where a point of the body, given in its own axes, is on the table: `(3,) float64`."""
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

    def put(self, place: Place) -> None:
        """Set the body somewhere, at rest."""
        self._entity.set_pose(place.pose)
        if self._movable and not self._rigid.kinematic:
            self._rigid.set_linear_velocity([0, 0, 0])
            self._rigid.set_angular_velocity([0, 0, 0])

    def hold(self, held: bool) -> None:
        """Take the body out of the physics, so that the scene can play with it, or let it go."""
        if self._movable:
            self._rigid.set_kinematic(held)

    def restore(self) -> None:
        """Bring the body home, free and at rest."""
        self.hold(False)
        self.put(self.home)


class Kit:
    """Builds bodies in a scene and keeps all of them.

    Args:
        scene: ManiSkill's scene.
    """

    def __init__(self, scene: Any):
        self._scene = scene
        self.bodies: list[Body] = []

    def restore(self) -> None:
        """Bring all bodies home."""
        for body in self.bodies:
            body.restore()

    # --- the room ----------------------------------------------------------------------------

    def room(self, table: Colour, floor: Colour) -> None:
        """A table with the arm on it, a floor behind it and before it, and a wall at the back."""
        self._body(
            [((0, 0, -0.45), (0.55, 0.75, 0.45), table)],
            Place((-0.25, 0, 0)),
            "table",
            moves="never",
        )
        # No floor under the table: hidden pixels would cost as much as those that are seen.
        self._body(
            [
                ((-4.8, 0, -0.05), (4, 8, 0.05), floor),
                ((4.3, 0, -0.05), (4, 8, 0.05), floor),
                ((-5, 0, 3), (0.05, 8, 3), _dark(floor, 0.8)),
            ],
            Place((0, 0, -0.9)),
            "floor",
            moves="never",
            solid=False,
        )

    def panel(self, xy: Point, half: Sequence[float], colour: Colour) -> Body:
        """A thin plate on the table, to set things apart by its colour."""
        return self._body(
            [((0, 0, 0.0005), (half[0], half[1], 0.0005), colour)],
            Place((xy[0], xy[1], 0)),
            "panel",
            moves="by hand",
            solid=False,
        )

    # --- things to move ------------------------------------------------------------------------

    def cube(self, xy: Point, colour: str, yaw: float = 0.0) -> Body:
        """A cube of 4 cm on the table."""
        half = CUBE / 2
        return self._body(
            [((0, 0, 0), (half, half, half), COLOURS[colour])],
            Place((xy[0], xy[1], half), yaw),
            f"{colour} cube",
            size=CUBE,
        )

    def container(self, xy: Point, colour: Colour) -> Body:
        """An opaque box without bottom, 7 cm wide and high, with a knob to grasp it by."""
        outer, wall, height = SIDE, 0.003, 0.065
        side, mid = outer - wall, height / 2
        boxes = [
            ((0, side, mid), (outer, wall, mid), colour),
            ((0, -side, mid), (outer, wall, mid), colour),
            ((side, 0, mid), (wall, outer, mid), colour),
            ((-side, 0, mid), (wall, outer, mid), colour),
            ((0, 0, height - wall), (outer, outer, wall), colour),
            ((0, 0, height + 0.014), (0.011, 0.011, 0.014), _dark(colour, 0.45)),
        ]
        return self._body(boxes, Place((xy[0], xy[1], 0)), "container", size=height + 0.014)

    def peg(self, xy: Point, head: Colour, tail: Colour, length: float = 0.14) -> Body:
        """A peg of 2.4 cm across that lies along x: its head towards +x, its tail towards −x."""
        half, thick = length / 4, 0.012
        boxes = [
            ((half, 0, 0), (half, thick, thick), head),
            ((-half, 0, 0), (half, thick, thick), tail),
        ]
        return self._body(boxes, Place((xy[0], xy[1], thick)), "peg", size=length, density=300)

    def hook(self, xy: Point, colour: Colour, length: float, reach: float) -> Body:
        """A peg with a crosspiece: the handle lies along x, the crosspiece at its +x end, to +y."""
        thick = 0.009
        boxes = [
            ((length / 2, 0, 0), (length / 2, thick, thick), colour),
            ((length - thick, reach / 2, 0), (thick, reach / 2, thick), colour),
        ]
        return self._body(boxes, Place((xy[0], xy[1], thick)), "hook", size=length, density=300)

    # --- things that stay ----------------------------------------------------------------------

    def target(self, xy: Point, colour: Colour, radius: float) -> Body:
        """A flat disc on the table: a ring of the colour around a white middle."""
        discs = [(0.0, radius, 0.002, colour), (0.0, 0.55 * radius, 0.003, (0.95,) * 3)]
        return self._body([], Place((xy[0], xy[1], 0)), "target", radius, "by hand", discs=discs)

    def lamp(self, colour: Colour, radius: float, height: float) -> Body:
        """A disc that covers the target or grid button that is lit; see `light`."""
        discs = [(0.0, radius, height, colour)]
        return self._body([], Place((0, 0, _LOW)), "lamp", height, "by hand", discs=discs)

    def button(self, xy: Point) -> Body:
        """A red push button of 4 cm height on a dark base; `home.p` is the middle of its top."""
        self._body(
            [((0, 0, 0.01), (0.035, 0.035, 0.01), (0.12, 0.12, 0.13))],
            Place((xy[0], xy[1], 0)),
            "button base",
            moves="by hand",
        )
        discs = [(-0.024, 0.022, 0.024, (0.9, 0.1, 0.1))]
        return self._body([], Place((xy[0], xy[1], 0.04)), "button", 0.022, "by hand", discs=discs)

    def post(self, xy: Point, colour: Colour, radius: float, height: float) -> Body:
        """An upright post to look at: it stops nothing, so its family judges who runs into it."""
        discs = [(0.0, radius, height, colour)]
        return self._body([], Place((xy[0], xy[1], 0)), "post", radius, "by hand", discs=discs)

    def socket(self, xy: Point, colour: Colour, hole: float, depth: float) -> Body:
        """A box with a square hole along y, open at both sides; z 0 of the body is the table."""
        half, wall, middle = hole / 2, 0.02, 0.05
        dark, low = _dark(colour, 0.6), middle - half
        boxes = [
            ((0, 0, low / 2), (half + wall, depth / 2, low / 2), colour),
            ((0, 0, middle + half + wall / 2), (half + wall, depth / 2, wall / 2), colour),
            ((half + wall / 2, 0, middle), (wall / 2, depth / 2, half), dark),
            ((-half - wall / 2, 0, middle), (wall / 2, depth / 2, half), dark),
        ]
        return self._body(boxes, Place((xy[0], xy[1], 0)), "socket", size=middle, moves="by hand")

    @staticmethod
    def light(lamp: Body, at: Point | None) -> None:
        """Show a lamp at a place on the table, or hide it."""
        lamp.put(lamp.home if at is None else Place((at[0], at[1], 0.0)))

    def _body(
        self,
        boxes: Iterable[tuple[Sequence[float], Sequence[float], Colour]],
        home: Place,
        name: str,
        size: float = 0.0,
        moves: str = "freely",
        density: float = 500.0,
        solid: bool = True,
        discs: Iterable[tuple[float, float, float, Colour]] = (),
    ) -> Body:
        """Build a body of boxes, each `(middle, half size, colour)`, and of discs to look at.

        A disc is `(z of its bottom, radius, height, colour)`.
        """
        import sapien

        from .drawing import UPRIGHT, material

        builder = self._scene.create_actor_builder()
        for middle, half, colour in boxes:
            pose = sapien.Pose(middle)
            if solid:
                builder.add_box_collision(pose, half, density=density)
            builder.add_box_visual(pose, half, material(colour))
        for bottom, radius, height, colour in discs:
            # sapien's cylinders lie along x; this quaternion stands them up.
            pose = sapien.Pose([0, 0, bottom + height / 2], UPRIGHT)
            builder.add_cylinder_visual(pose, radius, height / 2, material(colour))
        builder.set_initial_pose(home.pose)
        build = {
            "freely": builder.build,
            "by hand": builder.build_kinematic,
            "never": builder.build_static,
        }[moves]
        actor = build(name=f"{len(self.bodies)} {name}")
        body = Body(actor._objs[0], home, size)
        self.bodies.append(body)
        return body


def _dark(colour: Colour, part: float) -> Colour:
    red, green, blue = colour
    return red * part, green * part, blue * part
