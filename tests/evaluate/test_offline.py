"""Offline evaluation: the policy acts along a recording, and its actions are compared."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.buffer_sets import build, plan_again
from support.made_up import MadeUpSource
from support.messages import raises

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.sources import Frame
from robomme_interference_data.errors import (
    HashMismatchError,
    InterferenceError,
    InvalidOptionError,
    PolicyError,
)
from robomme_interference_data.evaluate import Policy, RolloutInfo, RunConfig, run_evaluation
from robomme_interference_data.evaluate.rollout.rollout import run_rollout
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.progress import error_table
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.simulators import recordings
from robomme_interference_data.simulators.recordings import Recordings

DRAWER, CUPS = "OpenDrawer/test/0", "StackCups/test/0"
QUERIES = {DRAWER: (25, 5), CUPS: (7, 5)}
UNITS = {"OpenDrawer/train/0": (249, None), "StackCups/train/0": (249, None)}


class Arm(MadeUpSource):
    """Frame n has a state of two values, and the action (n, 2n, 0)."""

    def frame(self, name: str, number: int, *rest: Any) -> Frame:
        made = super().frame(name, number, *rest)
        action = np.array([number, 2 * number, 0], np.float32)
        return Frame(made.images, made.state[:2], action, made.is_demonstration)


def buffer_set(root: Path, source: type[MadeUpSource] = MadeUpSource, **executions: Any) -> Path:
    build(root, "demonstrations", source(QUERIES))
    build(root, "distractors", source(UNITS))
    build(root, "executions", source(QUERIES), **executions)
    plan_again(root, ("no-history", "k0", "k1"))
    return root


@pytest.fixture(scope="module")
def buffers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Frame n has a state of eight n, and an action of eight −n."""
    return buffer_set(tmp_path_factory.mktemp("offline"))


class Constant(Policy):
    """Returns the same actions, and keeps the first state value of all that it is given."""

    cameras = history_cameras = ("front",)

    def __init__(self, actions: Any, every_frame: bool = False):
        self.actions, self.every_frame = actions, every_frame
        self.info: RolloutInfo | None = None
        self.history: list[float] = []
        self.live: list[list[float]] = []

    def reset(self, info: RolloutInfo) -> None:
        self.info = info

    def add_history(self, frames: Any, states: Any, exec_start_idx: int) -> None:
        self.history += states[:, 0].tolist()

    def observe(self, frames: Any, states: Any) -> None:
        assert len(frames["front"]) == len(states)
        self.live.append(states[:, 0].tolist())

    def act(self, observation: Any, goal: str) -> Any:
        assert observation.state[0] == self.live[-1][-1] and goal == f"do {DRAWER}"
        return self.actions

    def metadata(self) -> dict[str, Any]:
        return {}


def walk(root: Path, policy: Policy, condition: str = "k1") -> Rollout:
    opened = load_buffer_set(root)
    config = RunConfig(policy="mine", buffer_set=str(root), out=Path("nowhere"), offline=True)
    return run_rollout(
        RunContext(config, "mine", SystemFacts(), opened.name, opened.revision),
        WorkItem(condition, EpisodeId.parse(DRAWER)),
        simulator=Recordings(str(root), policy.cameras),
        policy=policy,
        buffer_set=opened,
    )


def test_actions_are_compared_along_the_recording(buffers: Path) -> None:
    """Its 20 live frames, 5 to 24, have actions of −5 to −24: zeros are 14.5 away on average."""
    policy = Constant(np.zeros((16, 8), np.float32))
    row = walk(buffers, policy)
    assert (row.status, row.success, row.steps) == ("measured", None, 20)
    assert row.action_l1 == 14.5
    assert row.action_l1_values == " ".join(["14.500000000"] * 8)
    assert (row.history_frames, row.lesson_frames, row.seed, row.goal) == (37, 5, 7, f"do {DRAWER}")
    assert policy.info == RolloutInfo(f"do {DRAWER}", 37, 0)
    assert policy.history == [*range(5), *range(0, 249, 8)]
    assert policy.live == [[5], [21]]


@pytest.mark.parametrize(
    ("chunk", "every_frame", "live"),
    [
        (20, True, [[5], [*range(6, 22)]]),  # at most 16 actions are executed
        (6, False, [[5], [11], [17], [23]]),
        (6, True, [[5], [*range(6, 12)], [*range(12, 18)], [*range(18, 24)]]),
        (1, False, [[number] for number in range(5, 25)]),
    ],
)
def test_observations_come_as_in_a_rollout(
    buffers: Path, chunk: int, every_frame: bool, live: list[list[float]]
) -> None:
    policy = Constant(np.full((chunk, 8), -5.0), every_frame)
    assert walk(buffers, policy, "no-history").action_l1 == 9.5
    assert (policy.live, policy.history) == (live, [])


def test_recorded_images_are_shown(buffers: Path) -> None:
    simulator, frames = Recordings(str(buffers), ["front"]), MadeUpSource(QUERIES)
    lesson, seen, info = simulator.reset(DRAWER)
    assert (len(lesson), info.seed, info.difficulty) == (5, 7, "easy")
    for number in range(5, 25):
        expected = frames.frame(DRAWER, number, 5)
        assert np.array_equal(seen.images["front"], expected.images["front"])
        assert np.array_equal(seen.state, expected.state)
        assert expected.action is not None
        seen, status = simulator.step(expected.action)
    assert (status, simulator.columns()["action_l1"]) == ("measured", 0.0)
    simulator.reset(CUPS)  # again from its beginning
    assert simulator.step(np.full(8, -6.0))[1] == "ongoing"
    assert simulator.step(np.full(8, -6.0))[1] == "measured"
    assert simulator.columns()["action_l1"] == 0.5


def test_damaged_recordings_are_an_error(buffers: Path, tmp_path: Path) -> None:
    """The video of another recording, of the same length."""
    root = Path(shutil.copytree(buffers, tmp_path / "damaged"))
    other = tmp_path / "other"
    build(other, "executions", MadeUpSource({"OpenDrawer/test/1": (25, 5)}))
    [video] = other.rglob("*.mp4")
    made = load_buffer_set(root).datasets["executions"]
    index = made.index_of(EpisodeId.parse(DRAWER))
    shutil.copyfile(video, root / "executions" / made.files_of(index, ["front"])[1])
    with raises(HashMismatchError):
        walk(root, Constant(np.zeros((16, 8))))


def test_long_recordings_end_like_rollouts(buffers: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recordings, "MAX_STEPS", 10)
    row = walk(buffers, Constant(np.zeros((16, 8))))
    assert (row.status, row.steps, row.action_l1) == ("measured", 10, 9.5)


def test_robots_with_other_actions(tmp_path: Path) -> None:
    """Over n from 5 to 24: |1 − n| is 13.5 on average, |1 − 2n| is 28, and |1 − 0| is 1."""
    root = buffer_set(tmp_path, Arm)
    row = walk(root, Constant(np.ones((4, 3))))
    assert row.action_l1_values == "13.500000000 28.000000000 1.000000000"
    assert row.action_l1 == round(42.5 / 3, 9)
    with raises(PolicyError):
        walk(root, Constant(np.ones((4, 8))))


@pytest.fixture(scope="module")
def arms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of a family and one of another, of an arm with two states and three values.

    The action of frame n is (n, 2n, 0); live are frames 5 to 24, 5 to 6, and 5 to 9.
    """
    root = tmp_path_factory.mktemp("arms")
    queries = {DRAWER: (25, 5), "OpenDrawer/test/1": (7, 5), CUPS: (10, 5)}
    build(root, "demonstrations", Arm(queries))
    build(root, "distractors", Arm(UNITS))
    build(root, "executions", Arm(queries))
    plan_again(root, ("no-history", "k0"))
    return root


def baseline(root: Path, out: Path, policy: str, **changes: Any) -> dict[str, list[float]]:
    """The error of each value of the action, by episode."""
    changes = {"policy": policy, "conditions": ()} | changes
    done = evaluate(root, out, **changes)
    assert {row.condition for row in done.rows} == {"no-history"}
    return {
        str(row.episode_id): [float(one) for one in (row.action_l1_values or "").split()]
        for row in done.rows
    }


def test_the_mean_baseline_is_the_mean_of_other_episodes(arms: Path, tmp_path: Path) -> None:
    found = baseline(arms, tmp_path / "run", "mean")
    # Of the family, the other episode: frames 5 and 6, with the mean 5.5; 5 to 24, with 14.5.
    assert found[DRAWER] == pytest.approx([np.mean(np.abs(np.arange(5, 25) - 5.5)), 18.1, 0])
    assert found["OpenDrawer/test/1"] == pytest.approx([9, 18, 0])
    # The family has no other: all 22 frames of the other two, with the mean (290 + 11) / 22.
    assert found[CUPS][0] == pytest.approx(301 / 22 - 7)


def test_the_hold_baseline_repeats_the_last_recorded_action(arms: Path, tmp_path: Path) -> None:
    """After the first step, which is the mean (5.5): 5 for frames 6 to 21, then 21 for 22 to 24."""
    found = baseline(arms, tmp_path / "run", "hold")
    assert found[DRAWER][0] == pytest.approx((0.5 + sum(range(1, 17)) + 1 + 2 + 3) / 20)
    options = {"policy_options": ("chunk=1",)}
    found = baseline(arms, tmp_path / "single", "hold", **options)
    assert found[DRAWER][0] == pytest.approx((0.5 + 19) / 20)
    names = {row.system for folder in ("run", "single") for row in read_rows([tmp_path / folder])}
    assert names == {"hold", "hold-chunk1"}


def test_one_recording_has_no_mean_of_others(tmp_path: Path) -> None:
    root = buffer_set(tmp_path / "one", Arm, families=("OpenDrawer",))
    done = evaluate(root, tmp_path / "run", policy="mean", conditions=(), families=("OpenDrawer",))
    assert "only recording" in (done.rows[0].error or "")


@pytest.mark.parametrize("actions", [np.full((16, 8), np.nan), np.zeros((16, 7)), None])
def test_actions_that_cannot_be_compared(buffers: Path, actions: Any) -> None:
    with raises(PolicyError):
        walk(buffers, Constant(actions))


def evaluate(root: Path, out: Path, **changes: Any) -> Any:
    settings: dict[str, Any] = {"policy": "noop", "conditions": ("no-history", "k0")}
    config = RunConfig(buffer_set=str(root), out=out, offline=True, **settings | changes)
    return run_evaluation(config, executor=Serial())


def test_a_run_resumes(buffers: Path, tmp_path: Path) -> None:
    first = evaluate(buffers, tmp_path, conditions=("k0",))
    assert first.counts == {"success": 0, "fail": 0, "timeout": 0, "error": 0, "measured": 2}
    whole = evaluate(buffers, tmp_path, conditions=("no-history", "k0"))
    assert whole.counts["measured"] == whole.planned == 4
    assert {row.simulator for row in whole.rows} == {"recordings"}
    assert [row for row in whole.rows if row.condition == "k0"] == list(first.rows)


@pytest.mark.parametrize(
    "changes",
    [
        {"policy": "oracle"},
        {"policy": "follow-subgoals"},
        {"policy": "hold", "offline": False},
        {"policy": "mean", "conditions": ("k0",)},
        {"policy": "hold", "policy_options": ("chunk=17",)},
        {"simulator": "robomme"},
        {"shift": "light:1"},
        {"videos": True},
        {"check_lesson": True},
        {"subgoals": "oracle"},
        {"offline": False, "simulator": "recordings"},
    ],
)
def test_settings_that_do_not_fit(buffers: Path, tmp_path: Path, changes: dict[str, Any]) -> None:
    usual: dict[str, Any] = {"policy": "noop", "offline": True}
    config = RunConfig(buffer_set=str(buffers), out=tmp_path / "run", **usual | changes)
    with raises(InterferenceError):
        run_evaluation(config, executor=Serial())
    assert not (tmp_path / "run").exists()


def test_a_policy_of_another_robot_is_refused_with_those_that_fit(
    arms: Path, tmp_path: Path
) -> None:
    with pytest.raises(InterferenceError) as raised:
        evaluate(arms, tmp_path / "run", policy="replay", conditions=("k0",))
    assert isinstance(raised.value, InvalidOptionError)
    assert raised.value.hint is not None
    assert all(policy in raised.value.hint for policy in ("hold", "mean", "python:"))
    words = (raised.value.command or "").split()
    assert words == f"evaluate {arms} --offline --policy hold --out {tmp_path / 'run'}".split()


@pytest.mark.parametrize("conditions", [(), ("k0",)])
def test_a_baseline_needs_the_condition_without_history(
    arms: Path, tmp_path: Path, conditions: tuple[str, ...]
) -> None:
    root = Path(shutil.copytree(arms, tmp_path / "arms"))
    plan_again(root, ("k0",))
    with raises(InvalidOptionError) as raised:
        evaluate(root, tmp_path / "run", policy="hold", conditions=conditions)
    planning = f"build {root} --only manifests --conditions no-history"
    assert raised.value.command == planning


def test_buffer_sets_without_executions(tmp_path: Path, own_buffers: Path) -> None:
    with raises(InterferenceError):
        evaluate(own_buffers, tmp_path / "run")
    root = buffer_set(tmp_path / "some", families=("OpenDrawer",))
    with raises(InterferenceError):
        evaluate(root, tmp_path / "run")
    assert evaluate(root, tmp_path / "run", families=("OpenDrawer",)).planned == 2


@pytest.mark.slow
def test_the_command(buffers: Path, tmp_path: Path, run: Callable[..., Any]) -> None:
    """Holding the first live state (5) is 19.5 from −5 to −24; 10.5 from −5 and −6."""
    words = ("--policy", "noop", "--offline", "--conditions", "no-history", "--workers", "1")
    code, out, err = run("evaluate", buffers, *words, "--out", tmp_path / "run")
    assert code == 0, err
    lines = [line.split() for line in out.splitlines() if line]
    assert ["family", "no-history"] in lines
    assert [one for one in lines if one[0] in ("OpenDrawer", "StackCups", "all")]
    code, _, err = run("score", tmp_path / "run", "--out", tmp_path / "score")
    assert code == 0, err
    assert (tmp_path / "score/tables/action_error.csv").is_file()


def test_recordings_on_which_a_policy_breaks_are_counted(
    buffers: Path, tmp_path: Path, run: Callable[..., Any]
) -> None:
    policy = "python:support.own_policies:Choosy"
    done = evaluate(buffers, tmp_path / "run", policy=policy, conditions=("k0",))
    assert (done.counts["measured"], done.counts["error"]) == (1, 1)
    [(_, shown), (_, broken), (_, both)] = error_table(done.rows).rows
    assert (broken, both) == ("1 broke", f"{shown}, 1 broke")
    code, text, err = run("score", tmp_path / "run", "--out", tmp_path / "score")
    assert code == 0, err
    assert f"{shown}† n=1, errors: 1" in text
