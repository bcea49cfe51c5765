"""The renderer; run as a program, it renders an image and prints what rendered it.

ManiSkill and torch are not imported, so that this check is fast.
"""

import os
import sys
from pathlib import Path
from tempfile import TemporaryFile

import sapien

from robomme_interference_data.errors import NoRendererError
from robomme_interference_data.simulators.sapien_renderer import describe_renderer

SHADERS = Path(__file__).parent / "shaders"
"""Folder of the suite's shaders. Those of sapien take ten seconds to compile."""


def make_renderer() -> sapien.render.RenderSystem:
    """Return sapien's renderer."""
    _check_shader_cache()
    try:
        return sapien.render.RenderSystem(sapien.Device("cpu"))
    except RuntimeError as error:
        raise NoRendererError.without_vulkan(error) from error


def _check_shader_cache() -> None:
    """Switch Mesa's shader cache off if it cannot be written: Mesa would print that many times."""
    try:
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        folder = Path(os.environ.get("MESA_SHADER_CACHE_DIR") or cache)
        folder.mkdir(parents=True, exist_ok=True)
        TemporaryFile(dir=folder).close()
    except (OSError, RuntimeError):  # RuntimeError: there is no home directory
        os.environ.setdefault("MESA_SHADER_CACHE_DISABLE", "true")


def main() -> None:
    """Render an empty scene; print the renderer, or why there is none."""
    try:
        sapien.render.set_camera_shader_dir(str(SHADERS))
        scene = sapien.Scene([make_renderer()])
        camera = scene.add_camera("camera", 16, 16, fovy=1.0, near=0.01, far=1.0)
        scene.update_render()
        camera.take_picture()
        camera.get_picture("Color")
        found = describe_renderer()
    except (NoRendererError, LookupError, RuntimeError) as error:
        sys.exit(str(error).splitlines()[0])
    sys.stdout.write(f"{found}\n")  # noqa: TID251 - a program of its own


if __name__ == "__main__":
    main()
