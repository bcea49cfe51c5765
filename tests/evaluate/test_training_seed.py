"""The training run of the weights in the rows of a run: a setting, or what the policy reports."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from support.runs import config, run_one

from robomme_interference_data.evaluate import Observation, Policy
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId

pytestmark = pytest.mark.usefixtures("world")


@pytest.mark.parametrize(
    ("given", "metadata", "recorded"),
    [
        (None, {}, None),
        (None, {"training_seed": 3}, 3),
        (None, {"server_metadata": {"training_seed": 4}}, 4),
        (5, {"training_seed": 3}, 5),
        (0, {"training_seed": 3}, 0),
        # What is no seed is a fact of the policy's own.
        (None, {"training_seed": "3"}, None),
        (None, {"training_seed": True}, None),
        (None, {"training_seed": -1}, None),
        (None, {"server_metadata": "ready"}, None),
    ],
)
def test_the_setting_comes_before_what_is_reported(
    given: int | None, metadata: Mapping[str, Any], recorded: int | None
) -> None:
    run = RunContext(
        config(training_seed=given), "mine", SystemFacts(), "buffers", "ab", metadata=metadata
    )
    assert run.training_seed == recorded
    key = run.key(WorkItem("k0", EpisodeId("MoveCube", "test", 0)))
    assert (key["training_seed"], key["model_seed"]) == (recorded, 0)


class Learner(Policy):
    """A policy of step 500; options are what it reports beside that."""

    def __init__(self, **reported: str):
        self._reported = {name: int(value) for name, value in reported.items()}

    def act(self, observation: Observation, goal: str) -> NDArray[np.float32]:
        return np.zeros((16, 8), np.float32)

    def metadata(self) -> dict[str, Any]:
        return {"training_step": 500, **self._reported}


@pytest.mark.parametrize(("steps", "finished"), [(None, True), (500, True), (2000, False)])
def test_weights_of_an_unfinished_training_run(
    steps: int | None, finished: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    options = () if steps is None else (f"training_steps={steps}",)
    policy = f"python:{__name__}:Learner"
    result = run_one(tmp_path / "run", policy=policy, policy_options=options)
    assert {row.training_step for row in result.rows} == {500}
    said = [one.getMessage() for one in caplog.records if "not finished" in one.getMessage()]
    assert len(said) == (0 if finished else 1)
    assert finished or "step 500 of 2,000" in said[0]
