"""Simulators of the user: their mistakes are one error each, before the first rollout."""

from pathlib import Path
from typing import Any

import pytest
from support.buffer_sets import QUERIES
from support.messages import raises
from support.own_simulators import Played
from support.runs import config, run, run_one
from support.worlds import World

from robomme_interference_data import load_buffer_set
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    RunError,
    SimulatorError,
    UnknownNameError,
)
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.rollout.agreement import check_episode
from robomme_interference_data.evaluate.rollout.checks import check_policy, check_settings
from robomme_interference_data.evaluate.rollout.settings import simulator_options
from robomme_interference_data.simulators import Simulator
from robomme_interference_data.simulators.episode import Observation
from robomme_interference_data.simulators.registry import accepted_settings, simulator_class

pytestmark = pytest.mark.usefixtures("world")

OWN = "support.own_simulators:"


def test_a_simulator_without_a_slip(tmp_path: Path) -> None:
    oracle: dict[str, Any] = {"policy": "oracle", "system": "mine", "simulator": f"{OWN}Played"}
    result = run_one(tmp_path / "run", **oracle)
    assert [(row.status, row.simulator, row.steps) for row in result.rows] == [
        ("success", f"{OWN}Played", 1)
    ]


@pytest.mark.parametrize(
    ("name", "error", "words"),
    [
        ("raising", SimulatorError, "OSError: no licence for the physics engine"),
        ("Abstract", SimulatorError, "abstract methods '_begin', '_execute'"),
        ("Resetless", SimulatorError, "Resetless has no reset(), act()"),
        ("Narrow", SimulatorError, "'state': (7,)"),
        ("Uneven", SimulatorError, "states are float32 (48, 8), a live one (7,)"),
        ("Small", SimulatorError, "'front': (16, 16, 3)"),
        ("Floating", SimulatorError, "the image of 'front' is float64 (32, 32, 3)"),
        ("Unnamed", SimulatorError, "the camera 'top' is none of front, wrist"),
        ("TwoArms", SimulatorError, "actions are float32 (48, 8); expected (48, 14), or (0, 14)"),
        ("Doubled", SimulatorError, "the first live state is float64 (8,)"),
        ("Blindfolded", SimulatorError, "was to draw front; it drew no camera"),
        ("Pair", SimulatorError, "returned Demonstration, Observation"),
        ("Elsewhere", InvalidOptionError, "does not play the family VideoRepick"),
    ],
)
def test_a_slip_ends_the_run_before_anything_is_written(
    tmp_path: Path, name: str, error: type[InterferenceError], words: str
) -> None:
    with pytest.raises(error) as raised:
        run(tmp_path / "run", simulator=OWN + name)
    assert words in raised.value.message and raised.value.hint
    assert not (tmp_path / "run").exists()


def test_an_episode_that_breaks_is_an_error_row(tmp_path: Path) -> None:
    result = run_one(tmp_path / "run", simulator=f"{OWN}Breaks")
    assert [row.status for row in result.rows] == ["error"]
    assert "the arm fell off" in str(result.rows[0].error)


def test_another_shape_of_an_undeclared_simulator(tiny_buffers: Path) -> None:
    lesson, first, info = World().reset("MoveCube/test/0")
    query = load_buffer_set(tiny_buffers).query("MoveCube/test/0")
    with raises(SimulatorError):  # which would broadcast
        check_episode(query, lesson, Observation(first.images, first.state[:1]), info)
    with raises(RunError):
        check_episode(query, lesson, Observation(first.images, first.state + 1), info)


def test_settings_are_those_that_a_class_declares_or_a_function_takes(tiny_buffers: Path) -> None:
    demonstrations = load_buffer_set(tiny_buffers).datasets["demonstrations"]
    given = {"cameras": ("top",), "shift": "none", "answer_s": 9.0}
    for name in ("Listed", "make_listed"):
        assert accepted_settings(OWN + name, given) == {"cameras": ("top",)}
    assert accepted_settings(f"{OWN}make_any", given) == {}
    classes = [simulator_class(OWN + name) for name in ("Listed", "make_listed", "make_any")]
    assert [one.__name__ for one in classes] == ["Listed", "Listed", "Simulator"]
    assert classes[2] is Simulator

    def options(name: str, *watched: str, **changes: Any) -> dict[str, Any]:
        return simulator_options(config(simulator=OWN + name, **changes), watched, demonstrations)

    assert options("Played", "wrist") == {"cameras": ("wrist",)}
    assert options("Played") == {"cameras": ()}  # draws nothing for nobody
    assert options("make_listed", videos=True) == {"cameras": ("top",)}
    assert options("make_any", "top") == {}


@pytest.mark.parametrize(
    ("simulator", "policy", "error", "words"),
    [
        ("Listed", "replay", UnknownNameError, "live camera 'front' is not in"),
        ("TwoArms", "noop", InvalidOptionError, "this robot has 8 and 14"),
        ("TwoArms", "replay:window", InvalidOptionError, "8 action values, 7 joints"),
        ("TwoArms", "oracle", None, ""),
        ("Played", "guess", InvalidOptionError, "needs a script of the simulator"),
    ],
)
def test_policies_that_do_not_fit(
    tiny_buffers: Path, simulator: str, policy: str, error: Any, words: str
) -> None:
    settings = config(simulator=OWN + simulator, policy=policy)
    opened, made = load_buffer_set(tiny_buffers), make_policy(policy)
    if error is None:
        check_settings(settings, opened)
        check_policy(settings, opened, made)
        return
    with pytest.raises(error) as raised:
        check_settings(settings, opened)
        check_policy(settings, opened, made)
    assert words in raised.value.message


def test_a_simulator_without_a_script_cannot_act() -> None:
    class Scriptless(Played):
        _act = Simulator._act  # as if it did not define one

    simulator = Scriptless()
    simulator.reset(QUERIES[0])
    with raises(UnknownNameError):
        simulator.act("oracle")
