"""Common to all simulators: names, actions, episodes, and the command `simulate`."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from support.messages import raises
from support.simulator_doubles import ENDLESS, UNKNOWN, Double

from robomme_interference_data.errors import (
    InvalidIdError,
    InvalidOptionError,
    MissingExtraError,
    SimulatorCrashError,
    UnknownNameError,
)
from robomme_interference_data.simulators import Status, make_simulator
from robomme_interference_data.simulators.episode import action_array

DOUBLE = "support.simulator_doubles:make"
ACTION = np.zeros(8, np.float32)


@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("tabeltop", UnknownNameError),
        ("no_such_module:make", InvalidOptionError),
        ("support.simulator_doubles:nothing", UnknownNameError),
    ],
)
def test_an_unknown_simulator_is_named(name: str, error: type[Exception]) -> None:
    with raises(error):
        make_simulator(name)


def test_a_missing_extra_names_the_line_to_type(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if ".tabletop." in name and "episodes" not in name]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "sapien", None)
    with raises(MissingExtraError):
        make_simulator("tabletop")


@pytest.mark.parametrize("dtype", ["float32", "float64", "int64", "uint8"])
def test_actions_are_numbers_of_any_type(dtype: str) -> None:
    one = action_array(np.arange(8, dtype=dtype))
    assert (one.dtype, one.tolist()) == (np.float32, list(range(8)))
    several = action_array(np.ones((2, 8), dtype), chunk=True)
    assert (several.dtype, several.shape) == (np.float32, (2, 8))


@pytest.mark.parametrize(
    ("given", "chunk"),
    [
        *((one, False) for one in (["1"] * 8, [[1.0], [1.0, 2.0]], None, [0] * 7, [[0] * 8])),
        ([0] * 7 + [np.nan], False),
        *((np.zeros(shape), True) for shape in ((8,), (0, 8), (2, 7), (1, 2, 8))),
        (np.full((1, 8), 1e300), True),
    ],
)
def test_invalid_actions(given: Any, chunk: bool) -> None:
    expected = r"expected \(n, 8\) actions" if chunk else r"expected \(8,\) action"
    with pytest.raises(InvalidOptionError, match=expected):
        action_array(given, chunk=chunk)


@pytest.mark.parametrize(
    ("given", "size", "fault"),
    [
        (np.zeros((3, 11)), 10, "shape (3, 11), 11 values as in a state"),
        (np.zeros((3, 9)), 10, "shape (3, 9)"),
        (np.zeros((3, 10), bool), 10, "dtype bool"),
        (np.where(np.arange(20).reshape(2, 10) > 16, np.nan, 0), 10, "nan at (1, 7), the first of"),
        ([[1.0], [1.0, 2.0]], 10, "rows of several lengths"),
    ],
)
def test_an_error_about_actions_says_what_is_wrong(given: Any, size: int, fault: str) -> None:
    """It shows no array."""
    with pytest.raises(InvalidOptionError) as raised:
        action_array(given, chunk=True, size=size, state_size=11)
    assert raised.value.message.startswith(f"got {fault}")
    assert "[" not in raised.value.message


def test_an_episode_runs_until_it_ends() -> None:
    with Double() as simulator:
        simulator.reset("MoveCube/test/9")
        with pytest.raises(InvalidOptionError):
            simulator.step(np.zeros(7, np.float32))  # changes nothing
        statuses = [simulator.step(simulator.act("oracle"))[1] for _ in range(3)]
        assert statuses == [Status.ONGOING, Status.ONGOING, Status.SUCCESS]
        with raises(SimulatorCrashError):
            simulator.step(ACTION)


def test_an_episode_ends_after_1300_steps() -> None:
    with Double() as simulator:
        simulator.reset(f"MoveCube/test/{ENDLESS}")
        statuses = [simulator.step(ACTION)[1] for _ in range(1300)]
    assert statuses == [Status.ONGOING] * 1299 + [Status.TIMEOUT]


def test_no_episode_runs_after_a_failed_reset() -> None:
    simulator = Double()
    for refused in ("MoveCube-test-0", "MoveCube/tests/0", f"MoveCube/test/{UNKNOWN}"):
        simulator.reset("MoveCube/test/0")
        with pytest.raises((InvalidIdError, UnknownNameError)):
            simulator.reset(refused)
        with raises(SimulatorCrashError):
            simulator.step(ACTION)


def test_closed_simulator() -> None:
    simulator = Double()
    simulator.reset("MoveCube/test/0")
    simulator.close()
    simulator.close()
    for call in (lambda: simulator.reset("MoveCube/test/0"), lambda: simulator.step(ACTION)):
        with raises(SimulatorCrashError):
            call()


Run = Callable[..., tuple[int, str, str]]
SIMULATE = ("simulate", "--simulator", DOUBLE)


def test_simulate_plays_an_episode_and_writes_what_is_seen(run: Run, tmp_path: Path) -> None:
    video = tmp_path / "new" / "out.mp4"
    _, out, _ = run(*SIMULATE, "MoveCube/test/200", "--json", "--video", video)
    assert json.loads(out) == {
        "episode": "MoveCube/test/200",
        "simulator": "double",
        "goal": "goal",
        "difficulty": "easy",
        "seed": 200,
        "shift": "none",
        "policy": "oracle",
        "status": "success",
        "lesson_frames": 5,
        "steps": 3,
        "video": str(video),
    }
    assert list(video.parent.iterdir()) == [video]
    with av.open(str(video)) as container:
        frames = [f.to_ndarray(format="rgb24").astype(int) for f in container.decode(video=0)]
    # Five frames of the lesson, the first live one and three steps; two views, and the text.
    assert [frame.shape for frame in frames] == [(280, 768, 3)] * 9
    views = frames[8][24:28]
    assert abs(views[:, :4].mean(axis=(0, 1)) - 200).max() < 40  # the front camera
    assert abs(views[:, 256:260].mean(axis=(0, 1)) - 99).max() < 40  # the wrist's
    assert (frames[0][:20, :250] < 128).any() and (frames[0][:20, 256:500] < 128).any()  # headings
    assert np.abs(frames[4][:, 512:] - frames[5][:, 512:]).max() > 100  # the text goes on


@pytest.mark.parametrize(
    ("episode", "message"),
    [
        ("MoveCube", "'MoveCube' is not an episode id"),
        ("MoveCube/tests/3", "'tests' is not a split"),
        ("MoveCube/train/3@16", "expected a whole episode, such as MoveCube/train/3"),
    ],
)
def test_simulate_needs_the_id_of_an_episode(run: Run, episode: str, message: str) -> None:
    code, out, err = run(*SIMULATE, episode)
    assert (code, out) == (1, "") and message in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--video {}/out.avi", ".mp4 file"),
        ("--video {}/file/out.mp4", "{}/file"),
        ("--policy orakel", "oracle, guess, none"),
        ("--shift fog:1", "such as light:2"),
        ("--shift light:2 --simulator robomme", "does not support shifts"),
        ("--simulator robomme", "variable ROBOMME_PYTHON"),
        ("--video {}/out.mp4", "no such episode"),
    ],
)
def test_what_simulate_cannot_do_leaves_nothing(
    run: Run, tmp_path: Path, words: str, message: str
) -> None:
    (tmp_path / "folder.mp4").mkdir()
    (tmp_path / "file").touch()
    given = words.replace("{}", str(tmp_path)).split()
    code, out, err = run(
        *SIMULATE, f"MoveCube/test/{UNKNOWN}", *given
    )  # which playing would refuse
    assert (code, out) == (1, "")
    assert message.replace("{}", str(tmp_path)) in err and "Traceback" not in err
    assert {path.name for path in tmp_path.iterdir()} == {"folder.mp4", "file"}
