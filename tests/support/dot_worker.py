"""A dot that falls beside a wall, with the interface of `RemoteSimulator`: needs numpy only.

The dot moves by what it is told, in cells, and by one more cell down every second step, so that the
order of steps matters. The lesson is the way down from the top.
"""

import os
import sys

import numpy as np

DIES, RAISES, DARK = 41, 42, 43
"""Indices of episodes."""

SUCCESS = {"RightSide": 1.0, "LeftSide": -1.0}


class Episodes:
    def __init__(self, cameras, size=16, weight=1.0):
        if os.environ.get("DOT_NEEDS"):
            __import__(os.environ["DOT_NEEDS"])
        self.cameras, self.size, self.weight = cameras, size, weight
        self.resets = 0

    def reset(self, family, split, index, frame_step):
        sys.stdout.write("\x1b[33mfalling\x1b[0m\n")
        if index == DIES:
            os._exit(7)
        if index == DARK:
            raise RuntimeError("vk::createInstanceUnique: ErrorIncompatibleDriver")
        if index > DARK:
            return {"unknown": "there are 44 episodes"}, {}
        self.family, self.index, self.steps, self.resets = family, index, 0, self.resets + 1
        self.at = np.zeros(3, np.float32)
        states, images = [self.at.copy()], [self.draw()]
        for _ in range(3):
            self.move((0.0, 1.0))
            states.append(self.at.copy())
            images.append(self.draw())
        facts = {
            "goals": ["go to the side"],
            "seed": index + 100 * (split == "test") + 1000 * list(SUCCESS).index(family),
            "difficulty": "easy",
            "evidence": [{"part": 0, "text": "falls", "start": 1, "stop": 3}],
            "scene": "a wall",
        }
        actions = [np.array((0.0, 1.0), np.float32)] * 3
        kept = [*images[:3:frame_step], images[3]] if frame_step else images[3:]
        arrays = {"states": states, "actions": actions}
        return facts, {**arrays, **dict.fromkeys(self.cameras, kept)}

    def step(self, action, observe):
        if self.index == RAISES:
            raise ValueError("stuck in the wall")
        self.move(action)
        side = SUCCESS[self.family]
        status = "ongoing"
        if abs(self.at[0]) >= 3:
            status = "success" if self.at[0] * side > 0 else "fail"
        images = {camera: [self.draw()] for camera in self.cameras} if observe else {}
        return {"status": status}, {"states": [self.at.copy()], **images}

    def act(self, policy, known, answer):
        return {"action": [SUCCESS[self.family] * (1 if policy == "oracle" else -1), 0.0]}, {}

    def close(self):
        self.index = None

    def move(self, action):
        self.steps += 1
        fall = self.weight if self.steps % 2 else 0.0
        self.at += np.array((action[0], action[1] + fall, 1.0), np.float32)

    def draw(self):
        image = np.full((self.size, self.size, 3), 10 * self.index % 256, np.uint8)
        x, y = int(self.at[0]) + self.size // 2, int(self.at[1])
        image[y % self.size, x % self.size] = 255
        return image
