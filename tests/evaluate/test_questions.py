"""Questions: which frames are sent, who answers, endpoints with faults, and errors."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.asking import ask, behind, look, questions, right_letter
from support.buffer_sets import copy_buffer_set
from support.chat_server import BROKEN, ChatServer
from support.messages import raises
from support.retrieval import make_index
from support.tabletop import LESSON, QUERIES, TABLETOP, copy_tabletop, scene_of, shown

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.questions import write_questions
from robomme_interference_data.constants import DEMONSTRATIONS, FAMILIES
from robomme_interference_data.data.questions import NOT_SHOWN, Question
from robomme_interference_data.errors import InterferenceError, InvalidOptionError
from robomme_interference_data.evaluate.language.questions import Prompted, abstain, guess, recall
from robomme_interference_data.evaluate.run import evaluation
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.storage.video.encode import decode_image

pytestmark = pytest.mark.usefixtures("fast_retries")

MOVE = QUERIES[FAMILIES.index("MoveCube") * 2]
UNIT = 32
NO_HISTORY: Any = None  # guesses read none
ONE: dict[str, Any] = {"families": ("MoveCube",), "episodes": "0"}
FOUR = {"families": ("MoveCube", "PatternLock")}
SOME = {"families": ("VideoRepick", "MoveCube", "PatternLock")}
"""Fewer families where a model answers, which is slow."""


# --- who answers without a model ---------------------------------------------------------------


def test_recall_of_everything_is_always_right(tmp_path: Path) -> None:
    result = ask(tmp_path / "run", memory="full", conditions=("k0", "k1"))
    assert len(result.rows) == 2 * len(QUERIES)
    for row in result.rows:
        assert (row.success, row.answer) == (True, right_letter(row.episode_id))
        assert (row.system, row.simulator, row.steps) == ("questions-recall-full", "questions", 0)
        assert row.chance == questions()[row.episode_id].chance
        history = LESSON + UNIT * (row.condition == "k1")
        assert (row.history_frames, row.lesson_frames) == (history, LESSON)
        assert (row.evidence_kept, row.model_calls, row.error) == (1, None, None)
        assert row.goal and row.seed and row.difficulty in ("easy", "hard")
    assert not (tmp_path / "run" / "answers").exists()


def test_recall_of_nothing_draws_as_a_guess_does(tmp_path: Path) -> None:
    """With the last frame of a lesson, or without history, all options remain."""
    kept = {"memory": "window:2"}
    recalled = ask(tmp_path / "recall", conditions=("no-history", "k0"), **kept)
    guessed = ask(tmp_path / "guess", model="guess", conditions=("no-history", "k0"))
    assert [row.answer for row in recalled.rows] == [row.answer for row in guessed.rows]
    assert {row.evidence_kept for row in recalled.rows} == {0, None}
    assert {row.system for row in guessed.rows} == {"questions-guess"}
    other = ask(tmp_path / "other", model="guess", conditions=("k0",), model_seed=1)
    assert [row.answer for row in other.rows] != [row.answer for row in guessed.rows[::2]]


def test_recall_of_a_part_draws_from_the_remaining_options(tmp_path: Path) -> None:
    # Of the lesson's frames the last 37: of a path's first target, frames 0 and 1, none is left.
    rows = ask(tmp_path / "run", memory="window:38").rows
    for row in rows:
        scene, answer = scene_of(row.episode_id)
        parts = scene.parts(answer)
        known = {part: parts[part] for seen in shown(len(parts))[3:] for part in seen}
        left = {scene.choice(one) for one in scene.agreeing(known)}
        question = questions()[row.episode_id]
        fits = {
            letter
            for letter, number in zip(question.letters, question.answers, strict=True)
            if scene.choice(scene.answers[number]) in left
        }
        assert row.answer in fits and right_letter(row.episode_id) in fits
        assert row.evidence_kept == (len(parts) - 1) / len(parts)
    assert {row.success for row in rows} == {True, False}


def test_guesses_are_right_by_chance() -> None:
    buffer_set = load_buffer_set(TABLETOP)
    hits, expected, variance = 0, 0.0, 0.0
    for episode, question in questions().items():
        for seed in range(100):
            prompted = Prompted(question, buffer_set.query(episode), seed, None, NO_HISTORY)
            hits += guess(prompted) == question.letters[question.right]
            expected += question.chance
            variance += question.chance * (1 - question.chance)
    assert abs(hits - expected) < 3.5 * variance**0.5


def test_an_observer_of_a_day_that_saw_nothing_says_so() -> None:
    buffer_set = load_buffer_set(TABLETOP)
    for episode, plain in questions().items():
        question = dataclasses.replace(
            plain,
            options=(*plain.options, "it was not shown"),
            answers=(*plain.answers, NOT_SHOWN),
            points=(*plain.points, ""),
        )
        query = buffer_set.query(episode)
        everything = {span.part: span.text for span in query.record.evidence or ()}
        last = question.letters[-1]
        for known, right in (({}, last), (everything, question.letters[question.right])):
            assert recall(Prompted(question, query, 0, known, NO_HISTORY)) == right
        assert abstain(Prompted(question, query, 0, everything, NO_HISTORY)) == last
        with pytest.raises(InvalidOptionError):
            abstain(Prompted(plain, query, 0, {}, NO_HISTORY))


# --- which frames a model gets -----------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "kept"),
    [
        # The live observation has index 40 under k0, and 40 + 32 = 72 under k1.
        ({"memory": "framesamp:5"}, [0, 10, 20, 30]),  # linspace(0, 40, 5), without the last
        ({"memory": "window:3", "conditions": ("k1",)}, [70, 71]),
        ({"memory": "full"}, [*range(40)]),
        ({"conditions": ("no-history",)}, []),
    ],
)
def test_exactly_the_kept_frames_are_sent(
    tmp_path: Path, settings: dict[str, Any], kept: list[int]
) -> None:
    with ChatServer(lambda seen: "B") as server:
        [row] = ask(tmp_path / "run", **ONE, **behind(server, **settings)).rows
        [seen] = server.seen
    buffer = load_buffer_set(TABLETOP).load(MOVE, row.condition)
    frames = buffer.frames("front")
    assert len(seen.images) == len(kept) + 1
    assert all(np.array_equal(one, frames[at]) for one, at in zip(seen.images, kept, strict=False))
    question = questions()[MOVE]
    assert np.array_equal(seen.images[-1], decode_image(question.picture))
    assert buffer.query.goal in seen.text and question.text in seen.text
    for letter, words in zip("ABC", question.options, strict=True):
        assert f"{letter}: {words}\n" in seen.text
    assert (row.history_frames, row.answer) == (len(buffer), "B")


def test_more_frames_than_the_model_takes_are_an_error(tmp_path: Path) -> None:
    with ChatServer(lambda seen: "B") as server:
        for settings in ({"memory": "framesamp:6"}, {"memory": "full"}):
            options = behind(server, model_options=("images=5",), **settings)
            with raises(InvalidOptionError):
                ask(tmp_path / "run", **ONE, **options)
        assert not (tmp_path / "run").exists()
        for changes in ({"memory": "framesamp:5"}, {"memory": "framesamp:9", "control": "text"}):
            options = behind(server, model_options=("images=5",), **changes)
            assert ask(tmp_path / changes["memory"], **ONE, **options).counts["error"] == 0


@pytest.mark.slow
def test_a_model_that_looks_is_right_where_evidence_was_kept(tmp_path: Path) -> None:
    with ChatServer(look) as server:
        settings = behind(server, conditions=("no-history", "k0", "k1"), memory="framesamp:4")
        rows = ask(tmp_path / "run", **SOME, **settings).rows
    for row in rows:
        assert row.success == bool(row.evidence_kept)
        assert row.answer == (right_letter(row.episode_id) if row.success else None)
        assert (row.model_calls, row.model_tokens) == (1, 105)
        assert row.model_faults == (not row.success) and row.model_s is not None
    assert {row.success for row in rows if row.condition == "k0"} == {True}
    assert {row.success for row in rows if row.condition == "no-history"} == {False}


@pytest.mark.slow
def test_controls_hide_the_past_or_all_images(tmp_path: Path) -> None:
    with ChatServer(look) as server:
        rows = ask(
            tmp_path / "blank", **behind(server, control="blank", memory="framesamp:4"), **SOME
        ).rows
        assert {(row.status, row.model_faults) for row in rows} == {("fail", 1)}
        for seen in server.seen:
            *history, picture = seen.images
            assert len(history) == 3 and all((image == 128).all() for image in history)
            assert history[0].shape == (256, 256, 3) and picture.shape[0] > 256
        server.seen.clear()
        server.answer = lambda seen: "C"
        rows = ask(tmp_path / "text", **behind(server, control="text"), **SOME).rows
        assert [seen.images for seen in server.seen] == [[]] * len(rows)
        assert all(seen.text.count("none") == 2 for seen in server.seen)
    assert all(row.success == (right_letter(row.episode_id) == "C") for row in rows)


def test_a_retrieval_step(tmp_path: Path) -> None:
    buffer_set = copy_tabletop(tmp_path / "buffer_set")
    make_index(buffer_set)
    found = {}
    with ChatServer(look) as server:
        for rule, whole in (("oracle", "oracle"), ("last", "last/adaptive")):
            settings = {"retrieval": "thumbnail", "retrieval_rule": rule, "memory": "full"}
            settings |= {"buffer_set": buffer_set, "conditions": ("k1",), "families": ("MoveCube",)}
            rows = ask(tmp_path / rule, **behind(server, **settings)).rows
            found[rule] = {(row.success, row.lesson_frames) for row in rows}
            recalled = ask(tmp_path / f"recall-{rule}", **settings).rows
            assert {row.system for row in recalled} == {f"retrieval-questions-recall-full-{rule}"}
            assert {row.retrieval for row in (*rows, *recalled)} == {f"thumbnail/{whole}"}
            if rule == "oracle":
                assert {len(seen.images) for seen in server.seen} == {LESSON + 1}
                assert all(row.success for row in recalled)
    assert found == {"oracle": {(True, LESSON)}, "last": {(False, 0)}}


def test_prompts_and_answers_are_written(tmp_path: Path) -> None:
    with ChatServer(lambda seen: "Half of a character: \ud800. The answer is A.") as server:
        ask(tmp_path / "run", **behind(server, memory="framesamp:5"), families=("MoveCube",))
    files = sorted((tmp_path / "run" / "answers").iterdir())
    assert [path.name for path in files] == ["MoveCube_test_0_k0.jsonl", "MoveCube_test_2_k0.jsonl"]
    [line] = map(json.loads, files[0].read_text().splitlines())
    assert line["question"] == questions()[MOVE].text
    assert (line["answer"], line["right"]) == ("A", right_letter(MOVE))
    assert "[video of 4 frames]" in line["prompt"] and "[image]" in line["prompt"]
    assert line["text"].endswith("The answer is A.")


# --- an endpoint with faults -------------------------------------------------------------------


def test_a_damaged_picture_breaks_only_its_question(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")
    damaged = [
        dataclasses.replace(one, picture=one.picture[:500]) if one.episode_id == MOVE else one
        for one in questions().values()
    ]
    write_questions(damaged, root)
    with ChatServer(look) as server:
        rows = ask(
            tmp_path / "run", buffer_set=root, **behind(server, memory="framesamp:3", **FOUR)
        ).rows
    broken, *others = rows
    assert broken.episode_id == MOVE and "MoveCube/test/0: an image is damaged" in str(broken.error)
    assert [row.status for row in others] == ["success"] * 3


# --- errors ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"memory": "window:1"}, "window:1"),
        ({"control": "blnk"}, "control 'blnk' is none of none, blank, text"),
        ({"control": "blank"}, "`control` has no effect on recall"),
        ({"model": "guess", "memory": "window"}, "`memory` has no effect on guess"),
        ({"model": "recal"}, "there is no model 'recal'; expected recall, abstain, guess"),
        ({"model": "openai:http://h/v1#m", "system": "m", "prompt": "x"}, "no prompt or file 'x'"),
        ({"retrieval": "thumbnail", "conditions": ("no-history",)}, "nothing to retrieve from"),
    ],
)
def test_settings_are_checked_before_the_first_question(
    tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    with pytest.raises(InterferenceError) as raised:
        ask(tmp_path / "run", **changes)
    assert words in raised.value.message
    assert not (tmp_path / "run").exists()


def test_a_model_answers_questions_whose_options_recall_does_not_know(tmp_path: Path) -> None:
    """Questions of another author about other demonstrations, in the same format."""
    root = copy_buffer_set(tmp_path / "buffer_set")
    buffer_set = load_buffer_set(root)
    revision = buffer_set.datasets[DEMONSTRATIONS].identity.revision
    others = revision, "Which?", ("red", "blue"), (0, 1), 1, ("", ""), questions()[MOVE].picture
    write_questions([Question(episode, *others) for episode in buffer_set.episode_ids], root)
    with raises(InvalidOptionError):
        ask(tmp_path / "recall", buffer_set=root)
    with ChatServer(lambda seen: "B") as server:
        rows = ask(tmp_path / "run", buffer_set=root, **behind(server, memory="framesamp:3")).rows
    assert [(row.status, row.chance) for row in rows] == [("success", 0.5)] * 3
    assert len(ask(tmp_path / "guess", buffer_set=root, model="guess").rows) == 3


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"system": "oracle"}, "oracle is the name of another system"),
        ({"system": "questions-recall-full"}, "another system than recall"),
        ({"model": "openai:http://h/v1#m"}, "need a name"),
        ({"system": "questions-recall-framesamp"}, "'Nothing'"),  # this name is valid
    ],
)
def test_a_name_of_the_table_needs_its_model(
    tmp_path: Path, given: dict[str, str], words: str
) -> None:
    with pytest.raises(InterferenceError, match=words):
        ask(tmp_path / "run", families=("Nothing",), **given)


@pytest.mark.slow
def test_the_command_prints_results_and_how_to_resume(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "make_executor", lambda config: Serial())
    with ChatServer(look, faults=[BROKEN] * 9) as server:
        line = f"ask {TABLETOP} --model openai:{server.url}#tiny --system tiny --families MoveCube"
        line += (
            f" --out {tmp_path / 'run'} --conditions k0 --set max_errors=1 --model-option repeats=0"
        )
        code, _, err = run(*line.split())
        assert code == 1 and "Stopped: 1 in a row broke" in err and "1 question broke" in err
        resume = err.rstrip().splitlines()[-1]
        assert resume.startswith(f"robomme-interference ask {TABLETOP} --model 'openai:")
        server.faults = []
        code, out, _ = run(*line.split())
    assert code == 0 and "2 of 2 questions" in out and "chance is 33.3%" in out
