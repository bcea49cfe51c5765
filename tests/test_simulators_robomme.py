"""The official simulator's seam, against a stand-in for RoboMME in an environment of its own."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    MissingExtraError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.simulators import Status
from robomme_interference_data.simulators.robomme_client import EPISODES, RoboMMESimulator
from robomme_interference_data.simulators.worker import RemoteSimulator

HOLD = np.array([0, 0, 0, -1.5, 0, 1.5, 0.75, 1], np.float32)

DIES, HANGS, RAISES, BREAKS, SMALL_WRIST = 40, 41, 42, 43, 44
"""Indices of episodes that do so; those from 45 on end as `ENDS` says."""

ENDS = {45: Status.SUCCESS, 46: Status.FAIL, 47: Status.TIMEOUT}


@pytest.fixture
def python(robomme_python: Path) -> Path:
    return robomme_python


@pytest.fixture
def simulator(python: Path) -> Iterator[RoboMMESimulator]:
    with RoboMMESimulator(python) as made:
        yield made


def ended(pid: int, within: float = 20.0) -> bool:
    """Tell whether a process that is no child of ours ends in time."""
    limit = time.monotonic() + within
    while time.monotonic() < limit:
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


# --- what it serves ----------------------------------------------------------------------------


def test_an_episode_is_what_robomme_returns(simulator: RoboMMESimulator) -> None:
    lesson, first, info = simulator.reset("MoveCube/test/3")
    # The stand-in's demonstration has 5 frames for index 3 (3 + 2), then the live observation;
    # frame t of the front camera is all t, of the wrist camera all 100 + t.
    assert len(lesson) == 5
    assert {name: frames.shape for name, frames in lesson.images.items()} == {
        "front": (5, 256, 256, 3),
        "wrist": (5, 256, 256, 3),
    }
    assert lesson.images["front"].dtype == np.uint8
    assert lesson.images["front"][:, 7, 9, 1].tolist() == [0, 1, 2, 3, 4]
    assert lesson.images["wrist"][:, 7, 9, 1].tolist() == [100, 101, 102, 103, 104]
    # Joint j at frame t is t + j / 8; the first value of the gripper t / 100, the second −1.
    assert lesson.states.dtype == np.float32
    assert lesson.states[2].tolist() == [
        *(2 + joint / 8 for joint in range(7)),
        pytest.approx(0.02, rel=1e-6),
    ]
    assert lesson.actions.shape == (0, 8)
    assert first.images["front"][0, 0].tolist() == [5, 5, 5]
    assert first.images["wrist"][0, 0].tolist() == [105, 105, 105]
    assert first.state[:7].tolist() == [5 + joint / 8 for joint in range(7)]
    assert info.goals == ("move the cube as before", "do it again, Schritt für Schritt")
    assert info.goal == "move the cube as before"
    assert (info.difficulty, info.seed, info.simulator) == ("easy", 640_003, "robomme")


def test_splits_are_robommes_datasets(simulator: RoboMMESimulator) -> None:
    # The stand-in's seeds: 640000 + 1000 times the rank of test, val, train + index.
    seeds = [simulator.reset(f"MoveCube/{split}/1")[2].seed for split in ("test", "val", "train")]
    assert seeds == [640_001, 641_001, 642_001]


def test_the_same_episode_is_the_same_each_time(simulator: RoboMMESimulator) -> None:
    # A second reset of one of the stand-in's environments shifts all frames.
    first = simulator.reset("MoveCube/test/3")
    simulator.step(HOLD)
    again = simulator.reset("MoveCube/test/3")
    assert first[0].images["front"].tobytes() == again[0].images["front"].tobytes()
    assert first[0].states.tobytes() == again[0].states.tobytes()
    assert first[2] == again[2]


def told(simulator: RoboMMESimulator, episode: str) -> tuple[object, ...]:
    """Play an episode, and return all that came of it."""
    lesson, first, info = simulator.reset(episode)
    seen = [first, *(simulator.step(HOLD)[0] for _ in range(2))]
    frames = [one.images[name].tobytes() for one in seen for name in ("front", "wrist")]
    states = [one.state.tobytes() for one in seen]
    images = [lesson.images[name].tobytes() for name in ("front", "wrist")]
    return (info, lesson.states.tobytes(), images, frames, states)


def test_a_worker_plays_few_episodes(simulator: RoboMMESimulator) -> None:
    # More than twice as many as a worker plays, each with its steps in the middle.
    episodes = [f"MoveCube/test/{index}" for index in range(2 * EPISODES + 1)]
    pids, results = [], []
    for episode in episodes:
        results.append(told(simulator, episode))
        assert simulator.pid is not None
        pids.append(simulator.pid)
    one, two, three = dict.fromkeys(pids)
    assert pids == [one] * EPISODES + [two] * EPISODES + [three]
    assert ended(one) and ended(two)
    # The same from workers that have played other episodes before, or none.
    again = [told(simulator, episode) for episode in reversed(episodes)]
    assert again == results[::-1]


def test_a_new_worker_that_does_not_start(
    simulator: RoboMMESimulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(EPISODES):
        simulator.reset("MoveCube/test/0")
    with monkeypatch.context() as without:
        without.delenv("PYTHONPATH")
        with pytest.raises(MissingExtraError, match="robomme is not installed there"):
            simulator.reset("MoveCube/test/3")
        assert simulator.pid is None
    assert len(simulator.reset("MoveCube/test/3")[0]) == 5


def test_environments_are_closed(simulator: RoboMMESimulator) -> None:
    simulator.reset("MoveCube/test/0")
    simulator.reset("MoveCube/test/1")
    with pytest.raises(UnknownNameError):
        simulator.reset("MoveCube/test/50")
    # The goal of this episode counts the environments that are open, itself included.
    assert simulator.reset("VideoRepick/test/0")[2].goals[-1] == "open environments: 1"


def test_a_step_executes_the_action(simulator: RoboMMESimulator) -> None:
    simulator.reset("MoveCube/test/0")
    action = np.linspace(-1, 1, 8, dtype=np.float32)
    seen, status = simulator.step(action)
    assert status is Status.ONGOING
    # The stand-in's arm is where it was sent, and its finger's way is (gripper + 1) / 50.
    assert seen.state[:7].tolist() == action[:7].tolist()
    assert seen.state[7] == pytest.approx(0.04)
    assert seen.images["front"].shape == (256, 256, 3)
    # The front camera shows the number of the step.
    assert [simulator.step(HOLD)[0].images["front"][0, 0, 0] for _ in range(3)] == [2, 3, 4]


def test_a_stick_has_no_gripper(simulator: RoboMMESimulator) -> None:
    lesson, _, _ = simulator.reset("PatternLock/test/2")
    assert lesson.states[:, 7].tolist() == [0.0] * 4
    seen, _ = simulator.step(HOLD)
    assert seen.state.tolist() == [*HOLD[:7].tolist(), 0.0]


def test_images_are_left_out_where_not_wanted(python: Path) -> None:
    with RoboMMESimulator(python, cameras=["front"]) as simulator:
        lesson, first, _ = simulator.reset("MoveCube/test/0")
        assert list(lesson.images) == list(first.images) == ["front"]
        lesson, first, _ = simulator.reset("MoveCube/test/3", demonstration=False)
        assert lesson.images == {}
        assert lesson.states.shape == (5, 8)
        assert first.images["front"][0, 0, 0] == 5
        seen, _ = simulator.step(HOLD, observe=False)
        assert seen.images == {}
        assert seen.state.shape == (8,)


@pytest.mark.parametrize("index", ENDS)
def test_robommes_statuses(simulator: RoboMMESimulator, index: int) -> None:
    simulator.reset(f"MoveCube/test/{index}")
    statuses = [simulator.step(HOLD, observe=False)[1] for _ in range(3)]
    assert statuses == [Status.ONGOING, Status.ONGOING, ENDS[index]]
    with pytest.raises(SimulatorCrashError, match="runs no episode"):
        simulator.step(HOLD)


def test_an_episode_ends_after_1300_steps(simulator: RoboMMESimulator) -> None:
    # RoboMME goes on for one more, and so does the stand-in.
    simulator.reset("MoveCube/test/0")
    statuses = [simulator.step(HOLD, observe=False)[1] for _ in range(1300)]
    assert statuses == [Status.ONGOING] * 1299 + [Status.TIMEOUT]


def test_there_is_no_built_in_policy(simulator: RoboMMESimulator) -> None:
    with pytest.raises(UnknownNameError, match="no built-in policy 'oracle'"):
        simulator.act("oracle")


def test_it_runs_in_a_worker_process_too(python: Path) -> None:
    with RemoteSimulator("robomme", python=str(python)) as remote:
        lesson, _, info = remote.reset("RouteStick/val/1")
        assert (len(lesson), info.simulator) == (3, "robomme")
        assert remote.step(HOLD)[1] is Status.ONGOING


# --- what it refuses ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("episode", "error", "message"),
    [
        ("MoveCube/test/50", UnknownNameError, "MoveCube has 50 test episodes"),
        ("MoveQube/test/0", UnknownNameError, "Did you mean 'MoveCube'"),
        ("MoveCube/tests/0", InvalidIdError, "not a split"),
        ("MoveCube", InvalidIdError, "not an episode id"),
    ],
)
def test_unknown_episodes(
    simulator: RoboMMESimulator, episode: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        simulator.reset(episode)
    assert len(simulator.reset("MoveCube/test/0")[0]) == 2


@pytest.mark.parametrize("action", [np.zeros(7), np.zeros((1, 8)), [np.nan] * 8, [np.inf] * 8])
def test_bad_actions_do_not_reach_robomme(simulator: RoboMMESimulator, action: object) -> None:
    simulator.reset("MoveCube/test/0")
    with pytest.raises(InvalidOptionError, match="8 finite numbers"):
        simulator.step(np.asarray(action, np.float32))
    assert simulator.step(HOLD)[0].images["front"][0, 0, 0] == 1  # still the first step


def test_there_must_be_an_episode(simulator: RoboMMESimulator) -> None:
    with pytest.raises(SimulatorCrashError, match="runs no episode"):
        simulator.step(HOLD)
    simulator.close()
    with pytest.raises(SimulatorCrashError, match="closed"):
        simulator.reset("MoveCube/test/0")


def test_a_refused_episode_leaves_none_to_step(simulator: RoboMMESimulator) -> None:
    for refused in ("MoveCub/test/0", "MoveCube-test-0"):
        simulator.reset("MoveCube/test/0")
        with pytest.raises((UnknownNameError, InvalidIdError)):
            simulator.reset(refused)
        with pytest.raises(SimulatorCrashError, match="no episode"):
            simulator.step(HOLD)


def test_unknown_cameras(python: Path) -> None:
    with pytest.raises(UnknownNameError, match="'wrist'"):
        RoboMMESimulator(python, cameras=["wirst"])


def test_images_of_another_size(simulator: RoboMMESimulator) -> None:
    with pytest.raises(InvalidOptionError, match=r"wrist camera .* \(128, 128, 3\) uint8; exp"):
        simulator.reset(f"MoveCube/test/{SMALL_WRIST}")


# --- what breaks -------------------------------------------------------------------------------


def test_a_death_shows_the_end_of_its_log(simulator: RoboMMESimulator) -> None:
    with pytest.raises(SimulatorCrashError) as caught:
        simulator.reset(f"MoveCube/test/{DIES}")
    assert "died during reset, exit code 7" in caught.value.message
    assert caught.value.hint is not None
    lines = caught.value.hint.splitlines()
    # 20 lines at most, the last ones.
    assert (lines[0], len(lines), lines[-1]) == ("It printed last:", 21, "planner failure 99")
    assert simulator.pid is None
    assert len(simulator.reset("MoveCube/test/0")[0]) == 2


def test_a_worker_killed_between_steps(simulator: RoboMMESimulator) -> None:
    simulator.reset("MoveCube/test/3")
    assert simulator.pid is not None
    os.kill(simulator.pid, signal.SIGKILL)
    with pytest.raises(SimulatorCrashError, match=r"died during step, exit code -9 \(MoveCube/tes"):
        simulator.step(HOLD)
    with pytest.raises(SimulatorCrashError, match="runs no episode"):
        simulator.step(HOLD)
    assert len(simulator.reset("MoveCube/test/0")[0]) == 2


def test_a_hang_is_ended(python: Path) -> None:
    with RoboMMESimulator(python, reset_s=30, step_s=3) as simulator:
        simulator.reset(f"MoveCube/test/{HANGS}")
        pid = simulator.pid
        assert pid is not None
        with pytest.raises(SimulatorCrashError, match="took more than 3 s to step"):
            simulator.step(HOLD)
        assert ended(pid)
        assert simulator.pid is None


def test_an_exception_in_a_reset(simulator: RoboMMESimulator) -> None:
    with pytest.raises(SimulatorCrashError, match="failed during reset: RuntimeError: no Vulkan"):
        simulator.reset(f"MoveCube/test/{RAISES}")
    pid = simulator.pid
    assert len(simulator.reset("MoveCube/test/0")[0]) == 2
    assert simulator.pid == pid


def test_robommes_own_error_status(simulator: RoboMMESimulator) -> None:
    simulator.reset(f"MoveCube/test/{BREAKS}")
    simulator.step(HOLD)
    with pytest.raises(SimulatorCrashError, match="reports an error at step 2: caught: no such jo"):
        simulator.step(HOLD)
    with pytest.raises(SimulatorCrashError, match="runs no episode"):
        simulator.step(HOLD)


def test_the_worker_ends_with_us_even_in_a_long_call(python: Path) -> None:
    code = f"""
        import threading, time
        from robomme_interference_data.simulators.robomme_client import RoboMMESimulator
        simulator = RoboMMESimulator({str(python)!r})
        simulator.reset("MoveCube/test/{HANGS}")
        print(simulator.pid, flush=True)
        import numpy as np
        simulator.step(np.zeros(8, np.float32))
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        time.sleep(0.5)
        parent.kill()
    assert ended(pid)
