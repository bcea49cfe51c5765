"""What draws: each camera by itself, all of them whenever a picture is asked for."""

from types import SimpleNamespace

import numpy as np


class Tensor:
    def __init__(self, values):
        self.values = values

    def __getitem__(self, index):
        return Tensor(self.values[index])

    def cpu(self):
        return self

    def numpy(self):
        return self.values


class BaseEnv:
    """An environment: `_shows` maps its cameras to what they show, `drawn` counts pictures."""

    _render_device = "cpu"

    def __init__(self, sizes):
        self._sensors = dict(sizes)
        self.scene = SimpleNamespace(sensors=self._sensors)
        self._shows = dict.fromkeys(sizes, 0)
        self.drawn = dict.fromkeys(sizes, 0)

    @property
    def unwrapped(self):
        return self

    def _get_obs_sensor_data(self, apply_texture_transforms=True):
        for name in self._sensors:
            self.drawn[name] += 1
        return {
            name: {"rgb": Tensor(np.full((1, side, side, 3), self._shows[name], np.uint8))}
            for name, side in self.scene.sensors.items()
        }
