"""What makes a run the one that it is, and what may differ from start to start."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from support.policy_server import PolicyServer
from support.runs import header, run, run_one

from robomme_interference_data.errors import RunError
from robomme_interference_data.evaluate import RunConfig, merge_runs
from robomme_interference_data.evaluate.policies.identity import policy_identity
from robomme_interference_data.evaluate.policies.registry import POLICIES

pytestmark = pytest.mark.usefixtures("world")

STILL = "python:support.own_policies:Still"


def test_every_setting_is_classed() -> None:
    """A new setting either makes another run of it, or does not: somebody has to say which."""
    makes_the_run = {
        *("policy", "policy_options"),  # by policy_identity
        *("retrieval", "retrieval_rule", "retrieval_camera"),  # by Selector.identity
        *("subgoals", "subgoal_prompt", "subgoal_options"),  # by subgoals_identity
        *("system", "simulator", "buffer_set", "split", "shift", "model_seed"),
    }
    plan = {"families", "episodes", "conditions", "shard"}
    may_differ = {
        *("out", "no_resume", "robomme_python", "workers", "videos", "check_lesson", "cache"),
        *("rollout_timeout_s", "simulator_timeout_s", "history_chunk", "max_errors"),
        *("serve", "executor", "ray_address", "cpus_per_worker", "gpus_per_worker"),
    }
    fields = {field.name for field in dataclasses.fields(RunConfig)}
    assert makes_the_run | plan | may_differ == fields


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"system": "yours"}, "system is 'mine' there, 'yours' here"),
        ({"model_seed": 7}, "model_seed is 0 there, 7 here"),
        ({"policy": "noop", "policy_options": ()}, f"policy is {STILL!r} there, 'noop' here"),
        ({"policy_options": ("gripper=1",)}, "policy_options.gripper is -1.0 there, 1.0 here"),
    ],
)
def test_another_run_is_refused_and_the_difference_named(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    usual: dict[str, Any] = {"policy": STILL, "policy_options": ("gripper=-1",)}
    run_one(tmp_path / "run", **usual)
    before = (tmp_path / "run" / "run.json").read_bytes()
    with pytest.raises(RunError, match="holds another run") as raised:
        run_one(tmp_path / "run", **usual | changes)
    assert message in raised.value.message
    assert (tmp_path / "run" / "run.json").read_bytes() == before


def test_what_may_differ_goes_on_with_the_run(tmp_path: Path) -> None:
    run_one(tmp_path / "run", history_chunk=7)
    run_one(tmp_path / "run", check_lesson=True, rollout_timeout_s=5.0, cache=True)
    starts = header(tmp_path / "run")["starts"]
    assert [one["settings"]["history_chunk"] for one in starts] == [7, 64]
    assert [one["settings"]["check_lesson"] for one in starts] == [False, True]


def test_another_checkpoint_behind_the_same_words_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = "python:support.own_policies:from_checkpoint"
    for name in ("a", "b"):
        monkeypatch.setenv("CHECKPOINT", name)
        run_one(tmp_path / name, policy=policy)
    difference = r"policy_metadata\.checkpoint is '{}' there, '{}' here"
    with pytest.raises(RunError, match=difference.format("b", "a")):
        merge_runs([tmp_path / "a", tmp_path / "b"], tmp_path / "merged")
    with pytest.raises(RunError, match=difference.format("a", "b")):
        run_one(tmp_path / "a", policy=policy)


def test_where_a_server_listens_makes_no_other_run(tmp_path: Path) -> None:
    def serve(out: str, server: PolicyServer, **changes: Any) -> Any:
        return run(tmp_path / out, policy=server.url, conditions=("k0",), **changes)

    with PolicyServer().running() as first, PolicyServer().running() as second:
        first.metadata = second.metadata = {"checkpoint": "a"}
        serve("one", first, shard="1/2")
        serve("two", second, shard="2/2")
        merged = merge_runs([tmp_path / "one", tmp_path / "two"], tmp_path / "merged")
        assert merged.missing == merged.duplicates == ()
        again = serve("merged", second, policy_options=("response_s=30",))
        assert again.counts["fail"] == 2
        addresses = {start["policy"]["server"] for start in header(tmp_path / "merged")["starts"]}
        assert addresses == {f"127.0.0.1:{first.port}", f"127.0.0.1:{second.port}"}
        first.metadata = {"checkpoint": "b"}
        difference = r"server_metadata\.checkpoint is 'a' there, 'b' here"
        with pytest.raises(RunError, match=difference):
            serve("one", first, shard="1/2")


def test_a_privileged_policy_is_on_record(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    insider = {"policy_options": ("name=privileged", "value=true")}
    run_one(tmp_path / "run", policy="python:support.own_policies:changed", **insider)
    said = header(tmp_path / "run")["starts"][0]["policy"]
    assert said == {"policy": "still", "privileged": True}
    assert "own_policies:changed is privileged: it gets the simulator" in caplog.text
    caplog.clear()
    says = "python:support.own_policies:says"
    run_one(tmp_path / "other", policy=says, policy_options=("what=array",))
    said = header(tmp_path / "other")["starts"][0]["policy"]
    assert said == {"policy": "still", "sizes": [0, 1, 2], "4": 5.0}
    assert "privileged" not in caplog.text


def test_what_of_a_policy_can_change_a_result() -> None:
    # The default memory is the same, written or not.
    assert [POLICIES.pin(text) for text in ("replay", "replay:full")] == ["replay:full"] * 2
    assert policy_identity("replay:window", (), {})["policy"] == "replay:window"
    here = {"policy": "websocket", "server": "a:1", "server_metadata": {"model": "m"}}
    assert policy_identity("websocket://a:1,b:2", ("response_s=5", "checkpoint=7"), here) == {
        "policy": "websocket",
        "policy_options": {"checkpoint": "7", "chunk_frames": 16},
        "policy_metadata": {"policy": "websocket", "server_metadata": {"model": "m"}},
    }
    assert policy_identity(STILL, ("gripper=1",), {}) == policy_identity(STILL, (), {})
    assert policy_identity(STILL, ("gripper=0.5",), {"device": "cuda"}) == {
        "policy": STILL,
        "policy_options": {"gripper": 0.5},
        "policy_metadata": {"device": "cuda"},
    }
    objects = policy_identity("python:support.own_policies:with_object", (), {})
    assert objects["policy_options"] == {"name": "x"}  # what JSON cannot hold is left out
