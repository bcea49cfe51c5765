"""FetchReach, with the interface of `RemoteSimulator`; needs Gymnasium-Robotics, not this package.

A marker shows a corner of a square around the gripper for ten steps; in each episode the square is
turned by another angle. Then the marker disappears, and the gripper is to reach that corner
(`ReachShown`) or the opposite one (`ReachOpposite`).
"""

import os

os.environ.setdefault("MUJOCO_GL", "egl")  # without a display; read when MuJoCo is imported

import gymnasium
import gymnasium_robotics
import numpy as np

gymnasium.register_envs(gymnasium_robotics)

CUE, STEPS = 10, 50  # steps
SIDE, REACH = 0.2, 0.04  # m
GOALS = {
    "ReachShown": "reach the corner that the marker showed",
    "ReachOpposite": "reach the corner diagonally opposite of the one that the marker showed",
}


class Episodes:
    """Runs one episode at a time; the phase with the marker is the lesson."""

    def __init__(self, cameras, size=96):
        self._cameras, self._size, self._env = cameras, size, None

    def reset(self, family, split, index, frame_step):
        """Show the marker; return the frames of that, and the first one without it."""
        self.close()  # a second reset of the same environment begins elsewhere
        self._env = gymnasium.make(
            "FetchReach-v4",
            max_episode_steps=CUE + STEPS,
            render_mode="rgb_array" if self._cameras else None,
            width=self._size,
            height=self._size,
        )
        seed = 2000 * list(GOALS).index(family) + 1000 * (split == "test") + index
        observed, _ = self._env.reset(seed=seed)
        random = np.random.default_rng(seed)
        shown, self._guess = random.integers(4, size=2)
        self._right = (shown + 2 * (family == "ReachOpposite")) % 4
        self._position = observed["achieved_goal"]
        angles = random.uniform(0, np.pi / 2) + np.pi / 2 * np.arange(4)
        square = np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1)
        self._corners = self._position + SIDE / np.sqrt(2) * square
        self._env.unwrapped.goal = self._corners[shown]  # where the marker is drawn
        states, frames, still = [], [], np.zeros(4, np.float32)
        for step in range(CUE):
            states.append(observed["observation"].astype(np.float32))
            if frame_step and step % frame_step == 0:
                frames.append(self._images())
            observed, *_ = self._env.step(still)
        self._env.unwrapped.model.site("target0").rgba[3] = 0  # the marker disappears
        frames.append(self._images())
        states.append(observed["observation"].astype(np.float32))
        images = {camera: [frame[camera] for frame in frames] for camera in self._cameras}
        facts = {"goals": [GOALS[family]], "seed": seed}
        return facts, {"states": states, "actions": [still] * CUE, **images}

    def step(self, action, observe):
        """Move the gripper; near the right corner it is a success, near another one a failure."""
        observed, _, _, late, _ = self._env.step(np.array(action, np.float32))
        self._position = observed["achieved_goal"]
        near = np.linalg.norm(self._corners - self._position, axis=1) < REACH
        status = "timeout" if late else "ongoing"
        if near.any():
            status = "success" if near[self._right] else "fail"
        images = {camera: [image] for camera, image in self._images().items()} if observe else {}
        state = observed["observation"].astype(np.float32)
        return {"status": status}, {"states": [state], **images}

    def act(self, policy, known, answer):
        """Return the next action of the script that knows the corner, or guesses one."""
        corner = self._right if policy == "oracle" else self._guess
        move = np.clip((self._corners[corner] - self._position) / 0.05, -1, 1)
        return {"action": [*move.tolist(), 0.0]}, {}

    def close(self):
        """End the episode."""
        if self._env is not None:
            self._env.close()
        self._env = None

    def _images(self):
        return {camera: self._env.render() for camera in self._cameras}
