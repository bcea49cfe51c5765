"""The embedded suite's judges, against scripts that solve tasks in the wrong way."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators import Status

pytest.importorskip("mani_skill", reason="needs the extra sim")

from robomme_interference_data.simulators.tabletop.bodies import CUBE
from robomme_interference_data.simulators.tabletop.env import TabletopEnv
from robomme_interference_data.simulators.tabletop.episodes import seed_of
from robomme_interference_data.simulators.tabletop.families.move_cube import MoveCube
from robomme_interference_data.simulators.tabletop.motion import Arm, Script
from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator

pytestmark = pytest.mark.slow


@pytest.fixture
def env(blind: TabletopSimulator) -> TabletopEnv:
    return blind.env


def start(env: TabletopEnv, episode: str, answer: int) -> Any:
    """Begin an episode with a given answer; return its scene."""
    about = EpisodeId.parse(episode)
    env.family = about.family
    env.reset(seed=seed_of(about), options={"answer": answer})
    env.arm.reset()
    return env.episode


def play(env: TabletopEnv, script: Script, seen: Callable[[], None] = lambda: None) -> Status:
    """Run a script until it or the episode ends."""
    for _ in script:
        env.step(env.arm.action.copy())
        if env.status is not Status.ONGOING:
            break
        seen()
    return env.status


def pixels_of(color: str, image: NDArray[np.uint8]) -> int:
    """Number of pixels in which one channel dominates."""
    channel = ("red", "green", "blue").index(color)
    others = np.delete(image.astype(int), channel, axis=2).max(axis=2)
    return int((image[..., channel].astype(int) - others > 50).sum())


def test_no_cube_is_seen_under_a_wrong_container_before_the_failure(env: TabletopEnv) -> None:
    scene = start(env, "VideoUnmask/test/0", 0)
    wrong = next(number for number in scene.under if number != env.answer[0])
    color = scene.colors[scene.cubes.index(scene.under[wrong])]
    heights, pixels = [], []

    def look() -> dict[str, NDArray[np.uint8]]:
        env.drawing = True
        images = env.observe().images
        env.drawing = False
        return images

    def note() -> None:
        if scene.shells[wrong].p[2] > 0.004:  # lifted at all
            images = look()
            pixels.append([pixels_of(color, images[name]) for name in ("front", "wrist")])
            heights.append(scene.shells[wrong].p[2])

    def lift_slowly() -> Script:
        knob = scene.shells[wrong].point(0, 0, scene.shells[wrong].size)
        yield from env.arm.pick(knob, lift=0.0)
        yield from env.arm.move(knob + np.array([0, 0, 0.05]), speed=0.03)

    assert play(env, lift_slowly(), note) is Status.FAIL
    assert len(heights) > 2
    assert max(heights) <= 0.010
    assert not np.any(pixels)
    scene.shells[wrong].put(scene.under[wrong].home)  # at 0.02 m, where the cube becomes visible
    assert pixels_of(color, look()["front"]) > 0


PUSH, GRASP = 0, 1


def push_slowly(arm: Arm, scene: MoveCube) -> Script:
    """Push the cube to the target with the closed gripper, 1.5 mm a step at most."""
    behind = scene.cube.p - 0.055 * scene.way
    yield from arm.move((behind[0], behind[1], 0.12), scene.turn)
    yield from arm.grip(close=True)
    yield from arm.move(behind)
    yield from arm.move(scene.target.p - 0.031 * scene.way + (0, 0, CUBE / 2), speed=0.025)
    yield from arm.wait(10)


def push_with_open_fingers(arm: Arm, scene: MoveCube) -> Script:
    """Push the cube with the outer side of an open finger."""
    behind = scene.cube.p - 0.11 * scene.way
    yield from arm.move((behind[0], behind[1], 0.12), scene.turn - np.pi / 2)
    yield from arm.move((behind[0], behind[1], 0.03))
    yield from arm.move(scene.target.p - 0.07 * scene.way + (0, 0, 0.03))


def drag_slowly(arm: Arm, scene: MoveCube) -> Script:
    """Grasp the cube and drag it, less than 1 mm in a step."""
    yield from arm.pick(scene.cube.p, scene.turn, lift=0.0)
    yield from arm.move(scene.target.p + np.array([0, 0, CUBE / 2]), speed=0.016)


def drop(arm: Arm, scene: MoveCube) -> Script:
    """Grasp the cube away from its middle, and release it above the target."""
    aside = 0.006 * np.array([-np.sin(scene.turn), np.cos(scene.turn), 0.0])
    yield from arm.pick(scene.cube.p + aside, scene.turn)
    yield from arm.put(scene.target.p + np.array([0, 0, CUBE / 2 + 0.012]))


slow = partial(pytest.param, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("way", "answer", "status"),
    [
        (push_with_open_fingers, PUSH, Status.FAIL),  # not one of the three manners
        (drop, GRASP, Status.SUCCESS),  # its fall and slide belong to the grasp
        slow(push_slowly, PUSH, Status.SUCCESS),  # at any speed
        slow(push_with_open_fingers, GRASP, Status.FAIL),
        slow(drag_slowly, PUSH, Status.FAIL),
    ],
)
def test_the_manner_is_what_moves_the_cube(
    env: TabletopEnv, way: Callable[[Arm, MoveCube], Script], answer: int, status: Status
) -> None:
    scene = start(env, "MoveCube/test/0", answer)
    cube = scene.cube.p
    assert play(env, way(env.arm, scene)) is status
    if way is drag_slowly:  # a wrong manner fails within millimeters
        assert np.linalg.norm(scene.cube.p - cube) < 0.004


@pytest.mark.parametrize(("height", "touches"), [(0.030, False), (0.015, False), (0.013, True)])
def test_a_button_is_touched_within_4_mm_of_its_top(
    env: TabletopEnv, height: float, touches: bool
) -> None:
    """Its top is at 0.010 m; a wrong button, so that touching it fails."""
    scene = start(env, "PatternLock/test/0", 0)
    spot = scene.spots[env.answer[1]]
    status = play(env, env.arm.move((*spot, height)))
    assert status is (Status.FAIL if touches else Status.ONGOING)
    assert env.arm.tip[2] > height - 0.001


@pytest.mark.parametrize(("aside", "status"), [(0.0, "fail"), (0.012, "fail"), (0.03, "ongoing")])
def test_a_stick_put_down_into_a_post_fails(env: TabletopEnv, aside: float, status: str) -> None:
    """A post's radius is 10 mm, the stick's 6 mm; this holds before the first target too."""
    scene = start(env, "RouteStick/test/0", 0)
    x, y = scene.posts[1]

    def come_down() -> Script:
        yield from env.arm.move((x + aside, y, 0.13))
        yield from env.arm.move((x + aside, y, 0.02))
        yield from env.arm.wait(3)

    assert play(env, come_down()) == status
