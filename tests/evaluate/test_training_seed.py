"""The seed of the training run in the rows of a run: the setting, or what the policy reports."""

from collections.abc import Mapping
from typing import Any

import pytest
from support.runs import config

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
