"""How pictures are shaded: matt surfaces under the scene's lights, by the shaders beside this file.

The shaders that sapien brings compute reflections, textures, positions and segmentation too, of
which nothing is seen here, and shade what is hidden as well: on a processor three times the work.
"""

from pathlib import Path

import sapien
from mani_skill.render.shaders import ShaderConfig

__all__ = ["SHADER"]

SHADER = ShaderConfig(
    shader_pack=str(Path(__file__).parent / "shaders"),
    texture_names={"Color": ["rgb"]},
    texture_transforms={"Color": lambda data: {"rgb": data[..., :3]}},
)
"""For every camera of the suite; it draws colours and nothing else."""

sapien.render.set_picture_format("Color", "r8g8b8a8unorm")
