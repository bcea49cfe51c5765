"""The appearance of the live scene under a shift: light, cameras, clutter, and colors.

A shift changes images only. Clutter has no physics and stands where no script moves the arm or an
object, so states, judgments and scripted actions stay the same, bit for bit. What changes depends
on the episode's seed and the kind of shift; the strength scales it.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import sapien
from mani_skill.utils import sapien_utils
from numpy.random import RandomState
from numpy.typing import NDArray

from robomme_interference_data.schema.shifts import KINDS, Shift

from .bodies import COLORS, UPRIGHT, Body, Color, Placement, material
from .camera import AWAY, FRONT_EYE, FRONT_TARGET

DIMMER, BRIGHTER, TINT = 0.20, 0.12, 0.12  # fractions of the light, and of its color
MOVED, TURNED = 0.045, math.radians(1.5)  # m, rad
PAINTED = 0.12  # of the range of a color

CLUTTER = (2, 4, 8)
"""Number of clutter objects, by strength."""

POSITIONS = tuple(
    (x, side * y)
    for x, y in ((-0.62, 0.34), (-0.50, 0.39), (-0.38, 0.42), (-0.26, 0.42))
    for side in (1, -1)
)
"""Positions of clutter, in m, all visible to the front camera."""

WIDE, TALL = 0.062, 0.15
"""How far from its position a clutter object may reach, and how high, in m."""

_PAINTS: tuple[Color, ...] = (
    (0.62, 0.44, 0.26),
    (0.35, 0.38, 0.42),
    (0.82, 0.80, 0.74),
    (0.20, 0.46, 0.48),
    (0.44, 0.22, 0.26),
    (0.52, 0.56, 0.30),
)


class SceneShift:
    """Changes the appearance of one sapien scene, with its cameras by name, and its bodies."""

    def __init__(self, scene: Any, cameras: Mapping[str, Any], bodies: Iterable[Body], seed: int):
        self._scene, self._seed = scene, seed
        self._ambient = np.array(scene.ambient_light)
        self._lamps = [(lamp, np.array(lamp.color)) for lamp in scene.render_system.lights]
        self._cameras = {name: (camera, camera.local_pose) for name, camera in cameras.items()}
        self._materials = [(paint, paint.base_color) for body in bodies for paint in body.materials]
        self._objects: list[Any] = []

    def show(self, shift: Shift | None, part: float = 1.0) -> None:
        """Apply a shift, or a part of it, to the scene as it was built; None for no shift."""
        self._light(np.ones(3))
        for camera, pose in self._cameras.values():
            camera.local_pose = pose
        while self._objects:
            self._scene.remove_entity(self._objects.pop())
        for paint, color in self._materials:
            paint.base_color = color
        if shift is None:
            return
        rng = RandomState([self._seed, KINDS.index(shift.kind)])
        match shift.kind:
            case "light":
                self._relight(rng, part * shift.strength)
            case "camera":
                self._move(rng, part * shift.strength)
            case "clutter":
                self._clutter(rng, CLUTTER[shift.strength - 1], AWAY * (1 - part))
            case "colors":
                self._paint(part * shift.strength)

    def _light(self, gains: NDArray[np.float64]) -> None:
        self._scene.ambient_light = self._ambient * gains
        for lamp, color in self._lamps:
            lamp.color = color * gains

    def _relight(self, rng: RandomState, strength: float) -> None:
        """Dim or brighten all lamps, and tint them."""
        brightness = 1 + strength * float(rng.choice([-DIMMER, BRIGHTER]))
        self._light(brightness * (1 + strength * TINT * _hue(rng)))

    def _move(self, rng: RandomState, strength: float) -> None:
        """Move the front camera around its target, and rotate both cameras slightly."""
        eye = np.array(FRONT_EYE) + strength * MOVED * _direction(rng)
        for name, (camera, pose) in self._cameras.items():
            half = strength * TURNED / 2
            turn = sapien.Pose(q=[math.cos(half), *(math.sin(half) * _direction(rng))])
            moved = sapien_utils.look_at(eye, FRONT_TARGET).sp if name == "front" else pose
            camera.local_pose = moved * turn

    def _clutter(self, rng: RandomState, count: int, away: float) -> None:
        """Put boxes and cylinders at the sides of the table, or further out by a distance in m."""
        positions = [POSITIONS[number] for number in rng.permutation(len(POSITIONS))]
        for x, y in positions[:count]:
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
            entity = sapien.Entity()
            entity.add_component(body)
            entity.pose = Placement((x + dx, y + dy + math.copysign(away, y), high), yaw).pose
            self._scene.add_entity(entity)
            self._objects.append(entity)

    def _paint(self, strength: float) -> None:
        """Tint all colors that no goal names, each in its own way."""
        for paint, color in self._materials:
            rgb = np.array(color[:3])
            if any(np.allclose(rgb, named, atol=1e-3) for named in COLORS.values()):
                continue
            # Drawn from the color alone, so that equal things stay equal.
            rng = RandomState([self._seed, KINDS.index("colors"), *np.rint(255 * rgb).astype(int)])
            tinted = np.clip(rgb + strength * PAINTED * _hue(rng), 0, 1)
            paint.base_color = [*tinted, 1.0]


def _hue(rng: RandomState) -> NDArray[np.float64]:
    """Draw a direction of colors, `(3,)` of length 1, that adds no light."""
    hue = _direction(rng)
    hue -= hue.mean()
    return np.asarray(hue / np.linalg.norm(hue))


def _direction(rng: RandomState) -> NDArray[np.float64]:
    """Draw a unit vector, `(3,)`, uniformly distributed."""
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))
