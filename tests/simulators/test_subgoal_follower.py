"""Subgoals on `tabletop`: providing them, following them, and points in the image."""

from collections.abc import Callable

import numpy as np
import pytest
from support.families import families

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.schema.shifts import parse_shift
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators.tabletop.camera import (
    FRONT_EYE,
    FRONT_TARGET,
    looking,
    to_pixels,
)

pytest.importorskip("mani_skill", reason="needs the extra sim")

from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator

pytestmark = pytest.mark.slow


def follow(
    simulator: TabletopSimulator,
    episode: str,
    edit: Callable[[Subgoal], Subgoal | None] = lambda subgoal: subgoal,
) -> tuple[Status, list[str]]:
    """Follow the edited subgoals of the simulator; return the status and the distinct texts."""
    simulator.reset(episode, demonstration=False)
    status, steps, texts = Status.ONGOING, 0, list[str]()
    while status is Status.ONGOING:
        if steps % 16 == 0:
            subgoal = edit(simulator.subgoal())
            text = subgoal.simple if subgoal else ""
            texts += [text] * (text not in texts[-1:])
        _, status = simulator.step(simulator.follow_subgoal(subgoal), observe=False)
        steps += 1
    return status, texts


@pytest.mark.parametrize("family", families("VideoUnmaskSwap", "InsertPeg"))
def test_following_its_subgoals_succeeds(blind: TabletopSimulator, family: str) -> None:
    """Hard episodes have all steps: two containers, swaps, the longest path."""
    assert follow(blind, f"{family}/test/2")[0] is Status.SUCCESS


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_following_its_subgoals_always_succeeds(blind: TabletopSimulator, family: str) -> None:
    for index in range(12):
        status, texts = follow(blind, f"{family}/val/{index}")
        assert status is Status.SUCCESS, (index, texts)


@pytest.mark.parametrize("family", families("MoveCube"))
def test_without_subgoals_it_acts_as_guess(blind: TabletopSimulator, family: str) -> None:
    actions = []
    for act in (lambda: blind.follow_subgoal(None), lambda: blind.act("guess")):
        blind.reset(f"{family}/test/1", demonstration=False)
        actions.append([])
        for _ in range(40):
            actions[-1].append(act())
            if blind.step(actions[-1][-1], observe=False)[1] is not Status.ONGOING:
                break
    assert np.array_equal(*map(np.stack, actions))


def test_similar_words_and_points_suffice(blind: TabletopSimulator) -> None:
    def vary(subgoal: Subgoal) -> Subgoal:
        text = subgoal.text.replace("pick up", "Pick up").replace(" the cube", " that cube") + "!"
        return Subgoal(text, tuple((y + 3, x - 4) for y, x in subgoal.points))

    assert follow(blind, "VideoRepick/test/0", vary)[0] is Status.SUCCESS


@pytest.mark.slow
def test_without_points_the_seed_decides(blind: TabletopSimulator) -> None:
    episodes = [f"VideoPlaceOrder/test/{index}" for index in range(8)]
    ends, again = (
        [follow(blind, episode, lambda one: Subgoal(one.simple))[0] for episode in episodes]
        for _ in range(2)
    )
    assert ends == again
    assert {*ends} == {Status.SUCCESS, Status.FAIL}  # of three to five targets


def test_an_unknown_subgoal_is_ignored(blind: TabletopSimulator) -> None:
    blind.reset("VideoUnmask/test/0", demonstration=False)
    home = blind.follow_subgoal(Subgoal("sing a song at <point>", ((3, 3),)))
    for _ in range(20):
        blind.step(home, observe=False)
        assert np.array_equal(blind.follow_subgoal(Subgoal("sing louder")), home)
    assert not np.array_equal(blind.follow_subgoal(blind.subgoal()), home)


def test_a_wrong_subgoal_is_followed(blind: TabletopSimulator) -> None:
    blind.reset("VideoUnmask/test/0", demonstration=False)
    scene = blind.env.episode
    [right] = blind.env.answer
    wrong = scene.step(((right + 1) % 3,), 0)
    subgoal = Subgoal(wrong.text, blind.env.to_pixels(wrong.at))
    status = Status.ONGOING
    while status is Status.ONGOING:
        _, status = blind.step(blind.follow_subgoal(subgoal), observe=False)
    assert status is Status.FAIL


@pytest.mark.parametrize("shift", [None, "camera:3"])
def test_the_projection_is_that_of_the_camera(
    tabletop: TabletopSimulator, shift: str | None
) -> None:
    tabletop.reset("VideoUnmask/test/1", demonstration=False)
    env = tabletop.env
    env.show(None if shift is None else parse_shift(shift))
    camera = env._camera("front")
    points = np.random.default_rng(0).uniform((-0.5, -0.3, 0), (0.1, 0.3, 0.3), (50, 3))
    seen = camera.get_extrinsic_matrix() @ np.c_[points, np.ones(50)].T
    columns, rows, depth = camera.get_intrinsic_matrix() @ seen
    expected = np.clip(np.floor(np.stack([rows / depth, columns / depth], 1)), 0, 255)
    found = np.array(env.to_pixels(points))
    assert np.abs(found - expected).max() <= 1  # a point may lie at a pixel's border
    assert (found == expected).mean() > 0.95
    unshifted = np.array(to_pixels(points, looking(FRONT_EYE, FRONT_TARGET)))
    assert (np.abs(found - unshifted).max() > 3) == (shift is not None)
    env.show(None)
