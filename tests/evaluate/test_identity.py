"""Which settings identify a run, so that resuming with others is an error, and which may change."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from support import worlds
from support.asking import ask, behind, look, questions
from support.chat_server import ChatServer
from support.messages import raises
from support.policy_server import PolicyServer
from support.runs import header, run, run_one
from support.tabletop import PROVENANCE, TABLETOP, copy_tabletop

from robomme_interference_data.build_dataset.questions import write_questions
from robomme_interference_data.data.questions import digest_questions
from robomme_interference_data.errors import RunError
from robomme_interference_data.evaluate import RunConfig, merge_runs
from robomme_interference_data.evaluate.run.config import AskConfig, WorkConfig

pytestmark = pytest.mark.usefixtures("world")

OWN = "python:support.own_policies:"
STILL = f"{OWN}Still"

# Every setting is in one of these sets: the author of a new one decides which.
IDENTITY = {
    WorkConfig: {
        *("retrieval", "retrieval_rule", "retrieval_camera"),  # in Selector.identity
        *("system", "split", "training_seed", "model_seed"),
    },
    RunConfig: {
        *("policy", "policy_options"),  # in policy_identity
        *("subgoals", "subgoal_prompt", "subgoal_options"),  # in subgoals_identity
        *("simulator", "buffer_set", "shift", "offline"),  # offline sets the simulator
        "simulator_options",
    },
    AskConfig: {
        *("model", "model_options", "prompt"),  # in model_identity, and the prompt's digest
        *("memory", "control", "buffer_set"),
    },
}
FREE = {
    WorkConfig: {
        *("families", "episodes", "conditions", "shard"),  # the plan, which may grow
        *("workers", "executor", "resources"),
        *("no_resume", "cache", "rollout_timeout_s", "max_errors", "track"),
    },
    RunConfig: {
        *("out", "videos", "check_lesson", "simulator_timeout_s", "no_probe"),
        "simulator_python",  # its versions are in the identity
        "history_chunk",
        *("policies", "max_batch_size", "batch_wait_timeout_s", "policy_resources"),
    },
    AskConfig: {"out"},
}


@pytest.mark.parametrize("config", [RunConfig, AskConfig])
def test_every_setting_is_classified(config: type) -> None:
    classified = [one[kind] for one in (IDENTITY, FREE) for kind in (WorkConfig, config)]
    assert set().union(*classified) == {field.name for field in dataclasses.fields(config)}


# --- rollouts ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"system": "yours"}, "system is 'mine' there, 'yours' here"),
        ({"model_seed": 7}, "model_seed is 0 there, 7 here"),
        ({"training_seed": 7}, "training_seed is None there, 7 here"),
        ({"policy": "noop", "policy_options": ()}, f"policy is {STILL!r} there, 'noop' here"),
        ({"policy_options": ("gripper=1",)}, "policy_options.gripper is -1.0 there, 1.0 here"),
    ],
)
def test_another_run_is_an_error_that_names_the_difference(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    usual: dict[str, Any] = {"policy": STILL, "policy_options": ("gripper=-1",)}
    run_one(tmp_path / "run", **usual)
    before = (tmp_path / "run" / "run.json").read_bytes()
    with raises(RunError) as raised:
        run_one(tmp_path / "run", **usual | changes)
    assert message in raised.value.message
    assert (tmp_path / "run" / "run.json").read_bytes() == before


def test_other_settings_may_change_between_starts(tmp_path: Path) -> None:
    run_one(tmp_path / "run", history_chunk=7)
    run_one(tmp_path / "run", check_lesson=True, rollout_timeout_s=5.0, cache=True)
    starts = header(tmp_path / "run")["invocations"]
    assert [one["settings"]["history_chunk"] for one in starts] == [7, 64]
    assert [one["settings"]["check_lesson"] for one in starts] == [False, True]


def test_the_address_of_a_server_may_change_but_not_its_model(tmp_path: Path) -> None:
    def served(out: str, server: PolicyServer, **changes: Any) -> Any:
        return run(tmp_path / out, policy=server.url, conditions=("k0",), **changes)

    with PolicyServer().running() as first, PolicyServer().running() as second:
        first.metadata = second.metadata = {"checkpoint": "a"}
        served("one", first, shard="1/2")
        served("two", second, shard="2/2")
        merged = merge_runs([tmp_path / "one", tmp_path / "two"], tmp_path / "merged")
        assert merged.missing == merged.duplicates == ()
        again = served("merged", second, policy_options=("response_s=30",))
        assert again.counts["fail"] == 2
        addresses = {
            start["policy"]["server"] for start in header(tmp_path / "merged")["invocations"]
        }
        assert addresses == {f"127.0.0.1:{first.port}", f"127.0.0.1:{second.port}"}
        first.metadata = {"checkpoint": "b"}
        with raises(RunError):
            served("one", first, shard="1/2")


def test_a_run_that_sees_images_resumes_with_the_same_renderer_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv(worlds.BUFFER_SET, str(TABLETOP))
    usual: dict[str, Any] = {"buffer_set": TABLETOP, "simulator": "support.worlds:rendered_world"}
    drawn = PROVENANCE["renderer"]
    for renderer, warns in ((drawn, False), ("a GPU", True)):
        monkeypatch.setenv(worlds.RENDERER, str(renderer))
        caplog.clear()
        out = tmp_path / f"run {warns}"
        run_one(out, policy=STILL, **usual)
        found = header(out)["identity"]["renderers"]
        assert found == {
            "demonstrations": drawn,
            "distractors": drawn,
            "live observations": renderer,
        }
        differ = f"demonstrations and distractors from {drawn}; live observations from a GPU"
        assert (differ in caplog.text) is warns
        run_one(tmp_path / f"blind {warns}", policy="noop", **usual)
    with raises(RunError) as raised:
        run_one(tmp_path / "run False", policy=STILL, **usual)
    assert f"renderers.live observations is {drawn!r} there, 'a GPU' here" in raised.value.message
    run_one(tmp_path / "blind False", policy="noop", **usual)  # its results depend on no image


def test_a_privileged_policy_is_recorded(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    privileged = {"policy_options": ("name=privileged", "value=true")}
    run_one(tmp_path / "run", policy=f"{OWN}changed", **privileged)
    metadata = header(tmp_path / "run")["invocations"][0]["policy"]
    assert metadata == {"policy": "still", "privileged": True}
    assert "own_policies:changed is privileged: it gets the simulator" in caplog.text
    caplog.clear()
    run_one(tmp_path / "other", policy=f"{OWN}says", policy_options=("what=array",))
    metadata = header(tmp_path / "other")["invocations"][0]["policy"]
    assert metadata == {"policy": "still", "sizes": [0, 1, 2], "4": 5.0}
    assert "privileged" not in caplog.text


# --- questions ---------------------------------------------------------------------------------


@pytest.mark.slow
def test_another_run_of_questions_is_an_error_that_names_the_difference(tmp_path: Path) -> None:
    prompt = tmp_path / "mine.toml"
    prompt.write_text('system = "s"\nquestion = "<history><picture>{goal}{question}{options}"\n')
    with ChatServer(look) as server:
        usual = behind(server, memory="framesamp:3", families=("MoveCube",), episodes="0")
        ask(tmp_path / "run", **usual)
        for changes in (
            {"memory": "window:3"},
            {"control": "blank"},
            {"model_options": ("max_tokens=9",)},
            {"model": "guess", "memory": "framesamp:32"},
            {"prompt": str(prompt)},
        ):
            with raises(RunError):
                ask(tmp_path / "run", **usual | changes)


def test_other_questions_are_another_run(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")
    ask(tmp_path / "run", buffer_set=root)
    write_questions([dataclasses.replace(one, text="?") for one in questions().values()], root)
    with raises(RunError):
        ask(tmp_path / "run", buffer_set=root)
    digest = header(tmp_path / "run")["identity"]["questions"]
    assert digest == digest_questions(questions().values())
