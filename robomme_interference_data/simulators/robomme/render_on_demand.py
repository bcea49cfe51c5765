"""Render only the requested cameras: RoboMME renders both at every step, most of its time.

Runs in RoboMME's interpreter, as `worker.py` does. Rendered images, states and statuses are the
same, bit for bit; a camera that is not rendered shows its last image.
"""

from collections.abc import Callable, Iterable
from typing import Any

CAMERAS = {"front": "base_camera", "wrist": "hand_camera"}
"""Camera to its name in RoboMME."""


def always() -> bool:
    """Return True."""
    return True


class KeptFrames:
    """Whether to render the current frame of a demonstration: every n-th that RoboMME keeps.

    RoboMME drops the frames of tasks with a certain name, which are up to three quarters of all.
    """

    def __init__(self, env: Any, every: int) -> None:
        self._env, self._every = env, every
        self._steps: list[int] = []

    def __call__(self) -> bool:
        """Count the frame if RoboMME keeps it; return whether to render it."""
        step = int(self._env.elapsed_steps[0])
        # At step 0, in a reset, there is an observation that is no frame.
        if step == 0 or getattr(self._env, "current_task_name", None) == "NO RECORD":
            return False
        self._steps.append(step)
        return (len(self._steps) - 1) % self._every == 0

    def check(self, steps: list[int]) -> None:
        """Raise an error if RoboMME kept others than these frames, by their steps."""
        if steps != self._steps[: len(steps)]:
            raise RuntimeError("RoboMME kept other frames of its demonstration than were rendered")


class RenderOnDemand:
    """Patches ManiSkill to render only `cameras`, given by RoboMME's names; all at first.

    Where `keep` returns False, it renders none of them; where `needs_front` returns True, it
    renders the front camera in any case.

    One renderer is kept from the first picture on: while none exists, SAPIEN forgets the lighting
    table that it computes with the first one, which takes most of a reset without a GPU.
    """

    def __init__(self) -> None:
        from mani_skill.envs.sapien_env import BaseEnv

        self.cameras: Iterable[str] = CAMERAS.values()
        self.keep: Callable[[], bool] = always
        self.needs_front: Callable[[], bool] = bool
        self._last: dict[str, Any] = {}
        self._renderer: Any = None
        render_all = BaseEnv._get_obs_sensor_data

        def render(env: Any, *args: Any, **named: Any) -> dict[str, Any]:
            sensors = env._sensors
            if sensors.keys() <= self._last.keys():  # otherwise a camera has no last image yet
                drawn = {*self.cameras} if self.keep() else set()
                drawn |= {CAMERAS["front"]} if self.needs_front() else set()
                env._sensors = {name: sensor for name, sensor in sensors.items() if name in drawn}
            env.scene.sensors = env._sensors
            try:
                if env._sensors:
                    self._last |= render_all(env, *args, **named)
                    self._keep_renderer(env)
            finally:
                env._sensors = env.scene.sensors = sensors
            return dict(self._last)

        BaseEnv._get_obs_sensor_data = render

    def _keep_renderer(self, env: Any) -> None:
        if self._renderer is None:
            from sapien.render import RenderSystem

            self._renderer = RenderSystem(env._render_device)

    def images(self, env: Any, cameras: Iterable[str]) -> dict[str, Any]:
        """Return the current images of some cameras, `(256, 256, 3) uint8` each."""
        if not cameras:
            return {}
        self.cameras = [CAMERAS[camera] for camera in cameras]
        data = env.unwrapped._get_obs_sensor_data()
        return {name: data[CAMERAS[name]]["rgb"][0].cpu().numpy() for name in cameras}
