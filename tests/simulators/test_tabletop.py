"""The embedded suite: deterministic, solvable, fair, and not revealing its answers."""

import math
import subprocess
import sys
from collections.abc import Iterator
from itertools import combinations, product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.families import families
from support.messages import raises

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import (
    InvalidOptionError,
    RunError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators import Demonstration, Observation, Status

pytest.importorskip("mani_skill", reason="needs the extra sim")

from robomme_interference_data.simulators.tabletop.env import TabletopEnv
from robomme_interference_data.simulators.tabletop.episodes import seed_of
from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator

SHORT = "VideoUnmask/test/0"


@pytest.fixture
def scene(tabletop: TabletopSimulator) -> Iterator[TabletopEnv]:
    """Its environment, which skips the demonstration."""
    tabletop.env.demonstrating = False
    yield tabletop.env
    tabletop.env.demonstrating = True


def reset(env: TabletopEnv, family: str, index: int, **options: int) -> dict[str, Any]:
    env.family = family
    _, info = env.reset(seed=seed_of(EpisodeId(family, "test", index)), options=options)
    return dict(info)


def play(env: TabletopEnv, policy: str) -> tuple[Status, NDArray[np.float32]]:
    """Run a built-in policy to the end; return the status, and all states."""
    states = []
    while env.status is Status.ONGOING:
        env.step(env.act(policy))
        states.append(env.arm.state)
    return env.status, np.stack(states)


def parts(lesson: Demonstration, first: Observation) -> list[NDArray[Any]]:
    images = [lesson.images[name] for name in sorted(lesson.images)]
    live = [first.images[name] for name in sorted(first.images)]
    return [*images, *live, lesson.states, lesson.actions, first.state]


# --- results -----------------------------------------------------------------------------------


@pytest.mark.slow
def test_reset_serves_what_it_says_the_same_each_time(tabletop: TabletopSimulator) -> None:
    lesson, first, info = tabletop.reset(SHORT)
    assert set(lesson.images) == set(first.images) == {"front", "wrist"}
    for name in ("front", "wrist"):
        assert lesson.images[name].shape == (len(lesson), 256, 256, 3)
        assert lesson.images[name].dtype == first.images[name].dtype == np.uint8
        assert first.images[name].shape == (256, 256, 3)
    assert lesson.states.shape == lesson.actions.shape == (len(lesson), 8)
    assert lesson.states.dtype == lesson.actions.dtype == first.state.dtype == np.float32
    assert (info.simulator, info.difficulty, info.seed) == ("tabletop", "easy", 13800)
    assert info.goals[0] == info.goal
    assert first.state[7] == pytest.approx(0.04)

    tabletop.reset("PatternLock/test/0", demonstration=False)
    for _ in range(30):  # leave this episode unfinished
        tabletop.step(tabletop.act("guess"), observe=False)
    again = tabletop.reset(SHORT)
    for one, other in zip(parts(lesson, first), parts(*again[:2]), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.slow
def test_every_fourth_frame_of_a_lesson(tabletop: TabletopSimulator) -> None:
    lesson, first, _ = tabletop.reset(SHORT)
    fewer, again, _ = tabletop.reset(SHORT, demonstration=4)
    for name, frames in lesson.images.items():
        assert np.array_equal(fewer.images[name], frames[::4])
        assert np.array_equal(first.images[name], again.images[name])
    assert np.array_equal(fewer.states, lesson.states)
    assert fewer.evidence == lesson.evidence


@pytest.mark.slow
@pytest.mark.usefixtures("tabletop")  # skips where nothing can be drawn
def test_another_process_gives_the_same_bits() -> None:
    code = (
        "import hashlib; from robomme_interference_data.simulators import make_simulator\n"
        f"lesson, first, _ = make_simulator('tabletop').reset({SHORT!r})\n"
        "for one in (lesson.images['wrist'], lesson.states, first.images['front'], first.state):\n"
        "    print(hashlib.sha256(one.tobytes()).hexdigest())\n"
    )
    command = [sys.executable, "-c", code]
    one, other = (subprocess.run(command, capture_output=True, check=True) for _ in range(2))
    assert one.stdout == other.stdout != b""


@pytest.mark.slow
def test_the_same_actions_have_the_same_outcome_whatever_is_drawn(
    tabletop: TabletopSimulator,
) -> None:
    def play_ten(
        simulator: TabletopSimulator, demonstration: bool, every: int
    ) -> tuple[Demonstration, list[Observation]]:
        lesson, first, _ = simulator.reset("MoveCube/test/0", demonstration)
        acted = ((simulator.act("oracle"), n % every == 0) for n in range(10))
        return lesson, [first, *(simulator.step(*one)[0] for one in acted)]

    lesson, steps = play_ten(tabletop, True, every=1)
    with TabletopSimulator(cameras=("front",)) as front, TabletopSimulator(cameras=()) as none:
        for other, demonstration, drawn in (
            (tabletop, False, {"front", "wrist"}),
            (front, True, {"front"}),
            (none, True, set()),
        ):
            shown, seen = play_ten(other, demonstration, every=5)
            assert np.array_equal(shown.states, lesson.states)
            assert np.array_equal(shown.actions, lesson.actions)
            assert set(shown.images) == (drawn if demonstration else set())
            assert all(np.array_equal(shown.images[n], lesson.images[n]) for n in shown.images)
            assert [n for n, one in enumerate(seen) if one.images] == ([0, 1, 6] if drawn else [])
            for one, full in zip(seen, steps, strict=True):
                assert set(one.images) in ({*()}, drawn)
                assert np.array_equal(one.state, full.state)
                assert all(np.array_equal(one.images[n], full.images[n]) for n in one.images)


def test_pictures_are_lit_by_the_scenes_own_lights(scene: TabletopEnv) -> None:
    """The table's color, computed from ambient light 0.45 and two lights at their angles."""
    reset(scene, "PatternLock", 0)
    light = np.array([0.45] * 3)
    light += np.array([0.75, 0.75, 0.72]) / math.sqrt(0.5**2 + 0.4**2 + 1) / math.pi
    light += 0.6 * np.array([0.25, 0.25, 0.28]) / math.sqrt(0.4**2 + 0.7**2 + 0.6**2) / math.pi
    expected = (np.array([0.16, 0.34, 0.34]) * light) ** (1 / 2.2) * 255
    assert np.abs(scene.observe(("front",)).images["front"][250, 5] - expected).max() < 1


# --- fairness -------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("index", [0, pytest.param(2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("family", families("VideoRepick", "VideoUnmask", "PatternLock"))
def test_an_answer_solves_its_scene_and_no_other_which_looks_the_same(
    blind: TabletopSimulator, family: str, index: int
) -> None:
    """Goal, first live state and frames are equal, bit for bit; a wrong answer fails."""
    env, seen, played = blind.env, [], []
    for answer, policy in ((0, "oracle"), (-1, "guess")):
        info = reset(env, family, index, answer=answer)
        env.drawing = True
        seen.append((info["goals"], info["demonstration"].states, env.observe()))
        env.drawing = False
        env.guess = env.episode.answers[0]
        played.append(play(env, policy))
    (goals, shown, first), (other_goals, other_shown, other) = seen
    assert goals == other_goals
    assert np.array_equal(first.state, other.state)
    assert all(np.array_equal(first.images[name], other.images[name]) for name in first.images)
    if family not in ("VideoUnmask", "VideoUnmaskSwap"):  # whose arm is still in the lesson
        assert not np.array_equal(shown[: len(other_shown)], other_shown[: len(shown)])
    (won, way), (lost, other_way) = played
    assert (won, lost) == (Status.SUCCESS, Status.FAIL)
    assert len(other_way) <= len(way)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_the_oracle_solves_test_episodes(blind: TabletopSimulator, family: str) -> None:
    """The last six of each family, two of each difficulty."""
    for index in range(44, 50):
        episode = f"{family}/test/{index}"
        blind.reset(episode)
        assert play(blind.env, "oracle")[0] is Status.SUCCESS, episode


@pytest.mark.slow
@pytest.mark.parametrize(
    "shortest", ["VideoUnmask/train/58", "MoveCube/train/68", "PatternLock/train/0"]
)
def test_the_shortest_episodes_are_long_enough_for_a_distractor_unit(
    blind: TabletopSimulator, shortest: str
) -> None:
    lesson, _, _ = blind.reset(shortest)
    status, states = play(blind.env, "oracle")
    assert status is Status.SUCCESS
    assert len(lesson) + len(states) >= 249


TABLE = slice(155, None)
"""Rows of a first front image that show the table, but not the arm."""


def things(view: NDArray[np.int16]) -> NDArray[np.int16]:
    """The things on the table, `(101, 256, 3)`; the table itself is black."""
    shown = view[TABLE].copy()
    shown[np.abs(shown - shown[-1, 0]).max(axis=2) < 6] = 0
    return shown


@pytest.mark.slow
def test_no_two_families_could_be_mistaken_for_one_another(scene: TabletopEnv) -> None:
    """Tables differ in color, and so do most things on them."""
    views: dict[str, list[Any]] = {}
    for family, index in product(FAMILIES, (0, 1, 2, 27, 28, 29)):
        reset(scene, family, index)
        front = scene.observe(("front",)).images["front"]
        views.setdefault(family, []).append(front.astype(np.int16))
    for one, other in combinations(FAMILIES, 2):
        if {one, other} == {"VideoUnmask", "VideoUnmaskSwap"}:
            continue
        for a, b in product(views[one], views[other]):
            assert np.abs(a[-1, 0] - b[-1, 0]).max() > 12, (one, other)
            on_a, on_b = things(a), things(b)
            there = on_a.any(axis=2) | on_b.any(axis=2)
            assert there.sum() > 300
            assert (np.abs(on_a - on_b).max(axis=2)[there] > 40).mean() > 0.6, (one, other)


@pytest.mark.slow
def test_the_cube_is_in_sight_all_through_a_lesson_in_pushing(tabletop: TabletopSimulator) -> None:
    tabletop.env.demonstrated = ("front", "wrist")
    lesson = reset(tabletop.env, "MoveCube", 0, answer=0)["demonstration"]
    assert tabletop.env.answer == "push"
    pixels = []
    for frames in lesson.images.values():
        red, green, blue = np.moveaxis(frames.astype(np.int16), -1, 0)
        pixels.append(((red - blue > 60) & (red - green > 40)).sum(axis=(1, 2)))
    assert pixels[0][0] > 100  # more than 10 × 10
    gone = "".join("x" if none else "." for none in (np.stack(pixels) < 5).all(axis=0))
    assert "xxxxx" not in gone


def test_motion_out_of_reach_is_an_error(scene: TabletopEnv) -> None:
    reset(scene, "VideoUnmask", 0)
    with raises(RunError):
        list(scene.arm.move((0.6, 0.0, 0.1)))
    scene.arm.reset()
    with raises(RunError):
        list(scene.arm.move((-0.3, 0.28, 0.02), -math.pi / 2))


@pytest.mark.slow
def test_invalid_input(blind: TabletopSimulator) -> None:
    blind.reset("PatternLock/test/0")
    with raises(UnknownNameError):
        blind.act("orakle")
    with pytest.raises(UnknownNameError):
        blind.reset("MoveCube/test/999")
    with raises(InvalidOptionError):
        blind.reset(SHORT, demonstration=-1)
    with raises(SimulatorCrashError):
        blind.act("oracle")
    with raises(InvalidOptionError):
        TabletopSimulator(cameras=("fornt",))
