"""A shift changes the images of the live scene, and nothing else."""

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.families import families
from support.messages import raises

from robomme_interference_data.errors import SimulatorCrashError, UnknownNameError
from robomme_interference_data.schema.shifts import KINDS, SHIFTS, Shift
from robomme_interference_data.simulators import Status

pytest.importorskip("mani_skill", reason="needs the extra sim")

from robomme_interference_data.simulators.episode import Observation
from robomme_interference_data.simulators.tabletop.drawing import PANDA
from robomme_interference_data.simulators.tabletop.scene_shift import POSITIONS, TALL, WIDE
from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator

EPISODE = "MoveCube/test/2"


@pytest.fixture
def shifted(tabletop: TabletopSimulator) -> Any:
    """The simulator; its shift is reset after the test."""
    yield tabletop
    tabletop.env.shift = None


def begin(simulator: TabletopSimulator, episode: str, shift: Shift | None) -> Observation:
    simulator.env.shift = shift
    return simulator.reset(episode, demonstration=False)[1]


def apart(one: Observation, other: Observation, camera: str) -> float:
    """Mean difference of two images, 0 to 255."""
    first, second = (seen.images[camera].astype(int) for seen in (one, other))
    return float(np.abs(first - second).mean())


@pytest.mark.slow
def test_each_shift_is_seen_and_the_stronger_the_more(shifted: TabletopSimulator) -> None:
    plain = begin(shifted, EPISODE, None)
    views = dict(zip(SHIFTS, shifted.views(SHIFTS), strict=True))
    for kind in KINDS:
        weak, middle, strong = (apart(plain, views[Shift(kind, n)], "front") for n in (1, 2, 3))
        assert 0.4 < weak < middle < strong
        # The wrist camera does not see clutter at the sides of the table.
        seen = apart(plain, views[Shift(kind, 1)], "wrist")
        assert seen == 0 if kind == "clutter" else seen > 1
    for seen in views.values():
        assert np.array_equal(seen.state, plain.state)
    again = shifted.env.observe()
    assert all(np.array_equal(again.images[name], plain.images[name]) for name in plain.images)


@pytest.mark.slow
def test_a_shift_comes_after_the_demonstration_and_is_the_episodes_own(
    shifted: TabletopSimulator,
) -> None:
    shift = Shift("camera", 3)
    plain = shifted.reset(EPISODE)
    [looked] = shifted.views([shift])
    shifted.env.shift = shift
    lesson, first, about = shifted.reset(EPISODE)
    assert about == plain[2]
    for name, frames in plain[0].images.items():
        assert np.array_equal(lesson.images[name], frames)
        assert np.array_equal(first.images[name], looked.images[name])
    other = begin(shifted, "MoveCube/test/5", shift)
    [moved] = shifted.views([Shift("camera", 1)])
    assert apart(other, first, "front") > 1 and apart(other, moved, "front") > 0.4
    # The next episode without a shift is unchanged.
    assert apart(begin(shifted, EPISODE, None), plain[1], "front") == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "kinds", [("clutter",), pytest.param(("light", "camera"), marks=pytest.mark.slow)]
)
def test_the_scene_stays_under_a_shift_while_it_is_played(
    shifted: TabletopSimulator, kinds: tuple[str, ...]
) -> None:
    played: list[list[NDArray[np.float32]]] = []
    for shift in (None, *(Shift(kind, 3) for kind in kinds)):
        begin(shifted, EPISODE, shift)
        states, status = [], Status.ONGOING
        while status is Status.ONGOING:
            seen, status = shifted.step(shifted.act("oracle"), observe=False)
            states.append(seen.state)
        assert status is Status.SUCCESS
        played.append(states)
    for states in played[1:]:
        assert np.array_equal(states, played[0])


@pytest.mark.slow
@pytest.mark.parametrize("family", families("VideoPlaceOrder"))
def test_clutter_is_out_of_the_way(blind: TabletopSimulator, family: str) -> None:
    """No part of the hand, and no body on the table, reaches a position of clutter."""
    blind.reset(f"{family}/test/2", demonstration=False)
    robot = blind.env.agent.robot._objs[0]
    names = [f"scene-0-{PANDA}_panda_{name}" for name in ("hand", "leftfinger", "rightfinger")]
    parts = [link for link in robot.links if link.name in names]
    assert len(parts) == 3
    rigid = [one._rigid for one in blind.env.builder.bodies if one._rigid is not None]  # no table
    parts += [one for one in rigid if one.collision_shapes]
    status, steps = Status.ONGOING, 0
    while status is Status.ONGOING:
        _, status = blind.step(blind.act("oracle"), observe=False)
        steps += 1
        spans = [part.compute_global_aabb_tight() for part in parts if steps % 4 == 0]
        for low, high in spans:
            for x, y in POSITIONS:
                if low[2] < TALL and high[2] > 0:
                    way = np.maximum(0, np.maximum(low[:2] - (x, y), (x, y) - high[:2]))
                    assert math.hypot(*way) > WIDE
    assert status is Status.SUCCESS


def test_views_need_a_running_episode(shifted: TabletopSimulator) -> None:
    with pytest.raises(UnknownNameError):
        shifted.reset("MoveCube/test/99")
    with raises(SimulatorCrashError):
        list(shifted.views(SHIFTS))
