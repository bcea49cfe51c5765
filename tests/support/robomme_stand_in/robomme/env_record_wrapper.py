"""RoboMME's interface without its physics: for the interpreter that the tests make.

Like the real one it returns lists, prints to stdout, in color, gives another episode at a second
reset of the same environment, makes environments of episodes that do not exist, and lets an episode
go on for one step more than `max_steps`. Between the frames of a demonstration that it keeps there
are frames that it drops.
"""

import os
import time
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
from mani_skill.agents.robots.panda import PandaStick, PandaWristCam
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.examples.motionplanning.panda.motionplanner_stick import (
    PandaStickMotionPlanningSolver,
)

time.sleep(float(os.environ.get("STAND_IN_IMPORT_SECONDS", "0")))

STICKS = ("PatternLock", "RouteStick")
ENDS = {45: "success", 46: "fail", 47: "timeout"}
open_environments = set()


class Environment(BaseEnv):
    def __init__(self, family, index, seed, max_steps):
        self.family, self.index, self.seed, self.max_steps = family, index, seed, max_steps
        self.resets = 0
        self.elapsed_steps = [0]
        kind = PandaStick if family in STICKS else PandaWristCam
        self.description = ElementTree.parse(kind.urdf_path).getroot()
        arm = kind([link.get("name") for link in self.description.iter("link")])
        sizes = {one.uid: one.width for one in arm._sensor_configs}
        assert sizes.keys() == {"hand_camera"}
        if index == 44:
            sizes["hand_camera"] = 512
        super().__init__({"base_camera": 256, **sizes})
        if family == "VideoRepick":
            self.current_subgoal_segment = "pick up the cube at <cube>"
            self.last_subgoal_segment = self.latched_replacements = None
        if family == "VideoUnmask" and index != 49:
            self._hide_a_cube()
        open_environments.add(self)

    def reset(self):
        for number in range(100):
            print(f"\x1b[33mWARN:\x1b[0m planner failure {number}")
        if self.index == 40:
            os._exit(7)
        if self.index == 42:
            raise RuntimeError("no Vulkan device")
        if self.family in STICKS:
            planner = PandaStickMotionPlanningSolver(
                self, vis=False, visualize_target_grasp_pose=False, joint_vel_limits=0.3
            )
            assert planner.settings == (self, False, True, 0.3)
        self.steps = 0
        shift = 50 * self.resets
        self.resets += 1
        frames = range(shift, shift + self.index % 40 + 2 + 1)
        # As on the real one: an arm without the camera's body sways otherwise.
        body = any(link.get("name") == "camera_link" for link in self.description.iter("link"))
        sway = 0 if body else 0.0007
        joints = [np.float32(t + sway + np.arange(7) / 8) for t in frames]
        if hasattr(self, "spawned_bins"):  # the real one steps itself while it demonstrates
            for t in frames:
                self.spawned_bins[0].pose.p[0][0] = 10 if t < 2 else 0
                self.current_task_index = int(t == frames[-1])
                self.elapsed_steps[0] = 2 * (t - shift) + 1
                self.step(None)
        steps = [2 * number + 1 for number in range(len(frames))]
        self.demonstration_data = (None, None, None, None, {"elapsed_steps": steps})
        lists = self._lists(frames, joints, [t / 100 for t in frames], steps)
        return lists, self._info("ongoing")

    def step(self, action):
        if action is None:
            return None
        print("step")
        if self.index == 41:
            time.sleep(60)
        self.steps += 1
        if self.family == "VideoRepick" and self.steps == 2:
            self.current_subgoal_segment = "put the cube at <place>"
        if self.index == 43 and self.steps == 2:
            info = {"status": "error", "error_message": "caught: no such joint"}
            return None, 0.0, True, False, info
        size = 7 if self.family in STICKS else 8
        action = np.asarray(action, np.float64).flatten()[:size]
        assert action.size == size
        status = "ongoing"
        if self.steps == 3:
            status = ENDS.get(self.index, status)
            if self.family == "VideoUnmask":
                status = "success" if action[0] == 1 else "fail"
        if self.steps > self.max_steps:
            status = "timeout"
        lists = self._lists([self.steps % 256], [np.float32(action[:7])], [(action[-1] + 1) / 50])
        if self.index == 48:
            lists["joint_state_list"][0][:2] = [*self.drawn.values()]
        return lists, 0.0, status != "ongoing", False, self._info(status)

    def _hide_a_cube(self):
        """Hide a cube under container 1 of 3; the last task is what the rollout has to do."""
        self.current_task_index = 0
        self.spawned_bins = [Thing(number) for number in range(3)]
        self.selected_bins, self.color_names = [self.spawned_bins[1]], ["red", "green"]
        names = ("static", "pick up the container that hides the red cube")
        self.task_list = [{"name": name, "demonstration": name == "static"} for name in names]
        self.agent = SimpleNamespace(robot=SimpleNamespace(pose="pose", qpos=[[0.5] * 9]))
        # Pixel (y, x) = (100 + 10 y, 100 + 10 x) of a thing at (x, y).
        intrinsic = np.array([[[10.0, 0, 100], [0, 10, 100], [0, 0, 1]]])
        extrinsic = np.array([[[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]]])
        sensor = Sensor(256)
        sensor.get_params = lambda: {"intrinsic_cv": intrinsic, "extrinsic_cv": extrinsic}
        self._sensors["base_camera"] = sensor

    def close(self):
        open_environments.remove(self)

    def _lists(self, frames, joints, grippers, steps=()):
        stick = self.family in STICKS
        seen = []
        for number, t in enumerate(frames):
            if steps:
                self.elapsed_steps[0] = steps[number] - 1
                self.current_task_name = "NO RECORD"
                self._shows = {"base_camera": 255, "hand_camera": 255}
                self._get_obs_sensor_data()
                self.elapsed_steps[0] = steps[number]
                self.current_task_name = "do it"
            self._shows = {"base_camera": t, "hand_camera": 100 + t % 100}
            seen.append(self._get_obs_sensor_data())
            self._locate(int(seen[-1]["base_camera"]["rgb"].numpy().flat[0]))
        return {
            "front_rgb_list": [one["base_camera"]["rgb"][0].numpy() for one in seen],
            "wrist_rgb_list": [one["hand_camera"]["rgb"][0].numpy() for one in seen],
            "joint_state_list": joints,
            "gripper_state_list": [
                np.float64([0 if stick else g, 0 if stick else -1]) for g in grippers
            ],
        }

    def _locate(self, place):
        """Find the place of a subgoal in the front view; some keep it until the subgoal changes."""
        if self.family == "VideoRepick":
            if self.current_subgoal_segment != self.last_subgoal_segment:
                self.last_subgoal_segment = self.current_subgoal_segment
                self.latched_replacements = [place]
            [place] = self.latched_replacements
        self.place = place

    def _info(self, status):
        goals = ["move the cube as before", "do it again, Schritt für Schritt"]
        if self.family == "RouteStick":
            goals = goals[0]
        if self.family == "VideoRepick":
            goals.append(f"open environments: {len(open_environments)}")
        info = {"task_goal": goals, "status": status}
        if self.family in STICKS:
            return info  # older ones provide no subgoals
        step = self.steps
        return info | {
            "simple_subgoal_online": f"pick up the cube, step {step}",
            "grounded_subgoal_online": f"pick up the cube at <{self.place}, 200>, step {step}",
        }


class Sensor(int):
    pass


class Thing:
    def __init__(self, number):
        self.number = number
        self.pose = SimpleNamespace(p=np.array([[float(number), 2.0 * number, 0.0]]))


class BenchmarkEnvBuilder:
    def __init__(self, env_id, dataset="test", action_space="joint_angle", max_steps=10000):
        assert action_space == "joint_angle"
        self.family, self.max_steps = env_id, max_steps
        rank = ("test", "val", "train").index(dataset)
        self.metadata_index = {
            (env_id, episode): {
                "seed": 640_000 + 1000 * rank + episode,
                "difficulty": ("easy", "medium", "hard")[episode % 3],
            }
            for episode in range(50)
        }

    @classmethod
    def get_task_list(cls):
        return ["MoveCube", "VideoRepick", "VideoUnmask", "PatternLock", "RouteStick", "BinFill"]

    def get_episode_num(self):
        return len(self.metadata_index)

    def resolve_episode(self, episode):
        found = self.metadata_index.get((self.family, episode), {})
        return found.get("seed"), found.get("difficulty")

    def make_env_for_episode(self, episode_idx):
        seed, _ = self.resolve_episode(episode_idx)
        return Environment(self.family, episode_idx, seed or 0, self.max_steps)
