"""What the embedded suite's cameras see: the whole arm, and nothing that goes out of sight."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.random import RandomState
from numpy.typing import NDArray

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.ids import EpisodeId

pytest.importorskip("mani_skill", reason="needs the extra sim")

from robomme_interference_data.simulators.tabletop.env import (
    FRONT_EYE,
    FRONT_TARGET,
    FRONT_VIEW,
    TabletopEnv,
)
from robomme_interference_data.simulators.tabletop.episodes import (
    difficulty_of,
    episode_ids,
    seed_of,
)
from robomme_interference_data.simulators.tabletop.families import family_class
from robomme_interference_data.simulators.tabletop.kit import CUBE
from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator
from robomme_interference_data.simulators.tabletop.stage import lanes

SIZE = 256


@pytest.fixture(scope="module")
def env(tabletop: TabletopSimulator) -> TabletopEnv:
    return tabletop._env


def seen_at(point: tuple[float, ...] | NDArray[np.float64]) -> tuple[float, float, float]:
    """Column and row of a point in the front image, and pixels per metre there."""
    ahead = np.subtract(FRONT_TARGET, FRONT_EYE)
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0, 0, 1))
    right /= np.linalg.norm(right)
    to = np.subtract(point, FRONT_EYE)
    scale = SIZE / 2 / math.tan(FRONT_VIEW / 2) / (to @ ahead)
    return SIZE / 2 + scale * (to @ right), SIZE / 2 - scale * (to @ np.cross(right, ahead)), scale


def in_view(point: tuple[float, ...] | NDArray[np.float64]) -> bool:
    column, row, _ = seen_at(point)
    return 0 < column < SIZE and 0 < row < SIZE


def test_the_camera_looks_at_its_target() -> None:
    """The middle of the image, and k / distance = 128 / tan 23° / |(1.1, 0, 0.43)| = 255.3."""
    assert seen_at(FRONT_TARGET) == pytest.approx((128, 128, 255.3), abs=0.1)


@pytest.mark.parametrize("family", FAMILIES)
def test_everything_on_the_table_is_in_view_and_large_enough(family: str) -> None:
    """All episodes: whatever lies there, and where it passes as places are exchanged."""
    for seed in map(seed_of, episode_ids(family)):
        scene: Any = family_class(family)(difficulty_of(seed), RandomState(seed))
        spots = [
            spot
            for name in ("spots", "posts", "target_spots", "cube_spots")
            for spot in getattr(scene, name, [])
        ]
        for name in ("button_at", "box_at", "cube_at", "target_at"):
            if hasattr(scene, name):
                spots.append(getattr(scene, name))
        row = getattr(scene, "target_spots", None) or getattr(scene, "spots", [])
        for pair in getattr(scene, "swaps", []):
            spots += [spot for way in lanes(row, pair, scene.gap) for spot in way]
        for x, y in spots:
            assert in_view((x, y, 0.0)), (seed, x, y)
            assert CUBE * seen_at((x, y, 0.0))[2] >= 10, (seed, x, y)


@pytest.mark.parametrize("family", ["MoveCube", "PatternLock"])
def test_the_arm_at_rest_is_in_view_from_its_foot_to_its_elbow_and_hand(
    env: TabletopEnv, family: str
) -> None:
    """With fingers, and with the stick; and it is drawn, in every row before the wall."""
    env.family, env._demonstrating = family, False
    try:
        env.reset(seed=seed_of(EpisodeId(family, "test", 0)))
    finally:
        env._demonstrating = True
    parts = {link.name.split("panda_")[-1]: link for link in env.agent.robot._objs[0].links}
    for name in ("link0", "link4", "link5", "link6", "link7", "hand"):
        assert in_view(np.asarray(parts[name].entity_pose.p, dtype=np.float64)), name
    front = env.observe(("front",)).images["front"].astype(int)
    arm = np.abs(front[:90] - front[0, 0]).max(axis=2) > 20
    assert arm.any(axis=1).all()
    assert arm.sum() > 2500


@pytest.mark.parametrize("index", [0, 1, 2], ids=["easy", "medium", "hard"])
def test_the_cube_is_in_sight_all_through_a_lesson_in_pushing(env: TabletopEnv, index: int) -> None:
    env.family = "MoveCube"
    seed = seed_of(EpisodeId("MoveCube", "test", index))
    _, info = env.reset(seed=seed, options={"answer": 0})
    assert env._answer == "push"
    pixels = np.stack([orange(info["demonstration"].images[name]) for name in ("front", "wrist")])
    assert pixels[0, 0] > 100  # on its own, more than 10 × 10
    gone = "".join("x" if none else "." for none in (pixels < 5).all(axis=0))
    assert "xxxxx" not in gone


def orange(frames: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Number of pixels of the cube's colour in each of `(T, 256, 256, 3)` frames."""
    red, green, blue = np.moveaxis(frames.astype(int), -1, 0)
    return np.asarray(((red - blue > 60) & (red - green > 40)).sum(axis=(1, 2)))
