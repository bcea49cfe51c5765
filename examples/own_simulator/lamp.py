"""A lamp shows a color; then it goes out, and one of four buttons is to be pressed.

`LampEnv` is an ordinary Gymnasium environment; `LampSimulator` makes a simulator of it, so that
buffers can be built from its episodes and policies evaluated on them.
"""

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.simulators import Demonstration, EpisodeInfo, Observation, Simulator
from robomme_interference_data.simulators.episode import EpisodeStart

SIDE, CUE, SPEED, REACH = 64, 10, 0.05, 0.12
COLORS = {
    "red": (220, 40, 40),
    "green": (40, 180, 60),
    "blue": (50, 80, 220),
    "gold": (230, 190, 30),
}
CORNERS = np.array([(0.15, 0.15), (0.85, 0.15), (0.85, 0.85), (0.15, 0.85)], np.float32)
GOALS = {
    "PressColor": "press the button of the color that the lamp showed",
    "PressOpposite": "press the button diagonally opposite of the color that the lamp showed",
}


class LampEnv(gymnasium.Env):  # type: ignore[type-arg]
    """A point moves in the unit square; for 10 steps first, a lamp in the middle shows a color."""

    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode of the family in `options`; return the position."""
        super().reset(seed=seed)
        self.order = self.np_random.permutation(len(COLORS))  # color of each corner's button
        self.shown = int(self.np_random.integers(len(COLORS)))
        at = int(np.flatnonzero(self.order == self.shown)[0])
        self.right = at if (options or {}).get("family") == "PressColor" else (at + 2) % 4
        self.position, self.steps = np.array([0.5, 0.7], np.float32), 0
        return self.position.copy(), {}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Move by up to 0.05 in x and y, if the lamp is out; the right button gives a reward."""
        self.steps += 1
        if self.steps > CUE:
            move = SPEED * np.clip(np.asarray(action, np.float32), -1, 1)
            self.position = np.clip(self.position + move, 0, 1)
        near = np.linalg.norm(CORNERS - self.position, axis=1) < REACH
        reward = float(near[self.right])
        return self.position.copy(), reward, bool(near.any()), self.steps >= CUE + 60, {}

    def render(self) -> NDArray[np.uint8]:  # type: ignore[override]
        """Return the view from above, `(64, 64, 3) uint8`."""
        image = np.full((SIDE, SIDE, 3), 200, np.uint8)
        y, x = np.mgrid[:SIDE, :SIDE]
        discs = [(corner, 6, color) for corner, color in zip(CORNERS, self.order, strict=True)]
        discs += [((0.5, 0.5), 8, self.shown)] if self.steps < CUE else []
        for (left, top), radius, color in discs:
            inside = (x - left * SIDE) ** 2 + (y - top * SIDE) ** 2 < radius**2
            image[inside] = [*COLORS.values()][color]
        left, top = self.position
        image[(x - left * SIDE) ** 2 + (y - top * SIDE) ** 2 < 9] = 0
        return image


class LampSimulator(Simulator):
    """Episodes of `LampEnv`: the phase with the lamp is the lesson, the rest is live."""

    name = "lamp"
    about = "lamp, an example of a benchmark of one's own"
    cameras = ("top",)
    action_size = 2
    settings: ClassVar[tuple[str, ...]] = ("cameras",)
    policies: ClassVar[tuple[str, ...]] = ("oracle", "guess")
    suite_version = 1

    def __init__(self, cameras: Sequence[str] = cameras):
        self._drawn = tuple(cameras)
        self._env = LampEnv()

    @classmethod
    def episodes(cls) -> list[EpisodeId]:
        """Return 7 train and 6 test episodes of each family."""
        counts = {"train": 7, "test": 6}
        return [EpisodeId(f, s, n) for f in GOALS for s in counts for n in range(counts[s])]

    def _act(
        self, policy: str, known: Mapping[int, str], answer: int | None
    ) -> NDArray[np.float32]:
        button = self._env.right if policy == "oracle" else self._guess
        return np.clip((CORNERS[button] - self._env.position) / SPEED, -1, 1)

    def _begin(self, episode: EpisodeId, frame_step: int) -> EpisodeStart:
        family = list(GOALS).index(episode.family)  # no scene occurs twice
        seed = 2000 * family + 1000 * (episode.split == "test") + episode.index
        state, _ = self._env.reset(seed=seed, options={"family": episode.family})
        self._guess = int(np.random.default_rng(seed).integers(len(CORNERS)))
        states, seen, still = [], [], np.zeros(2, np.float32)
        for step in range(CUE):
            states.append(state)
            if frame_step and step % frame_step == 0:
                seen.append(self._images())
            state, *_ = self._env.step(still)
        images = {camera: np.stack([one[camera] for one in seen]) for camera in self._drawn if seen}
        lesson = Demonstration(images, np.stack(states), np.tile(still, (CUE, 1)))
        info = EpisodeInfo((GOALS[episode.family],), None, seed, self.name)
        return lesson, Observation(self._images(), state), info

    def _execute(
        self, episode: EpisodeId, action: NDArray[np.float32], observe: bool
    ) -> tuple[Observation, Status]:
        state, reward, ended, late, _ = self._env.step(action)
        status = Status.SUCCESS if reward else Status.FAIL if ended else Status.ONGOING
        if late and not ended:
            status = Status.TIMEOUT
        return Observation(self._images() if observe else {}, state), status

    def _images(self) -> dict[str, NDArray[np.uint8]]:
        return {camera: self._env.render() for camera in self._drawn}
