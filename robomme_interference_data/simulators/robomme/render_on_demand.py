"""Draw only what somebody looks at: RoboMME draws both cameras at every step, most of its time.

Runs in RoboMME's own interpreter, as `worker.py` does. What is drawn, states and statuses
are the same, bit for bit; what is not drawn shows what was seen there last.
"""

from collections.abc import Iterable
from typing import Any

CAMERAS = {"front": "base_camera", "wrist": "hand_camera"}
"""Camera to its name in RoboMME."""


class Drawing:
    """Which cameras of ManiSkill's environments are drawn; all, until it is told which.

    Attributes:
        cameras: RoboMME's names of those that are drawn from now on.
    """

    def __init__(self) -> None:
        from mani_skill.envs.sapien_env import BaseEnv

        self.cameras: Iterable[str] = CAMERAS.values()
        self._seen: dict[str, Any] = {}
        self._draw = BaseEnv._get_obs_sensor_data
        drawing = self

        def look(self: Any, *args: Any, **named: Any) -> dict[str, Any]:
            return drawing._look(self, *args, **named)

        BaseEnv._get_obs_sensor_data = look

    def forget(self) -> None:
        """Forget what was seen: another environment comes."""
        self._seen = {}

    def see(self, env: Any, cameras: Iterable[str]) -> dict[str, Any]:
        """Return what some cameras of an environment see now, `(256, 256, 3) uint8` each."""
        if not cameras:
            return {}
        self.cameras = [CAMERAS[one] for one in cameras]
        seen = env.unwrapped._get_obs_sensor_data()
        return {one: seen[CAMERAS[one]]["rgb"][0].cpu().numpy() for one in cameras}

    def _look(self, env: Any, *args: Any, **named: Any) -> dict[str, Any]:
        sensors = env._sensors
        if sensors.keys() <= self._seen.keys():  # else there is nothing yet that could be shown
            env._sensors = {name: sensors[name] for name in self.cameras if name in sensors}
        env.scene.sensors = env._sensors
        try:
            if env._sensors:
                self._seen |= self._draw(env, *args, **named)
        finally:
            env._sensors = env.scene.sensors = sensors
        return dict(self._seen)
