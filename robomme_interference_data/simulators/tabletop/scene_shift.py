"""How the live scene looks under a shift: lamps, cameras, and things that take no part.

All of it is to be seen only. Nothing of it has a body, so that states, judgements and what a
script does stay what they are, bit for bit; it stands where no script takes the arm or an object.
What is drawn depends on the episode's seed and the kind; the strength says how much of it there is.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import sapien
from mani_skill.utils import sapien_utils
from numpy.random import RandomState
from numpy.typing import NDArray

from robomme_interference_data.schema.shifts import KINDS, Shift

from .camera import FRONT_EYE, FRONT_TARGET
from .drawing import UPRIGHT, material
from .kit import Colour

DIMMER, BRIGHTER, TINT = 0.20, 0.12, 0.12  # parts of the light, of a colour
MOVED, TURNED = 0.045, math.radians(1.5)  # m, rad

THINGS = (2, 4, 8)
"""Things that take no part, at each strength."""

PLACES = tuple(
    (x, side * y)
    for x, y in ((-0.62, 0.34), (-0.50, 0.39), (-0.38, 0.42), (-0.26, 0.42))
    for side in (1, -1)
)
"""Where they may stand, in m, and be seen by the front camera."""

WIDE, TALL = 0.062, 0.15
"""How far from there they may reach, and how high, in m."""

_PAINTS: tuple[Colour, ...] = (
    (0.62, 0.44, 0.26),
    (0.35, 0.38, 0.42),
    (0.82, 0.80, 0.74),
    (0.20, 0.46, 0.48),
    (0.44, 0.22, 0.26),
    (0.52, 0.56, 0.30),
)


class SceneShift:
    """The looks of one scene, as it was built or under a shift.

    Args:
        scene: sapien's scene.
        cameras: Name to sapien's camera.
        seed: Of the episode.
    """

    def __init__(self, scene: Any, cameras: Mapping[str, Any], seed: int):
        self._scene, self._seed = scene, seed
        self._ambient = np.array(scene.ambient_light)
        self._lamps = [(lamp, np.array(lamp.color)) for lamp in scene.render_system.lights]
        self._cameras = {name: (camera, camera.local_pose) for name, camera in cameras.items()}
        self._things: list[Any] = []

    def show(self, shift: Shift | None) -> None:
        """Make the scene look as under a shift; None as it was built."""
        self._light(np.ones(3))
        for camera, pose in self._cameras.values():
            camera.local_pose = pose
        while self._things:
            self._scene.remove_entity(self._things.pop())
        if shift is not None:
            rng = RandomState([self._seed, KINDS.index(shift.kind)])
            {"light": self._relight, "camera": self._move, "clutter": self._clutter}[shift.kind](
                rng, shift.strength
            )

    def _light(self, gains: NDArray[np.float64]) -> None:
        self._scene.ambient_light = self._ambient * gains
        for lamp, colour in self._lamps:
            lamp.color = colour * gains

    def _relight(self, rng: RandomState, strength: int) -> None:
        """Dim or raise all lamps, and give them a tint."""
        brightness = 1 + strength * float(rng.choice([-DIMMER, BRIGHTER]))
        hue = _direction(rng)
        hue -= hue.mean()  # it adds no light
        self._light(brightness * (1 + strength * TINT * hue / np.linalg.norm(hue)))

    def _move(self, rng: RandomState, strength: int) -> None:
        """Move the front camera, which looks where it looked, and turn both a little."""
        eye = np.array(FRONT_EYE) + strength * MOVED * _direction(rng)
        for name, (camera, pose) in self._cameras.items():
            half = strength * TURNED / 2
            turn = sapien.Pose(q=[math.cos(half), *(math.sin(half) * _direction(rng))])
            moved = sapien_utils.look_at(eye, FRONT_TARGET).sp if name == "front" else pose
            camera.local_pose = moved * turn

    def _clutter(self, rng: RandomState, strength: int) -> None:
        """Put boxes and tins on the table, at its sides."""
        places = [PLACES[number] for number in rng.permutation(len(PLACES))]
        for x, y in places[: THINGS[strength - 1]]:
            dx, dy = rng.uniform(-0.012, 0.012, 2)
            wide, deep, high = rng.uniform((0.02, 0.02, 0.025), (0.032, 0.032, 0.075))
            paint = material(_PAINTS[rng.randint(len(_PAINTS))])
            yaw = rng.uniform(0, math.pi)
            if rng.randint(2):
                shape = sapien.render.RenderShapeBox((wide, deep, high), paint)
            else:
                shape = sapien.render.RenderShapeCylinder(wide, high, paint)
                shape.local_pose = sapien.Pose(q=UPRIGHT)
            body = sapien.render.RenderBodyComponent()
            body.attach(shape)
            thing = sapien.Entity()
            thing.add_component(body)
            thing.pose = sapien.Pose(
                (x + dx, y + dy, high), [math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]
            )
            self._scene.add_entity(thing)
            self._things.append(thing)


def _direction(rng: RandomState) -> NDArray[np.float64]:
    """A direction in space, all alike: a vector of length 1, `(3,)`."""
    way = rng.normal(size=3)
    return np.asarray(way / np.linalg.norm(way))
