"""Servers of vla-eval as policies, in real processes: shared, killed; and its LeRobot server."""

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import runs
from support.lazy import lazy
from support.messages import raises

from robomme_interference_data.errors import InvalidOptionError, WorkerRetiredError
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.runtime.process import Processes

pytestmark = pytest.mark.usefixtures("world")

CONDITIONS = ("no-history", "k0", "k1")
NAMED = ("checkpoint=mine/1",)
servers = lazy("support.vla_eval_servers")
small = lazy("support.lerobot_policies")


def expected_rows(folder: Path) -> list[dict[str, Any]]:
    """The rows of the same policy without a server."""
    runs.run(folder, policy="python:support.shared_policies:Remembering", conditions=CONDITIONS)
    return runs.of_any_policy(runs.finished_rows(folder))


@pytest.mark.slow
def test_workers_share_a_server_that_batches(tmp_path: Path) -> None:
    with servers.serving("Batching") as url:
        settings: dict[str, Any] = {"policy": f"vla-eval:{url}", "policy_options": NAMED}
        runs.run(tmp_path / "run", Processes(2), workers=2, conditions=CONDITIONS, **settings)
    assert runs.of_any_policy(runs.finished_rows(tmp_path / "run")) == expected_rows(
        tmp_path / "own"
    )
    assert {*(tmp_path / "batches").read_text().split()} == {"1", "2"}


@pytest.mark.slow
def test_a_run_resumes_after_its_server_died_in_a_rollout(tmp_path: Path) -> None:
    settings: dict[str, Any] = {"conditions": CONDITIONS}
    with servers.serving("Dying") as url:
        settings["policy"] = f"vla-eval:{url}"
        with pytest.raises(WorkerRetiredError):
            runs.run(tmp_path / "run", policy_options=(*NAMED, "connect_s=1"), **settings)
    assert len(runs.finished_rows(tmp_path / "run")) < 6
    with servers.serving("Dying", int(url.rpartition(":")[2])):
        runs.run(tmp_path / "run", policy_options=NAMED, **settings)
    assert runs.of_any_policy(runs.finished_rows(tmp_path / "run")) == expected_rows(
        tmp_path / "own"
    )


@pytest.mark.slow
@pytest.mark.parametrize("cameras", [("front", "wrist"), ("front",)])
def test_its_lerobot_server_acts_as_the_policy_here(tmp_path: Path, cameras: Any) -> None:
    from vla_eval.model_servers.lerobot import LeRobotModelServer

    names = tuple(f"observation.images.{camera}" for camera in cameras)
    folder = small.save_policy(tmp_path / "act", "act", names)
    own = make_policy(f"lerobot:{folder}", ["device=cpu"])
    expected = small.play(own, 0, [1, 1])
    assert [one.shape for one in expected] == [(16, 8)] * 2
    server = LeRobotModelServer("act", str(folder), device="cpu", chunk_size=16)
    with servers.running(server) as port:
        policy = make_policy(f"vla-eval:ws://127.0.0.1:{port}", NAMED)
        with closing(policy):
            assert (policy.cameras, policy.wants_history) == (cameras, False)
            # It acts on the first of 16 observations, and so on the two that the policy gets.
            actions = np.concatenate(small.play(policy, 0, [1] * 17))
    np.testing.assert_array_equal(actions[:16], expected[0])
    assert not np.array_equal(actions[16], expected[0][0])
    with raises(InvalidOptionError):
        make_policy(f"vla-eval:ws://127.0.0.1:{port}")


@pytest.mark.slow
def test_its_lerobot_server_has_one_queue_with_use_select_action(tmp_path: Path) -> None:
    """docs/how-to/connect-a-policy.md says so: it is true as long as this passes."""
    from vla_eval.model_servers.lerobot import LeRobotModelServer

    folder = small.save_policy(tmp_path / "act", "act", ("observation.images.front",))
    for own_queues in (True, False):
        server = LeRobotModelServer(
            "act", str(folder), device="cpu", use_select_action=not own_queues
        )
        with (
            servers.running(server) as port,
            closing(make_policy(f"vla-eval:ws://127.0.0.1:{port}", NAMED)) as one,
            closing(make_policy(f"vla-eval:ws://127.0.0.1:{port}", NAMED)) as other,
        ):
            alone = np.concatenate(small.play(one, 0, [1] * 4))
            small.play(one, 0, [1] * 2)
            small.play(other, 0, [1])  # empties the queue, and takes its next action
            third = one.act(small.observation(2), "pick the cube")
        assert np.array_equal(third[0], alone[2]) is own_queues
