"""Policies and memories that meet units of another robot, with other numbers of state values."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.messages import raises
from support.two_robots import build_two_robots

from robomme_interference_data import load_buffer_set
from robomme_interference_data.constants import EXECUTIONS
from robomme_interference_data.errors import InvalidOptionError, PolicyError, RunError
from robomme_interference_data.evaluate import RunConfig, run_evaluation
from robomme_interference_data.evaluate.policies.registry import make_policy, policy_options
from robomme_interference_data.evaluate.run.history import HistoryReader
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.storage.text import read_json
from robomme_interference_data.training import HistoryDataset

OWN = "python:support.own_policies:OfTwoRobots"
NAME = "Lift/test/0"


@pytest.fixture(scope="module")
def narrower(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Lessons and executions with states of 8 values, units with 3."""
    return build_two_robots(tmp_path_factory.mktemp("two_robots"), 3, EXECUTIONS)


def run(root: Path, out: Path, **changes: Any) -> Any:
    usual: dict[str, Any] = {
        "policy": OWN,
        "buffer_set": str(root),
        "out": out,
        "offline": True,
        "system": "mine",
        "conditions": ("k1",),
    }
    return run_evaluation(RunConfig(**usual | changes), executor=Serial())


def test_a_policy_that_refuses_them_is_an_error_before_the_run(
    narrower: Path, tmp_path: Path
) -> None:
    for conditions in (("k0", "k1"), ("raw-k1",)):
        with raises(InvalidOptionError) as caught:
            run(narrower, tmp_path / "run", conditions=conditions)
        assert caught.value.option == "other_states"
        assert "other_states=pad" in str(caught.value.hint)
    assert not (tmp_path / "run").exists()
    rows = run(narrower, tmp_path / "run", conditions=("k0",)).rows
    assert {row.status for row in rows} == {"measured"}


def test_the_rule_is_part_of_the_run(narrower: Path, tmp_path: Path) -> None:
    options = {"policy_options": ("other_states=pad",)}
    rows = run(narrower, tmp_path / "run", **options).rows
    assert [(row.status, row.history_frames) for row in rows] == [("measured", 9)] * 2
    assert read_json(tmp_path / "run" / "run.json")["identity"]["other_states"] == "pad"
    with raises(RunError):
        run(narrower, tmp_path / "run", policy_options=("other_states=omit",))


def test_policies_that_read_no_history_take_any_units(narrower: Path, tmp_path: Path) -> None:
    for policy in ("noop", "oracle", "guess", "follow-subgoals"):
        assert make_policy(policy).other_states == "omit"
    with raises(InvalidOptionError):  # it would follow the zeros
        run(narrower, tmp_path / "run", policy="replay", system=None)


def test_servers_take_the_rule_as_an_option() -> None:
    server = "websocket://localhost:1"
    assert policy_options(server)["other_states"] == "refuse"
    assert make_policy(server, ["other_states=pad"]).other_states == "pad"
    with raises(InvalidOptionError):
        make_policy(server, ["other_states=cut"])
    with raises(PolicyError):
        make_policy(OWN, ["other_states=cut"])


@pytest.mark.parametrize(("rule", "shown"), [("pad", [1.0, 0.0]), ("omit", [0.0, 0.0])])
def test_digests_are_compared_with_the_recorded_states(
    narrower: Path, rule: Any, shown: list[float]
) -> None:
    opened = load_buffer_set(narrower)
    buffer, reader = opened.load(NAME, "raw-k1"), HistoryReader(opened.datasets)
    for _ in range(2):  # compared at first, then not again
        chunks = [*reader.stream(buffer, 4, ("front",), range(13), rule)]
        states = np.concatenate([chunk.states for chunk in chunks])
        np.testing.assert_array_equal(states, buffer.states_by(rule))
    assert states[6, [0, 7]].tolist() == shown  # frame 1 of the unit


def test_memories_for_training(narrower: Path, tmp_path: Path) -> None:
    options: Any = {"cache": tmp_path, "quiet": True, "memory": "full", "chunk": 0}
    options["split"] = "test"
    with raises(InvalidOptionError) as caught:
        HistoryDataset(narrower, ["k1"], **options)
    assert caught.value.option == "other_states"
    data = HistoryDataset(narrower, ["k1"], other_states="pad", **options)
    item = data[data.index_of(NAME)]
    buffer = load_buffer_set(narrower).load(NAME, "k1")
    np.testing.assert_array_equal(item["memory.state"].numpy(), buffer.states_by("pad"))
    assert item["observation.state"].tolist() == [5.0] * 8
    again = HistoryDataset(narrower, ["k1"], other_states="omit", **options)
    item = again[again.index_of(NAME)]
    np.testing.assert_array_equal(item["memory.state"].numpy(), buffer.states_by("omit"))
    assert HistoryDataset(narrower, ["k0"], **options).memory_frames == 5
