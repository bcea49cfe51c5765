"""Two arms: one with a gripper and a wrist camera, one with a stick."""

from pathlib import Path
from types import SimpleNamespace

from mani_skill import KIND

ASSETS = Path(__file__).parents[2] / "assets"


def camera(arm, side):
    mount = arm.robot.links_map["camera_link"]
    return SimpleNamespace(uid="hand_camera", width=side, height=side, mount=mount)


class Agent:
    def __init__(self, links):
        self.robot = SimpleNamespace(links_map={name: name for name in links})

    @property
    def _sensor_configs(self):
        return []


class PandaWristCam(Agent):
    urdf_path = str(ASSETS / "panda_v3.urdf")

    @property
    def _sensor_configs(self):
        if KIND == "strange":
            return []
        return [camera(self, 256 if KIND == "fork" else 128)]


class PandaStick(Agent):
    urdf_path = str(ASSETS / ("stick_of_the_fork.urdf" if KIND == "fork" else "panda_stick.urdf"))

    @property
    def _sensor_configs(self):
        return [camera(self, 256)] if KIND == "fork" else []
