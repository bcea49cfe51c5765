"""Render only the requested cameras: RoboMME renders both at every step, most of its time.

Runs in RoboMME's interpreter, as `worker.py` does. Rendered images, states and statuses are the
same, bit for bit; a camera that is not rendered shows its last image.
"""

from collections.abc import Callable, Iterable
from typing import Any

CAMERAS = {"front": "base_camera", "wrist": "hand_camera"}
"""Camera to its name in RoboMME."""


class RenderOnDemand:
    """Patches ManiSkill to render only `cameras`, given by RoboMME's names; all at first.

    Where `needs_front` returns True, it also renders the front camera.
    """

    def __init__(self) -> None:
        from mani_skill.envs.sapien_env import BaseEnv

        self.cameras: Iterable[str] = CAMERAS.values()
        self.needs_front: Callable[[], bool] = bool
        self._last: dict[str, Any] = {}
        render_all = BaseEnv._get_obs_sensor_data

        def render(env: Any, *args: Any, **named: Any) -> dict[str, Any]:
            sensors = env._sensors
            if sensors.keys() <= self._last.keys():  # otherwise a camera has no last image yet
                wanted = {*self.cameras, *([CAMERAS["front"]] if self.needs_front() else [])}
                env._sensors = {name: one for name, one in sensors.items() if name in wanted}
            env.scene.sensors = env._sensors
            try:
                if env._sensors:
                    self._last |= render_all(env, *args, **named)
            finally:
                env._sensors = env.scene.sensors = sensors
            return dict(self._last)

        BaseEnv._get_obs_sensor_data = render

    def reset(self) -> None:
        """Forget the last images, before another environment is made."""
        self._last = {}

    def images(self, env: Any, cameras: Iterable[str]) -> dict[str, Any]:
        """Return the current images of some cameras, `(256, 256, 3) uint8` each."""
        if not cameras:
            return {}
        self.cameras = [CAMERAS[one] for one in cameras]
        data = env.unwrapped._get_obs_sensor_data()
        return {one: data[CAMERAS[one]]["rgb"][0].cpu().numpy() for one in cameras}
