"""The embedded suite: the same every time, solvable, fair, and not giving its answers away."""

import hashlib
import math
from collections.abc import Iterator
from itertools import combinations, product

import numpy as np
import pytest
from numpy.typing import NDArray

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    MotionError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators import Demonstration, Observation, Status
from robomme_interference_data.simulators.worker import RemoteSimulator

pytest.importorskip("mani_skill", reason="needs the extra sim")

from robomme_interference_data.simulators.tabletop.episodes import seed_of
from robomme_interference_data.simulators.tabletop.families import family_class
from robomme_interference_data.simulators.tabletop.simulator import TabletopSimulator

SHORT = "VideoUnmask/test/0"


@pytest.fixture(scope="module")
def simulator(tabletop: TabletopSimulator) -> TabletopSimulator:
    return tabletop


@pytest.fixture
def blind(simulator: TabletopSimulator) -> Iterator[TabletopSimulator]:
    """The simulator without drawing, which is several times as fast."""
    simulator._env.drawing = False
    yield simulator
    simulator._env.drawing = True


def digest(lesson: Demonstration, first: Observation) -> str:
    total = hashlib.sha256()
    for name in sorted(lesson.images):
        total.update(lesson.images[name].tobytes())
        total.update(first.images[name].tobytes())
    for array in (lesson.states, lesson.actions, first.state):
        total.update(array.tobytes())
    return total.hexdigest()


def test_reset_serves_what_it_says(simulator: TabletopSimulator) -> None:
    lesson, first, info = simulator.reset(SHORT)
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
    observation, status = simulator.step(simulator.act("oracle"))
    assert observation.images["front"].shape == (256, 256, 3)
    assert status is Status.ONGOING


def test_the_same_id_gives_the_same_bits_in_any_order_and_process(
    simulator: TabletopSimulator,
) -> None:
    once = digest(*simulator.reset(SHORT)[:2])
    simulator.reset("PatternLock/test/0")
    for _ in range(30):  # leave that episode in the middle
        simulator.step(simulator.act("guess"))
    assert digest(*simulator.reset(SHORT)[:2]) == once
    with RemoteSimulator("tabletop") as remote:
        assert digest(*remote.reset(SHORT)[:2]) == once


def test_the_same_actions_give_the_same_outcome(blind: TabletopSimulator) -> None:
    runs = []
    for _ in range(2):
        blind.reset("VideoPlaceOrder/test/0")
        states, status = [], Status.ONGOING
        while status is Status.ONGOING:
            seen, status = blind.step(blind.act("oracle"))
            states.append(seen.state)
        runs.append((np.stack(states), status))
    assert np.array_equal(runs[0][0], runs[1][0])
    assert runs[0][1] is runs[1][1] is Status.SUCCESS


def live(simulator: TabletopSimulator, episode: EpisodeId, answer: int) -> tuple[object, ...]:
    """Goal, first live frames and state of an episode with an answer of our choice."""
    env = simulator._env
    env.family, env.drawing = episode.family, False
    _, info = env.reset(seed=seed_of(episode), options={"answer": answer})
    env.drawing = True
    first = env.observe()
    return info["goals"], info["demonstration"].states, first


@pytest.mark.parametrize("family", FAMILIES)
def test_the_answer_is_not_in_the_goal_or_the_first_live_observation(
    simulator: TabletopSimulator, family: str
) -> None:
    episode = EpisodeId(family, "test", 2)  # a hard one
    goals, shown, first = live(simulator, episode, 0)
    other_goals, other_shown, other = live(simulator, episode, -1)
    assert goals == other_goals
    for name in first.images:
        assert np.array_equal(first.images[name], other.images[name])
    assert np.array_equal(first.state, other.state)
    if family not in ("VideoUnmask", "VideoUnmaskSwap"):  # there the arm shows nothing
        assert not np.array_equal(shown[: len(other_shown)], other_shown[: len(shown)])


@pytest.mark.parametrize("family", ["VideoUnmask", "VideoUnmaskSwap"])
def test_where_the_arm_rests_the_frames_show_the_answer(
    simulator: TabletopSimulator, family: str
) -> None:
    env, seen = simulator._env, []
    env.family = family
    for answer in (0, -1):
        _, info = env.reset(seed=seed_of(EpisodeId(family, "test", 0)), options={"answer": answer})
        seen.append(info["demonstration"].images["front"][0])
    assert not np.array_equal(*seen)


@pytest.mark.parametrize("family", FAMILIES)
def test_the_oracle_succeeds_and_every_other_answer_fails_at_once(
    blind: TabletopSimulator, family: str
) -> None:
    blind.reset(f"{family}/test/0")
    status, steps = Status.ONGOING, 0
    while status is Status.ONGOING:
        _, status = blind.step(blind.act("oracle"))
        steps += 1
    assert status is Status.SUCCESS
    env = blind._env
    wrong = [answer for answer in env.episode.answers if answer != env._answer]
    for answer in (wrong[0], wrong[-1]):
        blind.reset(f"{family}/test/0")
        env._guess, status, taken = answer, Status.ONGOING, 0
        while status is Status.ONGOING:
            _, status = blind.step(blind.act("guess"))
            taken += 1
        assert status is Status.FAIL
        assert taken < 2 * steps


def test_a_guess_does_not_depend_on_the_answer_and_is_fixed(blind: TabletopSimulator) -> None:
    env = blind._env
    env.family = "MoveCube"
    guesses = set()
    for answer in range(3):
        env.reset(seed=19803, options={"answer": answer})
        guesses.add(env._guess)
    assert len(guesses) == 1


def test_an_episode_times_out(blind: TabletopSimulator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robomme_interference_data.simulators.tabletop.simulator.MAX_STEPS", 3)
    _, first, _ = blind.reset(SHORT)
    hold = np.append(first.state[:7], 1).astype(np.float32)
    assert [blind.step(hold)[1] for _ in range(3)] == ["ongoing", "ongoing", "timeout"]


def test_bad_input_is_refused(blind: TabletopSimulator) -> None:
    with pytest.raises(InvalidIdError, match="MoveCube-test-3"):
        blind.reset("MoveCube-test-3")
    with pytest.raises(UnknownNameError, match="Did you mean 'MoveCube'"):
        blind.reset("MoveCub/test/3")
    blind.reset(SHORT)
    with pytest.raises(InvalidOptionError, match="8 finite numbers"):
        blind.step(np.zeros(7, np.float32))
    with pytest.raises(InvalidOptionError, match="8 finite numbers"):
        blind.step(np.full(8, np.nan, np.float32))
    with pytest.raises(UnknownNameError, match="Did you mean 'oracle'"):
        blind.act("orakle")


Steps = list[tuple[Observation, Status]]


def played(
    simulator: TabletopSimulator | RemoteSimulator, demonstration: bool, drawn: range
) -> tuple[Demonstration, Observation, Steps]:
    """An episode's demonstration, first observation and 20 steps; those in `drawn` are drawn."""
    lesson, first, _ = simulator.reset("MoveCube/test/0", demonstration=demonstration)
    steps = [simulator.step(simulator.act("oracle"), observe=n in drawn) for n in range(20)]
    return lesson, first, steps


def test_what_is_drawn_changes_nothing_else(simulator: TabletopSimulator) -> None:
    lesson, first, steps = played(simulator, True, range(20))
    assert set(lesson.images) == {"front", "wrist"}
    few = range(4, 20, 5)
    with (
        RemoteSimulator("tabletop", cameras=("front",)) as front,
        RemoteSimulator("tabletop", render=False) as blind,
    ):
        for other, demonstration, cameras in (
            (simulator, False, {"front", "wrist"}),
            (front, True, {"front"}),
            (blind, True, set[str]()),
        ):
            shown, start, made = played(other, demonstration, few)
            assert np.array_equal(shown.states, lesson.states)
            assert np.array_equal(shown.actions, lesson.actions)
            assert set(shown.images) == (cameras if demonstration else set())
            for name, frames in shown.images.items():
                assert np.array_equal(frames, lesson.images[name])
            assert set(start.images) == cameras
            assert [status for _, status in made] == [status for _, status in steps]
            assert [bool(seen.images) for seen, _ in made] == [
                bool(cameras) and number in few for number in range(20)
            ]
            pairs = zip(
                [start, *(s for s, _ in made)], [first, *(s for s, _ in steps)], strict=True
            )
            for seen, reference in pairs:
                assert np.array_equal(seen.state, reference.state)
                for name, image in seen.images.items():
                    assert np.array_equal(image, reference.images[name])


def test_an_unknown_camera_is_named() -> None:
    with pytest.raises(UnknownNameError, match="Did you mean 'front'"):
        TabletopSimulator(cameras=("fornt",))


def test_pictures_are_lit_by_the_scenes_own_lights(simulator: TabletopSimulator) -> None:
    """The table's colour by hand: ambient 0.45, two lights at their angles to the vertical."""
    _, first, _ = simulator.reset("PatternLock/test/0", demonstration=False)
    light = np.array([0.45] * 3)
    light += np.array([0.75, 0.75, 0.72]) / math.sqrt(0.5**2 + 0.4**2 + 1) / math.pi
    light += 0.6 * np.array([0.25, 0.25, 0.28]) / math.sqrt(0.4**2 + 0.7**2 + 0.6**2) / math.pi
    expected = (np.array([0.16, 0.34, 0.34]) * light) ** (1 / 2.2) * 255
    assert np.abs(first.images["front"][250, 5] - expected).max() < 1


def test_a_failed_reset_leaves_no_episode_to_step(blind: TabletopSimulator) -> None:
    for wrong in ("MoveCube/test/999", "MoveCub/test/0", "MoveCube-test-0"):
        blind.reset(SHORT)
        with pytest.raises((UnknownNameError, InvalidIdError)):
            blind.reset(wrong)
        with pytest.raises(SimulatorCrashError, match="no episode"):
            blind.step(np.zeros(8, np.float32))


def test_a_closed_simulator_refuses_all_but_close() -> None:
    closed = TabletopSimulator(render=False)
    closed.reset(SHORT)
    closed.close()
    closed.close()
    for call in (
        lambda: closed.reset(SHORT),
        lambda: closed.step(np.zeros(8, np.float32)),
        lambda: closed.act("oracle"),
        lambda: closed.chance,
    ):
        with pytest.raises(SimulatorCrashError, match="the simulator is closed"):
            call()


def test_motion_out_of_reach_is_an_error(blind: TabletopSimulator) -> None:
    blind.reset(SHORT)
    arm = blind._env.arm
    with pytest.raises(MotionError, match=r"gripper to .*: no solution"):
        list(arm.move((0.6, 0.0, 0.1)))
    arm.reset()
    with pytest.raises(MotionError, match=r"joint \d at its limit"):
        list(arm.move((-0.3, 0.28, 0.02), -math.pi / 2))


def first_views(simulator: TabletopSimulator, family: str) -> NDArray[np.int16]:
    """First live front views of two episodes of each difficulty, `(6, 256, 256, 3)`."""
    env, views = simulator._env, []
    env.family, env._demonstrating = family, False
    try:
        for index in (0, 1, 2, 27, 28, 29):
            env.reset(seed=seed_of(EpisodeId(family, "test", index)))
            views.append(env.observe(("front",)).images["front"])
    finally:
        env._demonstrating = True
    return np.stack(views).astype(np.int16)


TABLE = slice(155, None)
"""Rows of a first front view that show the table and what lies on it, but not the arm."""


def things(view: NDArray[np.int16]) -> NDArray[np.int16]:
    """What lies on the table, `(101, 256, 3)`; the table itself is black."""
    shown = view[TABLE].copy()
    shown[np.abs(shown - shown[-1, 0]).max(axis=2) < 6] = 0
    return shown


def test_no_two_families_could_be_mistaken_for_one_another(simulator: TabletopSimulator) -> None:
    """Tables differ in colour, and most of what lies on them even if they did not."""
    views = {family: first_views(simulator, family) for family in FAMILIES}
    for one, other in combinations(FAMILIES, 2):
        if {one, other} == {"VideoUnmask", "VideoUnmaskSwap"}:
            continue
        for a, b in product(views[one], views[other]):
            assert np.abs(a[-1, 0] - b[-1, 0]).max() > 12, (one, other)
            on_a, on_b = things(a), things(b)
            there = on_a.any(axis=2) | on_b.any(axis=2)
            assert there.sum() > 300
            assert (np.abs(on_a - on_b).max(axis=2)[there] > 40).mean() > 0.6, (one, other)


def test_first_views_without_a_demonstration_are_those_with_it(
    simulator: TabletopSimulator,
) -> None:
    """So that the comparison above compares what a policy sees."""
    for family in ("PatternLock", "MoveCube"):
        _, first, _ = simulator.reset(f"{family}/test/0", demonstration=False)
        assert np.array_equal(first_views(simulator, family)[0], first.images["front"])


@pytest.mark.parametrize("family", FAMILIES)
def test_scenes_do_not_depend_on_the_answer_and_differ_by_seed(family: str) -> None:
    made = family_class(family)
    one, same, other = (made("hard", np.random.RandomState(seed)) for seed in (5, 5, 6))
    assert list(one.answers) == list(same.answers)
    assert len(one.answers) > 2
    assert one.goals() == same.goals()
    places = [getattr(e, name) for e in (one, other) for name in vars(e) if "spots" in name]
    if places:
        assert places[0] != places[-1]


@pytest.mark.parametrize(
    "shortest", ["VideoUnmask/train/58", "MoveCube/train/68", "PatternLock/train/0"]
)
def test_the_shortest_episodes_are_long_enough_for_a_distractor_unit(
    blind: TabletopSimulator, shortest: str
) -> None:
    lesson, _, _ = blind.reset(shortest)
    steps, status = 0, Status.ONGOING
    while status is Status.ONGOING:
        _, status = blind.step(blind.act("oracle"))
        steps += 1
    assert status is Status.SUCCESS
    assert len(lesson) + steps >= 249


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_the_oracle_solves_test_episodes(family: str) -> None:
    """The last six of each family; all 450 are `robomme-interference simulate-score`'s."""
    from robomme_interference_data.simulators.score import play_all
    from robomme_interference_data.simulators.tabletop.episodes import episode_ids

    outcomes = list(play_all("oracle", episode_ids(family, "test")[-6:]))
    assert [o.status for o in outcomes] == [Status.SUCCESS] * 6, outcomes
    assert {o.difficulty for o in outcomes} == {"easy", "medium", "hard"}
