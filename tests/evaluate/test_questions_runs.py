"""An examination is a run: no question is lost or asked twice, and no other run is mixed in."""

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import openai
import pytest
from support.asking import ask, behind, look, questions, right_letter
from support.chat_server import (
    BROKEN,
    BUSY,
    BUSY_FOR_AN_HOUR,
    CLOSED,
    EMPTY,
    GARBAGE,
    GONE,
    LOCKED,
    REFUSED,
    SLOW,
    UNCOUNTED,
    ChatServer,
)
from support.machine import full_disk
from support.runs import header, run_one, untimed
from support.splits import copy_split
from support.tabletop import QUERIES, TABLETOP, copy_tabletop
from typer.testing import CliRunner

from robomme_interference_data import load_split
from robomme_interference_data.build_dataset.questions import write_questions
from robomme_interference_data.cli.main import app
from robomme_interference_data.constants import DEMONSTRATIONS
from robomme_interference_data.data.questions import Question, digest_questions, read_questions
from robomme_interference_data.errors import (
    FormatError,
    InterferenceError,
    InvalidOptionError,
    ModelError,
    RunFolderError,
)
from robomme_interference_data.evaluate import merge_runs
from robomme_interference_data.evaluate.models import openai as endpoint
from robomme_interference_data.evaluate.questions import ask as module
from robomme_interference_data.evaluate.run.config import AskConfig
from robomme_interference_data.evaluate.run.log import read_record
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Serial

SOME = {"families": ("MoveCube", "PatternLock")}
"""Four questions."""

FINE = ""
"""No fault."""

MOVE = EpisodeId("MoveCube", "test", 0)


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the client repeat without waiting, unless the server says for how long."""
    monkeypatch.setattr(openai._base_client, "INITIAL_RETRY_DELAY", 0.001)
    monkeypatch.setattr(endpoint, "_PAUSE_S", 0.001)


# --- an endpoint with faults -------------------------------------------------------------------


def test_a_faulty_endpoint_costs_no_question(tmp_path: Path) -> None:
    # One after the other; every question may be asked six times.
    repeated = [*[BUSY] * 3, *[GARBAGE] * 2, FINE, CLOSED, BROKEN, EMPTY, FINE, BUSY, FINE, CLOSED]
    faults = [SLOW, REFUSED, UNCOUNTED, FINE, *repeated, FINE, SLOW]
    with ChatServer(look, faults=faults, slow_s=0.02) as server:
        rows = ask(tmp_path / "run", **behind(server, frames=3)).rows
        asked = len(server.seen)
    assert [row.episode_id for row in rows] == list(QUERIES)
    # A refusal is an answer without a letter; all others were right in the end.
    assert sorted(row.status for row in rows) == ["fail"] + ["success"] * (len(QUERIES) - 1)
    assert sum(row.model_faults or 0 for row in rows) == 1
    assert asked == sum(row.model_calls or 0 for row in rows) == len(QUERIES) + 10
    assert [row.model_tokens for row in rows].count(None) == 1
    assert len(list((tmp_path / "run" / "answers").iterdir())) == len(QUERIES)


def test_what_broke_is_asked_again_and_nothing_else(tmp_path: Path) -> None:
    once = {"model_options": ("repeats=0",), **SOME}
    with ChatServer(look, faults=[BROKEN, CLOSED]) as server:
        first = ask(tmp_path / "run", **behind(server, frames=3, **once))
        assert sorted(row.status for row in first.rows) == ["error"] * 2 + ["success"] * 2
        assert first.counts["error"] == 2
        assert all("ModelError" in str(row.error) for row in first.rows if row.status == "error")
        assert "answers 500" in (tmp_path / "run" / "errors.log").read_text()
        server.seen.clear()
        second = ask(tmp_path / "run", **behind(server, frames=3, **once))
        assert len(server.seen) == 2
        third = ask(tmp_path / "run", **behind(server, frames=3, **once))
        assert len(server.seen) == 2
    assert [row.status for row in second.rows] == ["success"] * 4
    assert sorted(row.attempt for row in second.rows) == [1, 1, 2, 2]
    assert third.rows == second.rows
    assert header(tmp_path / "run")["status"] == "complete"


def test_an_endpoint_that_is_gone_for_good_stops_the_run(tmp_path: Path) -> None:
    for fault in (BUSY_FOR_AN_HOUR, LOCKED, GONE):
        with ChatServer(look, faults=[fault] * 9) as server:
            settings = behind(server, frames=3, max_errors=3, **SOME)
            result = ask(tmp_path / "run", **settings)
            assert len(server.seen) == 3
        assert result.stopped is not None and result.stopped.startswith("3 in a row broke")
        assert [row.status for row in result.rows] == ["error"] * 3
    with ChatServer(look) as server:
        assert ask(tmp_path / "run", **settings | behind(server)).counts["success"] == 4


def test_a_wrong_model_or_address_is_told_before_the_run(tmp_path: Path) -> None:
    with ChatServer(model="large") as server, pytest.raises(ModelError, match="no model 'tiny'"):
        ask(tmp_path / "run", **behind(server))
    settings = behind(server, model_options=("repeats=0",))  # by now it is closed
    with pytest.raises(ModelError, match="cannot be reached"):
        ask(tmp_path / "run", **settings)
    assert not (tmp_path / "run").exists()


def test_answers_that_cannot_be_kept_are_told_and_cost_nothing(tmp_path: Path) -> None:
    with ChatServer(look) as server:
        settings = behind(server, frames=3, families=("MoveCube",))
        ask(tmp_path / "run", episodes="0", **settings)
        shutil.rmtree(tmp_path / "run" / "answers")
        (tmp_path / "run" / "answers").write_text("a file")
        assert ask(tmp_path / "run", **settings).counts["success"] == 2
    assert "could not be written" in (tmp_path / "run" / "errors.log").read_text()


def test_a_damaged_picture_breaks_its_question_alone(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "split")
    damaged = [
        dataclasses.replace(one, picture=one.picture[:500]) if one.episode_id == MOVE else one
        for one in questions().values()
    ]
    write_questions(damaged, root)
    with ChatServer(look) as server:
        rows = ask(tmp_path / "run", split=root, **behind(server, frames=3, **SOME)).rows
    broken, *others = rows
    assert broken.episode_id == MOVE and "MoveCube/test/0: an image is damaged" in str(broken.error)
    assert [row.status for row in others] == ["success"] * 3


# --- what makes the run the one that it is -----------------------------------------------------


def test_every_setting_is_classed() -> None:
    """A new setting either makes another run of it, or does not: somebody has to say which."""
    makes_the_run = {
        *("model", "model_options", "prompt"),  # by model_identity, and the prompt's digest
        *("retrieval", "retrieval_rule", "retrieval_camera"),  # by Selector.identity
        *("frames", "sampling", "control"),
        *("system", "split", "episode_split", "model_seed"),
    }
    plan = {"families", "episodes", "conditions", "shard"}
    who = {"workers", "executor", "ray_address", "cpus_per_worker", "gpus_per_worker"}
    may_differ = who | {"out", "no_resume", "cache", "rollout_timeout", "max_errors"}
    fields = {field.name for field in dataclasses.fields(AskConfig)}
    assert makes_the_run | plan | may_differ == fields


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 5}, "frames is 3 there, 5 here"),
        ({"sampling": "window"}, "sampling is 'framesamp' there, 'window' here"),
        ({"control": "blank"}, "control is 'none' there, 'blank' here"),
        ({"system": "yours"}, "system is 'tiny' there, 'yours' here"),
        ({"model_seed": 1}, "model_seed is 0 there, 1 here"),
        ({"model_options": ("max_tokens=9",)}, "max_tokens is 256 there, 9 here"),
        ({"model_options": ("temperature=0.5",)}, "temperature is 0.0 there, 0.5 here"),
        ({"model": "guess", "frames": 32}, "model.model is 'tiny' there, 'guess' here"),
        ({"prompt": "own"}, "model.prompt_sha256 is"),
    ],
)
def test_another_run_is_refused_and_the_difference_named(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    prompt = tmp_path / "mine.toml"
    prompt.write_text('system = "s"\nquestion = "<history><picture>{goal}{question}{options}"\n')
    changes = {name: str(prompt) if value == "own" else value for name, value in changes.items()}
    with ChatServer(look) as server:
        usual = behind(server, frames=3, families=("MoveCube",), episodes="0")
        ask(tmp_path / "run", **usual)
        before = (tmp_path / "run" / "run.json").read_bytes()
        with pytest.raises(RunFolderError, match="holds another run") as raised:
            ask(tmp_path / "run", **usual | changes)
    assert message in raised.value.message
    assert (tmp_path / "run" / "run.json").read_bytes() == before


def test_what_may_differ_goes_on_with_the_run(tmp_path: Path) -> None:
    with ChatServer(look) as server, ChatServer(look) as other:
        ask(tmp_path / "run", **behind(server, frames=3, families=("MoveCube",)))
        moved = behind(other, frames=3, cache=True, rollout_timeout=9.0, max_errors=2)
        moved |= {"model_options": ("repeats=1", "response_s=9")}
        result = ask(tmp_path / "run", conditions=("k0", "k1"), **moved, **SOME)
        assert len(server.seen) == 2 and len(other.seen) == 6
    assert result.planned == len(result.rows) == 8
    assert [start["policy"]["model"] for start in header(tmp_path / "run")["starts"]] == [
        {"model": "tiny"},
        {"model": "tiny"},
    ]


def test_other_questions_make_another_run(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "split")
    ask(tmp_path / "run", split=root)
    turned = [
        dataclasses.replace(
            one,
            options=one.options[::-1],
            answers=one.answers[::-1],
            right=len(one.options) - 1 - one.right,
        )
        for one in questions().values()
    ]
    write_questions(turned, root)
    with pytest.raises(RunFolderError, match="questions is"):
        ask(tmp_path / "run", split=root)
    told = header(tmp_path / "run")["identity"]["questions"]
    assert told == digest_questions(questions().values())
    # The ideal observer is right whatever the order, if it has seen all.
    full = ask(tmp_path / "full", split=root, sampling="full")
    assert full.counts["success"] == len(QUERIES)


@pytest.mark.usefixtures("world")
def test_questions_and_rollouts_are_not_mixed(tmp_path: Path) -> None:
    ask(tmp_path / "asked", **SOME)
    run_one(tmp_path / "rolled out")
    with pytest.raises(RunFolderError, match="simulator is 'questions' there"):
        run_one(tmp_path / "asked")
    with pytest.raises(RunFolderError, match="'questions' here"):
        ask(tmp_path / "rolled out", **SOME)


def test_shards_make_the_run(tmp_path: Path) -> None:
    whole = ask(tmp_path / "whole")
    parts = [tmp_path / f"part-{number}" for number in (1, 2)]
    for number, part in enumerate(parts, 1):
        ask(part, shard=f"{number}/2")
    merged = merge_runs(parts, tmp_path / "merged")
    assert untimed(merged.rows) == untimed(whole.rows)
    assert merged.missing == merged.double == ()
    assert ask(tmp_path / "merged").rows == merged.rows  # nothing is left to be asked


# --- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frames": 1}, "--frames 1"),
        ({"sampling": "windw"}, "--sampling 'windw' is none of full, framesamp, window"),
        ({"control": "blnk"}, "--control 'blnk' is none of none, blank, text"),
        ({"workers": 0}, "--workers 0"),
        ({"max_errors": 0}, "--max-errors 0"),
        ({"rollout_timeout": float("nan")}, "--rollout-timeout nan"),
        ({"rollout_timeout": float("inf")}, "--rollout-timeout inf"),
        ({"control": "blank"}, "--control says nothing of recall"),
        ({"prompt": "choise"}, "--prompt says nothing of recall"),
        ({"model_options": ("images=3",)}, "--model-option says nothing of recall"),
        ({"model": "guess", "frames": 8}, "--frames says nothing of guess"),
        ({"model": "guess", "retrieval": "thumbnail"}, "--retrieval says nothing of guess"),
        ({"model": "recal"}, "there is no model 'recal'; expected recall, guess, openai:URL"),
        ({"model": ""}, "there is no model ''"),
        ({"model": "opnai:http://h/v1#m", "system": "m"}, "there is no model 'opnai:"),
        ({"model": "openai:h/v1#m", "system": "m"}, "expected openai:URL#MODEL"),
        ({"model": "openai:http://h/v1#m", "system": "m", "prompt": "x"}, "no prompt 'x'"),
        ({"model": "openai:http://h/v1#m", "system": "m", "model_options": ("x=1",)}, "x"),
        ({"system": "a b"}, "not the name of a system"),
        ({"families": ("Movecube",)}, "family 'Movecube' is not in the split"),
        ({"episodes": "0-2"}, "no query episode VideoRepick/test/1"),
        ({"episode_split": "val"}, "has no val episode"),
        ({"conditions": ("k9",)}, "'k9' is not in"),
        ({"retrieval_rule": "last"}, "says nothing without a retrieval step"),
        ({"retrieval": "thumbnail", "conditions": ("no-history",)}, "nothing to retrieve from"),
        ({"retrieval": "thumbnail"}, "no embeddings of encoder 'thumbnail'"),
        ({"retrieval": "thumbnal"}, "thumbnal"),
    ],
)
def test_settings_are_checked_before_the_first_question(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(InterferenceError) as raised:
        ask(tmp_path / "run", **changes)
    assert words in raised.value.message
    assert not (tmp_path / "run").exists()


def test_where_answers_are_not_known_a_model_can_be_asked(tmp_path: Path) -> None:
    """Questions that others have made of other demonstrations, in the same format."""
    root = copy_split(tmp_path / "split")
    split = load_split(root)
    revision = split.datasets[DEMONSTRATIONS].identity.revision
    picture = questions()[MOVE].picture
    write_questions(
        [
            Question(episode, revision, "Which?", ("red", "blue"), (0, 1), 1, picture)
            for episode in split.episode_ids
        ],
        root,
    )
    assert len(read_questions(split)) == 3
    with pytest.raises(InvalidOptionError, match="recall does not know"):
        ask(tmp_path / "recall", split=root)
    with ChatServer(lambda seen: "B") as server:
        rows = ask(tmp_path / "run", split=root, **behind(server, frames=3)).rows
    assert [(row.status, row.chance) for row in rows] == [("success", 0.5)] * 3
    assert len(ask(tmp_path / "guess", split=root, model="guess").rows) == 3


def test_stale_or_damaged_questions_are_refused(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "split")
    (root / "questions.parquet").write_bytes(b"PAR1")
    with pytest.raises(FormatError, match="questions.parquet"):
        ask(tmp_path / "run", split=root)
    write_questions([dataclasses.replace(o, revision="0") for o in questions().values()], root)
    with pytest.raises(FormatError, match="other demonstrations"):
        ask(tmp_path / "run", split=root)
    assert not (tmp_path / "run").exists()


# --- the command -------------------------------------------------------------------------------


@pytest.fixture
def serial(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "make_executor", lambda config: Serial())


def words(out: Path, **options: Any) -> list[str]:
    usual = {"model": "recall", "split": TABLETOP, "out": out, "conditions": "k0"} | options
    return ["ask", *(str(word) for name, value in usual.items() for word in (f"--{name}", value))]


@pytest.mark.usefixtures("serial")
def test_the_command_prints_a_table_or_json(tmp_path: Path, run: Any) -> None:
    line = words(tmp_path / "run", families="MoveCube")
    code, out, _ = run(*line)
    assert code == 0 and f"2 of 2 questions in {tmp_path / 'run'}; chance is 33.3%" in out
    code, out, err = run(*line, "--json")
    assert code == 0 and err == ""
    assert [(row["answer"], row["status"]) for row in json.loads(out)] == [
        (right_letter(MOVE), "success"),
        (right_letter(EpisodeId("MoveCube", "test", 2)), "success"),
    ]
    started = header(tmp_path / "run")["starts"][0]["command"]
    assert started[0].startswith("robomme-interference ask --model recall")


@pytest.mark.usefixtures("serial")
def test_a_file_where_a_run_is_to_be_stays(tmp_path: Path, run: Any) -> None:
    (tmp_path / "file").write_text("mine")
    code, out, err = run(*words(tmp_path / "file"))
    assert (code, out) == (1, "")
    assert "Nothing was written yet" in err and "a folder is to be" in err
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.usefixtures("serial")
def test_what_broke_is_told_with_the_command_to_go_on(tmp_path: Path, run: Any) -> None:
    with ChatServer(look, faults=[BROKEN] * 9) as server:
        model = f"openai:{server.url}#tiny"
        options = {"model": model, "system": "tiny", "families": "MoveCube", "max-errors": 1}
        line = words(tmp_path / "run", **options, **{"model-option": "repeats=0"})
        code, _, err = run(*line)
        assert code == 1 and "Stopped: 1 in a row broke" in err and "1 questions broke" in err
        assert err.rstrip().splitlines()[-1].startswith("robomme-interference ask --model 'openai:")
        server.faults = []
        code, out, _ = run(*line)
    assert code == 0 and "2 of 2 questions" in out


@pytest.mark.usefixtures("serial")
def test_stopped_it_tells_how_to_go_on(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer(seen: Any) -> str:
        if len(server.seen) == 2:
            monkeypatch.setattr(endpoint.OpenAIModel, "reply", stop)
        return look(seen)

    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with ChatServer(answer) as server:
        model = f"openai:{server.url}#tiny"
        code, _, err = run(*words(tmp_path / "run", model=model, system="tiny", frames=3))
    assert code == 130 and f"Answers are in {tmp_path / 'run'}; go on with:\nrobomme-" in err
    assert len(read_record(tmp_path / "run")) == 2
    assert header(tmp_path / "run")["status"] == "incomplete"


@pytest.mark.usefixtures("serial")
def test_a_full_disk_names_the_file(tmp_path: Path, run: Any) -> None:
    with full_disk(4000):
        code, _, err = run(*words(tmp_path / "run"))
    assert code == 1 and "rollouts.jsonl" in err and "Traceback" not in err
    assert "once mended, go on with:\nrobomme-interference ask" in err
    kept = len(read_record(tmp_path / "run"))
    assert 0 < kept < len(QUERIES)
    code, out, _ = run(*words(tmp_path / "run"))
    assert code == 0 and f"{len(QUERIES)} of {len(QUERIES)} questions" in out


def test_help_tells_what_to_type() -> None:
    done = CliRunner().invoke(app, ["ask", "--help"])
    assert done.exit_code == 0
    for part in ("--sampling", "--control", "--model-option", "build questions SPLIT"):
        assert part in done.output
