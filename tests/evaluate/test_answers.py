"""The policy `answers`: rollouts carry out what a run of questions answered."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from support import worlds
from support.asking import ask, questions
from support.messages import raises
from support.runs import header
from support.tabletop import TABLETOP, copy_tabletop

from robomme_interference_data.data.questions import NOT_SHOWN, read_questions
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.evaluate import RunConfig, RunResult, run_evaluation
from robomme_interference_data.evaluate.policies.answers import chosen_answer
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.schema.rollouts import Status

FEW: dict[str, Any] = {"families": ("MoveCube", "PatternLock")}
LOCK = EpisodeId("PatternLock", "test", 0)


@pytest.fixture(autouse=True)
def world(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(worlds.BUFFER_SET, str(TABLETOP))


@pytest.fixture
def right(tmp_path: Path) -> Path:
    """A run whose answers are all right."""
    return ask(tmp_path / "right", memory="full", conditions=("k0", "k1"), **FEW).folder


def act_out(out: Path, answers: Path, **changes: Any) -> RunResult:
    usual: dict[str, Any] = {
        **{"policy": f"answers:{answers}", "buffer_set": TABLETOP, "system": "acted"},
        **{"simulator": "support.worlds:Scripted", "conditions": ("k0",), **FEW},
    }
    return run_evaluation(RunConfig(out=out, **usual | changes), executor=Serial())


def change(run: Path, **changes: Any) -> Path:
    """Change the rows of PatternLock/test/0 in a run's record."""
    record = run / "rollouts.jsonl"
    rows = [json.loads(line) for line in record.read_text().splitlines()]
    for row in rows:
        if (row["family"], row["episode"]) == (LOCK.family, LOCK.index):
            row.update(changes)
    record.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return run


def wrong_letter() -> str:
    question = questions()[LOCK]
    return question.letters[(question.right + 1) % len(question.letters)]


@pytest.mark.slow
def test_right_answers_succeed_and_wrong_ones_fail(tmp_path: Path, right: Path) -> None:
    result = act_out(tmp_path / "acted", right, conditions=("k0", "k1"))
    assert [(row.system, row.success) for row in result.rows] == 8 * [("acted", True)]
    change(right, answer=wrong_letter(), success=False, status="fail")
    result = act_out(tmp_path / "wrong", right)
    assert {str(row.episode_id): row.status for row in result.rows} == {
        **{"MoveCube/test/0": "success", "MoveCube/test/2": "success"},
        **{"PatternLock/test/0": "fail", "PatternLock/test/2": "success"},
    }


def test_without_a_choice_it_holds_its_pose_until_the_timeout(tmp_path: Path, right: Path) -> None:
    change(right, answer=None, success=False, status="fail")
    one = {"families": ("PatternLock",), "episodes": "0"}
    (row,) = act_out(tmp_path / "acted", right, **one).rows
    assert (row.status, row.success, row.steps) == ("timeout", False, 1300)


def test_a_question_that_broke_is_an_error_until_it_is_answered(
    tmp_path: Path, right: Path
) -> None:
    letter = questions()[LOCK].letters[questions()[LOCK].right]
    change(right, answer=None, success=None, status="error", error="it broke")
    result = act_out(tmp_path / "acted", right)
    assert result.counts == {"success": 3, "fail": 0, "timeout": 0, "error": 1}
    (error,) = [row.error for row in result.rows if row.error]
    assert "PatternLock/test/0 under k0 broke" in error and "Resume the run of questions" in error
    change(right, answer=letter, success=True, status="success", error=None)
    result = act_out(tmp_path / "acted", right)
    assert result.counts == {"success": 4, "fail": 0, "timeout": 0, "error": 0}


def test_rows_in_a_csv_file(tmp_path: Path, right: Path) -> None:
    table = right / "rollouts.csv"
    assert act_out(tmp_path / "acted", table).counts["success"] == 4
    identity = header(tmp_path / "acted")["identity"]
    assert (
        identity["policy"] == "answers"
        and len(identity["policy_metadata"]["answers"]["sha256"]) == 64
    )
    rows = table.read_text().splitlines(keepends=True)
    for damaged in (
        [*rows, rows[-1]],
        [f"{row.rstrip()},{row}" for row in rows],
        ["a,b\n", "1\n"],
        ["a\n", "1\n"],
    ):
        (tmp_path / "damaged.csv").write_text("".join(damaged))
        with raises(InterferenceError):
            act_out(tmp_path / "no", tmp_path / "damaged.csv")


def test_the_example_writes_truth_values_like_python(tmp_path: Path, right: Path) -> None:
    with (right / "rollouts.csv").open(newline="") as file:
        rows = [row | {"success": row["success"].title()} for row in csv.DictReader(file)]
    with (tmp_path / "k0.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    assert act_out(tmp_path / "acted", tmp_path / "k0.csv").counts["success"] == 4


def test_the_run_of_questions_identifies_the_rollouts(tmp_path: Path, right: Path) -> None:
    act_out(tmp_path / "acted", right)
    identity = header(tmp_path / "acted")["identity"]
    assert identity["policy_metadata"]["answers"] == header(right)["identity"]
    assert str(tmp_path) not in json.dumps(identity)
    moved = right.rename(tmp_path / "moved")
    act_out(tmp_path / "acted", moved)  # resumes
    other = ask(tmp_path / "other", memory="window", **FEW).folder
    with raises(InterferenceError):
        act_out(tmp_path / "acted", other)


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes",
    [
        {"conditions": ("no-history",)},
        {"families": ("VideoRepick",)},
        {"model_seed": 1},
        {"retrieval": "thumbnail"},
        {"subgoals": "oracle"},
        {"system": None},
        {"system": "oracle"},
        {"offline": True, "simulator": "tabletop"},
        {"policy": "answers:nowhere"},
        {"policy": "answers"},
    ],
)
def test_rollouts_that_nothing_answers(
    tmp_path: Path, right: Path, changes: dict[str, Any]
) -> None:
    with raises(InterferenceError):
        act_out(tmp_path / "acted", right, **changes)
    assert not (tmp_path / "acted").exists()


def test_other_runs_and_other_questions(tmp_path: Path, right: Path) -> None:
    (tmp_path / "empty").mkdir()
    with raises(InterferenceError):
        act_out(tmp_path / "acted", tmp_path / "empty")
    rollouts = act_out(tmp_path / "rollouts", right).folder
    for path in (rollouts, rollouts / "rollouts.csv"):
        with raises(InterferenceError):
            act_out(tmp_path / "acted", path)
    copy = copy_tabletop(tmp_path / "buffers")
    from robomme_interference_data.build_dataset.questions import write_questions
    from robomme_interference_data.data.loading import load_buffer_set

    changed = [
        replace(one, text=one.text + "?") for one in read_questions(load_buffer_set(copy)).values()
    ]
    write_questions(changed, copy)
    with raises(InterferenceError):
        act_out(tmp_path / "acted", right, buffer_set=copy)
    record = right / "rollouts.jsonl"
    revision = json.loads(record.read_text().splitlines()[0])["revision"]
    record.write_text(record.read_text().replace(revision, "f" * len(revision)))
    with raises(InterferenceError):
        act_out(tmp_path / "acted", right)


def test_the_answer_that_a_row_chose(right: Path) -> None:
    from robomme_interference_data.evaluate.run.log import read_run

    question = questions()[LOCK]
    rows = [row for row in read_run(right)[1].values() if row.episode_id == LOCK]
    row = min(rows, key=lambda row: row.condition)
    assert chosen_answer(row, question) == question.answers[question.right]
    wrong = replace(row, answer=wrong_letter(), success=False, status=str(Status.FAIL))
    index = (question.right + 1) % len(question.letters)
    assert chosen_answer(wrong, question) == question.answers[index]
    assert chosen_answer(replace(wrong, answer=None), question) is None
    in_day = replace(
        question,
        options=(*question.options, "it was not shown"),
        answers=(*question.answers, NOT_SHOWN),
        points=(*question.points, ""),
    )
    assert chosen_answer(replace(wrong, answer=in_day.letters[-1]), in_day) is None
    no_choice = chosen_answer(replace(wrong, answer=None), in_day)
    assert no_choice in {*question.answers} - {question.answers[question.right]}
    for other in (replace(row, answer=wrong_letter()), replace(wrong, answer="H")):
        if "H" not in question.letters or other.answer != "H":
            with raises(InterferenceError):
                chosen_answer(other, question)
