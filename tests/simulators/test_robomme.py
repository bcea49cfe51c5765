"""The official simulator, with a stand-in for RoboMME in a separate environment."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from support.messages import raises
from support.worker_calls import wait_until_gone

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import (
    InvalidOptionError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.records import EvidenceSpan
from robomme_interference_data.schema.subgoal import Subgoal
from robomme_interference_data.simulators import Status
from robomme_interference_data.simulators.robomme.heldout import heldout_setup
from robomme_interference_data.simulators.robomme.render_on_demand import KeptFrames
from robomme_interference_data.simulators.robomme.simulator import EPISODES, RoboMMESimulator

HOLD = np.array([0, 0, 0, -1.5, 0, 1.5, 0.75, 1], np.float32)

LARGE_WRIST, DRAWN = 44, 48
"""Indices of the stand-in's episodes; the last one counts how often each camera was rendered."""


# --- results -----------------------------------------------------------------------------------


def test_an_episode_is_what_robomme_returns(simulator: RoboMMESimulator) -> None:
    lesson, first, info = simulator.reset("MoveCube/test/3")
    # The stand-in's demonstration has 5 frames for index 3 (3 + 2), then the live observation;
    # frame t of the front camera is all t, of the wrist camera all 100 + t.
    assert len(lesson) == 5
    for name, offset in (("front", 0), ("wrist", 100)):
        frames = lesson.images[name]
        assert (frames.shape, frames.dtype) == ((5, 256, 256, 3), np.uint8)
        assert frames[:, 7, 9, 1].tolist() == [offset + t for t in range(5)]
        assert first.images[name][0, 0].tolist() == [offset + 5] * 3
    # Joint j at frame t is t + j / 8; the first value of the gripper t / 100, the second −1.
    assert lesson.states.dtype == np.float32
    joints = np.arange(7) / 8
    assert lesson.states[2].tolist() == [*(2 + joints), pytest.approx(0.02, rel=1e-6)]
    assert lesson.actions.shape == (0, 8)
    assert first.state[:7].tolist() == [*(5 + joints)]
    assert info.goals == ("move the cube as before", "do it again, Schritt für Schritt")
    assert info.goal == info.goals[0]
    # One wording may come as a text instead of a list.
    assert simulator.reset("RouteStick/test/0")[2].goals == ("move the cube as before",)
    fewer, _, _ = simulator.reset("MoveCube/test/3", demonstration=2)
    assert fewer.images["front"][:, 0, 0, 0].tolist() == [0, 2, 4]
    assert np.array_equal(fewer.states, lesson.states)
    assert (info.difficulty, info.seed, info.simulator) == ("easy", 640_003, "robomme")
    # Seeds: 640000 + 1000 times the rank of test, val, train + index.
    seeds = [simulator.reset(f"MoveCube/{split}/1")[2].seed for split in ("val", "train")]
    assert seeds == [641_001, 642_001]


def test_held_out_episodes_are_made_from_their_published_seeds(simulator: RoboMMESimulator) -> None:
    # Of 50 episodes a family the first 10 are easy, 20 medium, 20 hard: MoveCube's begin with
    # seeds 2900001, 2900500, 2901000, 2901500; VideoUnmask's last one is 2105300.
    lesson, _, info = simulator.reset("MoveCube/heldout/3")
    assert (len(lesson), info.seed, info.difficulty) == (5, 2_901_500, "easy")
    lesson, _, info = simulator.reset("VideoUnmask/heldout/39")
    assert (len(lesson), info.difficulty) == (41, "hard")
    scene = RoboMMESimulator.scene("VideoUnmask", info.seed, info.difficulty, lesson.scene)
    assert scene is not None and len(scene.answers) == 3  # as of any other split
    assert simulator.act("oracle").shape == (8,)
    # The episode of the test split under the same index stays what it was.
    assert simulator.reset("MoveCube/test/3")[2].seed == 640_003
    for episode in ("MoveCube/heldout/50", "BinFill/heldout/0"):
        with raises(UnknownNameError):
            simulator.reset(episode)


def test_the_held_out_split_is_listed_with_its_source() -> None:
    held_out = [one for one in RoboMMESimulator.episodes() if one.split == "heldout"]
    assert [str(held_out[0]), str(held_out[-1])] == [
        "VideoRepick/heldout/0",
        "RouteStick/heldout/49",
    ]
    setups = [heldout_setup(episode) for episode in held_out]
    assert len({setup.seed for setup in setups if setup}) == len(FAMILIES) * 50
    assert setups[0] == (2_400_000, "easy") and setups[49] == (2_406_401, "hard")
    assert heldout_setup(EpisodeId("MoveCube", "test", 0)) is None


def test_a_step_executes_the_action(simulator: RoboMMESimulator) -> None:
    simulator.reset("MoveCube/test/0")
    action = np.linspace(-1, 1, 8, dtype=np.float32)
    seen, status = simulator.step(action)
    assert status is Status.ONGOING
    # The stand-in's arm is where it was sent, and its finger's way is (gripper + 1) / 50.
    assert seen.state[:7].tolist() == action[:7].tolist()
    assert seen.state[7] == pytest.approx(0.04)
    # The front camera shows the number of the step.
    assert [simulator.step(HOLD)[0].images["front"][0, 0, 0] for _ in range(3)] == [2, 3, 4]
    with raises(InvalidOptionError):
        simulator.step(HOLD[:7])
    assert simulator.step(HOLD)[0].images["front"][0, 0, 0] == 5  # that one did not reach it

    lesson, _, _ = simulator.reset("PatternLock/test/2")  # a stick has no gripper
    assert lesson.states[:, 7].tolist() == [0.0] * 4
    assert simulator.step(HOLD)[0].state.tolist() == [*HOLD[:7].tolist(), 0.0]


def play(simulator: RoboMMESimulator, episode: str) -> tuple[object, ...]:
    """Play an episode, and return all results."""
    lesson, first, info = simulator.reset(episode)
    seen = [first, *(simulator.step(HOLD)[0] for _ in range(2))]
    frames = [one.images[name].tobytes() for one in seen for name in ("front", "wrist")]
    states = [lesson.states.tobytes(), *(one.state.tobytes() for one in seen)]
    return (info, states, lesson.images["front"].tobytes(), frames)


def test_it_provides_robommes_subgoals(simulator: RoboMMESimulator) -> None:
    simulator.reset("MoveCube/test/3")
    assert simulator.subgoal() == Subgoal("pick up the cube at <point>, step 0", ((5, 200),))
    for _ in range(2):
        simulator.step(HOLD, observe=False)
    assert simulator.subgoal().grounded == "pick up the cube at <2, 200>, step 2"
    assert simulator.subgoal().simple == "pick up the cube, step 2"
    simulator.reset("PatternLock/test/3")
    with raises(UnknownNameError):
        simulator.subgoal()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cameras", "subgoals", "drawn"),
    [
        # The first picture of each camera, the first live observation, one of the two steps.
        (["front", "wrist"], False, [3, 3]),
        ([], False, [1, 1]),
        # All of the demonstration, 11 frames that are kept and 11 that are dropped, and both steps;
        # and once more the first live observation.
        (["front"], True, [25, 1]),
    ],
)
def test_only_requested_cameras_are_rendered(
    cameras: list[str], subgoals: bool, drawn: list[int], robomme_python: Path
) -> None:
    with RoboMMESimulator(robomme_python, cameras=cameras, subgoals=subgoals) as simulator:
        lesson, first, _ = simulator.reset(f"MoveCube/test/{DRAWN}", demonstration=False)
        assert (len(lesson.states), lesson.images) == (10, {})
        simulator.step(HOLD, observe=False)
        seen, _ = simulator.step(HOLD)
        assert seen.state[:2].tolist() == drawn
        values = {"front": (10, 2), "wrist": (110, 102)}  # in the first and in the last image
        for number, one in enumerate((first, seen)):
            assert sorted(one.images) == cameras
            assert all((one.images[name] == values[name][number]).all() for name in cameras)
        if not subgoals:
            with raises(InvalidOptionError):
                simulator.subgoal()
        else:
            assert simulator.subgoal().points == ((2, 200),)


def test_only_kept_frames_of_a_lesson_are_rendered(robomme_python: Path) -> None:
    with RoboMMESimulator(robomme_python, cameras=["front"], subgoals=False) as simulator:
        for every, shown, drawn in (
            # The first picture of all, 11 kept frames, once more the live observation, and a step.
            (1, [*range(10)], 14),
            # Of ten frames of the lesson 0, 4 and 8, the live observation, and a step.
            (4, [0, 4, 8], 5),
            # The first frame; the live observation as the eleventh, and once more; and a step.
            (10, [0], 4),
        ):
            lesson, first, _ = simulator.reset(f"MoveCube/test/{DRAWN}", demonstration=every)
            assert lesson.images["front"][:, 0, 0, 0].tolist() == shown
            assert (first.images["front"] == 10).all() and len(lesson.states) == 10
            seen, _ = simulator.step(HOLD)
            assert seen.state[0] == drawn


def test_a_demonstration_that_keeps_other_frames_is_an_error() -> None:
    environment = SimpleNamespace(elapsed_steps=[0], current_task_name="NO RECORD")
    kept = KeptFrames(environment, every=2)
    assert not kept()  # the observation of the reset
    drawn = []
    for step, name in enumerate(["NO RECORD", "go", "go", "NO RECORD", "go"], 1):
        environment.elapsed_steps, environment.current_task_name = [step], name
        drawn.append(kept())
    assert drawn == [False, True, False, False, True]
    kept.check([2, 3])
    kept.check([2, 3, 5])
    for others in ([2, 5], [1, 2, 3], [2, 3, 5, 6]):
        with raises(RuntimeError):
            kept.check(others)


def test_the_front_camera_is_drawn_until_a_subgoal_is_located(robomme_python: Path) -> None:
    with RoboMMESimulator(robomme_python, cameras=[]) as simulator:
        simulator.reset(f"VideoRepick/test/{DRAWN}", demonstration=False)
        points = [simulator.subgoal().points]
        for _ in range(3):
            seen, _ = simulator.step(HOLD)
            points.append(simulator.subgoal().points)
    # The first picture of all, and when each of the two subgoals begins, the second at step 2.
    assert seen.state[:2].tolist() == [3, 1]
    assert [one for ((one, _),) in points] == [0, 0, 2, 2]


@pytest.mark.slow
def test_a_process_plays_few_episodes_and_none_depends_on_it(simulator: RoboMMESimulator) -> None:
    # A second reset of one of the stand-in's environments would shift all frames.
    episodes = [f"MoveCube/test/{index}" for index in range(EPISODES + 1)]
    pids, results = [], []
    for episode in episodes:
        results.append(play(simulator, episode))
        assert simulator.pid is not None
        pids.append(simulator.pid)
    one, two = dict.fromkeys(pids)
    assert pids == [one] * EPISODES + [two]
    wait_until_gone([one], seconds=20)
    assert [play(simulator, episode) for episode in reversed(episodes)] == results[::-1]
    # The goal of this episode counts the environments that are open, itself included.
    assert simulator.reset("VideoRepick/test/0")[2].goals[-1] == "open environments: 1"


def test_unknown_robomme_names(simulator: RoboMMESimulator) -> None:
    # MoveCube has 50 test episodes; BinFill has no demonstration.
    for episode in ("MoveCube/test/50", "MoveQube/test/0", "BinFill/test/0"):
        with raises(UnknownNameError):
            simulator.reset(episode)
    simulator.reset("MoveCube/test/0")
    with raises(UnknownNameError):
        simulator.act("expert")
    with raises(InvalidOptionError):
        simulator.reset(f"MoveCube/test/{LARGE_WRIST}")
    assert len(simulator.reset("MoveCube/test/0")[0]) == 2


# --- other ManiSkill versions ---------------------------------------------------------------------


@pytest.mark.slow
def test_what_differs_from_the_fork_is_patched(
    robomme_python: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    results = []
    for kind in ("fork", "index", "index"):
        monkeypatch.setenv("STAND_IN_MANI_SKILL", kind)
        with RoboMMESimulator(robomme_python) as simulator:
            results.append(
                [play(simulator, f"{name}/test/3") for name in ("MoveCube", "RouteStick")]
            )
            patches = simulator.patches
            assert (patches == ()) == (kind == "fork")
    assert results[1] == results[2] == results[0]
    assert len(patches) == 4
    # The description of the arm is written once: the stick's own, and of the camera what hangs on
    # it, but for its color, which the fork leaves out too.
    [folder] = (tmp_path / "robomme-interference" / "robomme").iterdir()
    urdf, srdf = ((folder / f"panda_stick.{kind}").read_text() for kind in ("urdf", "srdf"))
    links = [one.get("name") for one in ElementTree.fromstring(urdf).iter("link")]
    assert sorted(links) == ["camera_base_link", "camera_link", "hand"]
    assert "aluminum" in urdf and "color" not in urdf and "finger" not in urdf + srdf
    pairs = ElementTree.fromstring(srdf).iter("disable_collisions")
    assert [(one.get("link1"), one.get("link2")) for one in pairs] == [("hand", "camera_link")]
    assert (folder / "meshes" / "camera.stl").read_text() == "solid\n"


# --- answers -------------------------------------------------------------------------------------


def act_out(simulator: RoboMMESimulator, policy: str, *known: Any, **answer: int) -> Status:
    status = Status.ONGOING
    while status is Status.ONGOING:
        _, status = simulator.step(simulator.act(policy, *known, **answer), observe=False)
    return status


def test_answers_are_acted_out_by_robommes_solvers(simulator: RoboMMESimulator) -> None:
    # The stand-in hides a red cube under container 1 of three, and shows it for two frames. Its
    # planner plans no screw motion, and reaches containers 0 and 1 by searching.
    lesson, _, _ = simulator.reset("VideoUnmask/test/3")
    text = "shows the red cube at place 1"
    assert lesson.evidence == (EvidenceSpan(0, text, 0, 2),)
    assert lesson.scene is not None
    scene = RoboMMESimulator.scene("VideoUnmask", 0, "easy", lesson.scene)
    assert scene is not None and scene.answers == [(0,), (1,), (2,)]
    assert scene.pixels(scene.option(1).marks) == ((120, 110),)
    # The solver searches a way with joint targets 1 and an open gripper, then closes it.
    assert simulator.act("oracle").tolist() == [1.0] * 8
    assert act_out(simulator, "oracle") is Status.SUCCESS
    for policy, known in (("guess", None), ("recall", None), ("recall", {0: text})):
        simulator.reset("VideoUnmask/test/3")
        answer = scene.recalled(known or {}, 640_003)
        if answer == (2,):
            with raises(SimulatorCrashError):
                simulator.act(policy, known)
        else:
            expected = Status.SUCCESS if answer == (1,) else Status.FAIL
            assert act_out(simulator, policy, known) is expected
    with raises(SimulatorCrashError):
        simulator.act("oracle")
    for answer, expected in ((0, Status.FAIL), (1, Status.SUCCESS)):
        simulator.reset("VideoUnmask/test/3")
        assert act_out(simulator, "answer", answer=answer) is expected
    simulator.reset("VideoUnmask/test/3")
    with raises(InvalidOptionError):
        simulator.act("answer", answer=3)


def test_a_solver_without_a_plan_is_an_error(simulator: RoboMMESimulator) -> None:
    seeds = {index: 640_000 + index for index in range(0, 39)}
    lesson, _, _ = simulator.reset("VideoUnmask/test/3")
    scene = RoboMMESimulator.scene("VideoUnmask", 0, "easy", lesson.scene)
    assert scene is not None
    index = next(one for one, seed in seeds.items() if scene.recalled({}, seed) == (2,))
    simulator.reset(f"VideoUnmask/test/{index}")
    pid = simulator.pid
    with raises(SimulatorCrashError):
        simulator.act("guess")
    simulator.reset("VideoUnmask/test/3")
    assert act_out(simulator, "oracle") is Status.SUCCESS
    assert simulator.pid == pid


def test_subgoals_are_followed(simulator: RoboMMESimulator) -> None:
    def follow(*subgoals: Subgoal | None) -> tuple[Status, list[float]]:
        simulator.reset("VideoUnmask/test/3")
        first, status = None, Status.ONGOING
        for step in range(10):
            action = simulator.follow_subgoal(subgoals[min(step, len(subgoals) - 1)])
            first = first or action.tolist()
            _, status = simulator.step(action, observe=False)
            if status is not Status.ONGOING:
                break
        assert first is not None
        return status, first

    # Container n is at (x, y) = (n, 2n), which is the pixel (100 + 20 n, 100 + 10 n).
    picked = {
        n: Subgoal("pick up the container at <point>", ((101 + 20 * n, 99 + 10 * n),))
        for n in range(2)
    }
    assert follow(picked[1])[0] is Status.SUCCESS
    assert follow(picked[0])[0] is Status.FAIL
    # Words that name no step change nothing: the arm holds its pose, or goes on.
    status, first = follow(Subgoal("look around", ()))
    assert (status, first) == (Status.FAIL, [0.5] * 7 + [1.0])
    assert follow(picked[1], Subgoal("look around", ()))[0] is Status.SUCCESS
    # A step is finished before the next one begins: the stand-in looks at the third action.
    assert follow(picked[0], picked[1])[0] is Status.FAIL
    assert follow(picked[1], None)[0] is Status.SUCCESS  # no new one: it goes on


def test_a_subgoal_without_a_point_draws(simulator: RoboMMESimulator) -> None:
    found = set()
    for index in (3, 3, 4, 5, 6, 7):
        simulator.reset(f"VideoUnmask/test/{index}")
        subgoal = Subgoal("pick up the container that hides the red cube", ())
        try:
            found.add((index, float(simulator.follow_subgoal(subgoal)[0])))
        except SimulatorCrashError:  # the planner does not reach container 2
            found.add((index, 2.0))
    assert len(found) == 5  # the same each time
    assert len({container for _, container in found}) > 1


def test_another_robomme_without_known_attributes(simulator: RoboMMESimulator) -> None:
    # Episodes still play; only what needs the answer is an error.
    for episode in ("VideoUnmask/test/49", "MoveCube/test/3"):
        lesson, _, _ = simulator.reset(episode)
        assert (lesson.evidence, lesson.scene) == (None, None)
        with raises(SimulatorCrashError):
            simulator.act("oracle")
