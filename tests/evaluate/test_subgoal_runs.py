"""Subgoals in rollouts and runs: when they are asked for, who reads them, what is written."""

import json
import shutil
from pathlib import Path
from typing import Any

import openai
import pytest
from support.chat_server import (
    BROKEN,
    BUSY,
    CLOSED,
    DRIPS,
    EMPTY,
    GARBAGE,
    REFUSED,
    SLOW,
    ChatServer,
)
from support.own_policies import Told
from support.policy_server import PolicyServer
from support.runs import config, header, roll, run, run_one

from robomme_interference_data import load_buffer_set
from robomme_interference_data.errors import (
    InterferenceError,
    InvalidOptionError,
    ModelError,
    RunError,
)
from robomme_interference_data.evaluate.policies.registry import make_policy
from robomme_interference_data.evaluate.rollout.checks import check_settings, default_system
from robomme_interference_data.evaluate.subgoals.registry import make_writer
from robomme_interference_data.evaluate.subgoals.writer import OracleWriter
from robomme_interference_data.schema.subgoal import Subgoal

pytestmark = pytest.mark.usefixtures("world")

TOLD = "python:support.own_policies:Told"


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(openai._base_client, "INITIAL_RETRY_DELAY", 0.001)


def lines(folder: Path, name: str) -> list[dict[str, Any]]:
    text = (folder / "subgoals" / f"{name}.jsonl").read_text()
    return [json.loads(line) for line in text.splitlines()]


# --- when they are asked for ---------------------------------------------------------------------


@pytest.mark.parametrize(("single", "acts"), [(False, 3), (True, 40)])
def test_before_each_chunk_and_every_16_steps_at_least(single: bool, acts: int) -> None:
    policy, writer = Told(single), OracleWriter()
    row = roll("no-history", policy, writer=writer)
    assert row.steps == 40
    assert [turn.step for turn in writer.turns] == [0, 16, 32]
    told = [Subgoal(f"go on from step {at} to <point>", ((at, 7),)) for at in (0, 16, 32)]
    assert len(policy.told) == acts
    assert policy.told == (told if not single else [told[step // 16] for step in range(40)])
    assert (row.model_calls, row.model_tokens, row.model_faults) == (0, None, 0)


# --- servers -------------------------------------------------------------------------------------


def test_a_server_gets_them_with_places_and_without(server: PolicyServer, tmp_path: Path) -> None:
    options = ("checkpoint=a",)
    run_one(tmp_path, policy=server.url, policy_options=options, subgoals="oracle")
    asked = [call for call in server.calls if "prompt" in call]
    assert [call["simple_subgoal"] for call in asked][:2] == [
        "go on from step 0 to",
        "go on from step 16 to",
    ]
    assert asked[1]["grounded_subgoal"] == "go on from step 16 to <16, 7>"


# --- a model writes them -------------------------------------------------------------------------


def asking(server: ChatServer, **changes: Any) -> dict[str, Any]:
    usual = {"policy": TOLD, "subgoals": f"openai:{server.url}#tiny"}
    return usual | {"subgoal_options": ("frames=4", "response_s=5")} | changes


def test_a_run_with_a_faulty_endpoint_loses_no_row(tmp_path: Path) -> None:
    faults = [BUSY, BROKEN, GARBAGE, REFUSED, EMPTY, CLOSED, SLOW, BUSY]
    with ChatServer(lambda seen: "go to <500, 250>", faults=faults, slow_s=0.05) as server:
        result = run(tmp_path, **asking(server))
        assert [row.status for row in result.rows] == ["fail"] * 4
        # Three subgoals a rollout; of the faults all but the refusal and the slow one were
        # repeated.
        assert len(server.seen) == sum(row.model_calls or 0 for row in result.rows) == 4 * 3 + 6
        assert sum(row.model_faults or 0 for row in result.rows) == 1
        assert sum(row.model_tokens or 0 for row in result.rows) == 4 * 3 * 105
        assert all(row.model_s is not None and row.model_s > 0 for row in result.rows)
    written = lines(tmp_path, "MoveCube_test_0_k0")
    assert [line["step"] for line in written] == [0, 16, 32]
    assert written[1]["subgoal"] == "go to <16, 8>"  # of 32 × 32 pixels
    assert "[video of 4 frames]" in written[1]["prompt"] and "Steps so far" in written[1]["prompt"]
    assert len([*(tmp_path / "subgoals").iterdir()]) == 4


def test_an_answer_that_never_ends_is_an_error_row(tmp_path: Path) -> None:
    options = ("repeats=0", "connect_s=0.2", "response_s=0.1")
    with ChatServer(faults=[DRIPS]) as server:
        [row] = run_one(tmp_path, **asking(server, subgoal_options=options)).rows
    assert row.status == "error" and "no answer in time" in str(row.error)


def test_an_endpoint_that_goes_away_costs_no_row(tmp_path: Path) -> None:
    with ChatServer() as server:
        settings = asking(server, subgoal_options=("repeats=0", "frames=4"))
        server.faults = [BROKEN] * 2  # the first two rollouts break
        first = run(tmp_path, **settings)
        assert sorted(row.status for row in first.rows) == ["error"] * 2 + ["fail"] * 2
        assert "ModelError" in str(next(row.error for row in first.rows if row.error))
        second = run(tmp_path, **settings)
    assert [row.status for row in second.rows] == ["fail"] * 4
    assert sorted(row.attempt for row in second.rows) == [1, 1, 2, 2]


# --- what makes the run the one that it is -------------------------------------------------------


def test_the_prompt_and_the_model_make_the_run(tmp_path: Path) -> None:
    with ChatServer() as server, ChatServer() as other:
        run_one(tmp_path / "run", **asking(server))
        moved = asking(other, subgoal_options=("frames=4", "repeats=1"))
        assert run_one(tmp_path / "run", **moved).counts["fail"] == 1  # where it is served is free
        with pytest.raises(RunError, match="prompt_sha256"):
            run_one(tmp_path / "run", **asking(server, subgoal_prompt="simple"))
        with pytest.raises(RunError, match=r"frames is 4 there, 5 here"):
            run_one(tmp_path / "run", **asking(server, subgoal_options=("frames=5",)))
        with pytest.raises(RunError, match="subgoals"):
            run_one(tmp_path / "run", policy=TOLD)
    start = header(tmp_path / "run")["starts"][0]
    assert start["policy"]["subgoals"]["model"] == {"model": "tiny"}


def test_a_wrong_model_is_refused_before_the_run(tmp_path: Path) -> None:
    with ChatServer(model="large") as server, pytest.raises(ModelError, match="no model 'tiny'"):
        run_one(tmp_path / "run", **asking(server))
    assert not (tmp_path / "run").exists()


# --- names and settings --------------------------------------------------------------------------


def checked(tiny_buffers: Path, system: str, **changes: Any) -> None:
    settings = config(**{"simulator": "tabletop", "policy": "websocket://h:1"} | changes)
    check_settings(settings, system, load_buffer_set(tiny_buffers), make_policy("noop"))


MODEL = {"subgoals": "openai:http://h/v1#m"}


@pytest.mark.parametrize(
    ("system", "changes"),
    [
        ("symbolic-groundsg", MODEL),
        ("symbolic-simplesg", MODEL),
        ("memer", MODEL),
        ("memer", {**MODEL, "subgoal_prompt": "memer"}),
        ("mine", {"subgoals": "oracle"}),
        ("mine", {**MODEL, "policy": TOLD}),
    ],
)
def test_what_goes_together(tiny_buffers: Path, system: str, changes: dict[str, Any]) -> None:
    checked(tiny_buffers, system, **changes)


@pytest.mark.parametrize(
    ("system", "changes", "words"),
    [
        ("symbolic-groundsg", {}, "acts on subgoals of a model"),
        ("symbolic-groundsg", {"subgoals": "oracle"}, "knows the answer"),
        ("symbolic-groundsg", {**MODEL, "subgoal_prompt": "memer"}, "recent frames"),
        ("memer", {**MODEL, "subgoal_prompt": "grounded"}, "no recent frames"),
        ("perceptual-framesamp-modul", MODEL, "acts on no subgoals"),
        ("mine", {**MODEL, "policy": "replay"}, "replay reads no subgoals"),
        ("mine", {"subgoal_prompt": "simple"}, "has no effect without a model"),
        ("mine", {"subgoals": "oracle", "subgoal_options": ("frames=3",)}, "`subgoal_options` has"),
        ("mine", {**MODEL, "subgoal_prompt": "nowhere.toml"}, "no prompt"),
    ],
)
def test_what_does_not(
    tiny_buffers: Path, system: str, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(InterferenceError) as raised:
        checked(tiny_buffers, system, **changes)
    assert words in raised.value.message


def test_an_unknown_option_is_told_with_those_of_model_and_prompt() -> None:
    settings = config(policy=TOLD, subgoal_prompt="simple", **MODEL, subgoal_options=("framse=3",))
    with pytest.raises(InvalidOptionError, match="framse") as raised:
        make_writer(settings)
    hint = str(raised.value.hint)
    assert "max_tokens" in hint and "frames, recent, stride, near" in hint


def test_rows_behind_a_model_need_a_name() -> None:
    with pytest.raises(InvalidOptionError, match="need a name"):
        default_system(config(policy=TOLD, **MODEL))
    assert default_system(config(policy="python:a.b:c", subgoals="oracle")) == "a.b-c-oracle"


def test_subgoals_that_cannot_be_written_are_told_and_cost_nothing(tmp_path: Path) -> None:
    (tmp_path / "subgoals").parent.mkdir(exist_ok=True)
    result = run_one(tmp_path, policy=TOLD, subgoals="oracle")
    assert result.counts["fail"] == 1
    shutil.rmtree(tmp_path / "subgoals")
    (tmp_path / "subgoals").write_text("a file")
    result = run(tmp_path, policy=TOLD, subgoals="oracle")
    assert result.counts["fail"] == 4
    told = (tmp_path / "errors.log").read_text()
    assert "subgoals/MoveCube_test_0_k0.jsonl could not be written" in told
