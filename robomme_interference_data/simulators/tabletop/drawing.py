"""Fast rendering on a CPU: a Panda with few polygons, and matte surfaces.

The visual meshes of the arm (135,000 triangles) and of its wrist camera (425,000) would take
nearly all of a frame's time. Instead, the arm is drawn with its collision meshes (2,100 triangles,
the same outline) and the camera as a box. The shaders beside this file skip the reflections,
textures, positions, segmentation and hidden surfaces that sapien's shaders compute, and take a
third of their time.
"""

import math
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import sapien
from mani_skill import PACKAGE_ASSET_DIR
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots import PandaWristCam
from mani_skill.render.shaders import ShaderConfig
from mani_skill.sensors.camera import CameraConfig

from .bodies import UPRIGHT, material
from .motion import ROD
from .renderer import SHADERS

SHADER = ShaderConfig(
    shader_pack=str(SHADERS),
    texture_names={"Color": ["rgb"]},
    texture_transforms={"Color": lambda data: {"rgb": data[..., :3]}},
)
"""Shader of every camera of the suite; it renders colors only."""

sapien.render.set_picture_format("Color", "r8g8b8a8unorm")

PANDA = "panda_low_polygon"
"""Name of the arm in ManiSkill."""

_PAINT = {
    **dict.fromkeys(("link0", "link1", "link3", "link5", "link7", "hand"), (0.93, 0.94, 0.95)),
    **dict.fromkeys(("link2", "link4", "link6"), (0.72, 0.75, 0.78)),
    **dict.fromkeys(("leftfinger", "rightfinger", "camera_link"), (0.16, 0.17, 0.19)),
}
_CAMERA = (0.010, 0.045, 0.0115)  # half size in m


@register_agent()
class LowPolygonPanda(PandaWristCam):  # type: ignore[misc]
    """The Panda with its wrist camera, 256×256."""

    uid = PANDA

    @property
    def _sensor_configs(self) -> list[CameraConfig]:
        mount = self.robot.links_map["camera_link"]
        view = {"fov": math.pi / 2, "near": 0.01, "far": 10, "shader_config": SHADER}
        return [CameraConfig("wrist", sapien.Pose(), 256, 256, mount=mount, **view)]


def draw_low_polygon(articulation: Any, stick: float) -> None:
    """Replace the visual shapes of the arm; its physics stay the same.

    `stick` is the length in m that the stick in the gripper reaches beyond the fingertips; 0 for
    none.
    """
    for link in articulation.links:
        part = link.name.removeprefix(f"scene-0-{PANDA}_").removeprefix("panda_")
        old = link.entity.find_component_by_type(sapien.render.RenderBodyComponent)
        if old is None or part not in _PAINT:
            continue
        link.entity.remove_component(old)
        body = sapien.render.RenderBodyComponent()
        painted = material(_PAINT[part], 0.7, 0.2)
        if part == "camera_link":
            shape = sapien.render.RenderShapeBox(_CAMERA, painted)
            shape.set_local_pose(sapien.Pose([-0.0125, -0.02, 0]))
        else:
            mesh = "finger" if part.endswith("finger") else part
            shape = sapien.render.RenderShapeTriangleMesh(*_mesh(mesh), painted)
        if part == "rightfinger":  # the same mesh, rotated by 180°
            shape.set_local_pose(sapien.Pose([0, 0, 0], [0, 0, 0, 1]))
        body.attach(shape)
        if stick and part == "hand":
            body.attach(stick_shape(stick))
        link.entity.add_component(body)


def stick_shape(stick: float) -> Any:
    """Return the shape of a stick of a length, in the axes of the hand that holds it."""
    wood = material((0.30, 0.18, 0.08), 0.7, 0.2)
    half = (stick + 0.04) / 2
    rod = sapien.render.RenderShapeCylinder(ROD, half, wood)
    rod.set_local_pose(sapien.Pose([0, 0, 0.1034 + stick - half], UPRIGHT))
    return rod


@lru_cache
def _mesh(name: str) -> tuple[Any, Any, Any, Any]:
    """Read a binary STL file as flat-shaded triangles: vertices, triangles, normals, uvs."""
    folder = Path(PACKAGE_ASSET_DIR) / "robots/panda/franka_description/meshes/collision"
    data = (folder / f"{name}.stl").read_bytes()
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("_", "<u2")])
    faces = np.frombuffer(data, record, offset=84)
    corners = faces["corners"]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    vertices = corners.reshape(-1, 3).astype(np.float32)
    triangles = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    smooth = _smooth(vertices, np.repeat(normals, 3, axis=0))
    return vertices, triangles, smooth, np.zeros((len(vertices), 2), np.float32)


def _smooth(vertices: Any, normals: Any) -> Any:
    """Average the normals of faces that meet at less than 45°, to make round parts look round."""
    _, where = np.unique(np.round(vertices, 5), axis=0, return_inverse=True)
    where = where.reshape(-1)
    smooth = np.empty_like(normals)
    order = np.argsort(where, kind="stable")
    for group in np.split(order, np.flatnonzero(np.diff(where[order])) + 1):
        near = normals[group] @ normals[group].T > math.cos(math.pi / 4)
        smooth[group] = near @ normals[group]
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    return smooth.astype(np.float32)
