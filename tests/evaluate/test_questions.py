"""Questions: what is shown of the past, who answers, and what makes a run of them."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import openai
import pytest
from support.asking import ask, behind, look, pixels, questions, right_letter
from support.buffer_sets import copy_buffer_set
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
from support.retrieval import make_index
from support.runs import header
from support.tabletop import LESSON, NOBODY, QUERIES, TABLETOP, copy_tabletop, scene_of, shown

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.questions import write_questions
from robomme_interference_data.constants import DEMONSTRATIONS, FAMILIES
from robomme_interference_data.data.questions import Question, digest_questions, read_questions
from robomme_interference_data.errors import (
    FormatError,
    InterferenceError,
    InvalidOptionError,
    RunError,
)
from robomme_interference_data.evaluate.models import openai as endpoint
from robomme_interference_data.evaluate.models.model import Reply
from robomme_interference_data.evaluate.questions.responders import Prompted, guess
from robomme_interference_data.evaluate.run import evaluation
from robomme_interference_data.evaluate.run.config import AskConfig
from robomme_interference_data.runtime.executor import Serial
from robomme_interference_data.storage.encode import decode_image

MOVE = QUERIES[FAMILIES.index("MoveCube") * 2]
UNIT = 32
ONE: dict[str, Any] = {"families": ("MoveCube",), "episodes": "0"}
FOUR = {"families": ("MoveCube", "PatternLock")}
FINE = ""  # no fault
SOME = {"families": ("VideoRepick", "MoveCube", "PatternLock")}
"""Where a model is asked, which takes its time."""


# --- who answers without a model ---------------------------------------------------------------


def test_who_has_seen_all_is_always_right(tmp_path: Path) -> None:
    result = ask(tmp_path / "run", sampling="full", conditions=("k0", "k1"))
    assert len(result.rows) == 2 * len(QUERIES)
    for row in result.rows:
        assert (row.status, row.success, row.answer) == (
            "success",
            True,
            right_letter(row.episode_id),
        )
        assert (row.system, row.simulator, row.steps) == ("questions-recall-full", "questions", 0)
        assert row.chance == questions()[row.episode_id].chance
        history = LESSON + UNIT * (row.condition == "k1")
        assert (row.history_frames, row.lesson_frames) == (history, LESSON)
        assert (row.evidence_kept, row.model_calls, row.error) == (1, None, None)
        assert row.goal and row.seed and row.difficulty in ("easy", "hard")
    assert not (tmp_path / "run" / "answers").exists()


def test_who_has_seen_nothing_draws(tmp_path: Path) -> None:
    """The last frame of a lesson, and no history at all: all options remain, as for a guess."""
    kept = {"sampling": "window", "frames": 2}
    recalled = ask(tmp_path / "recall", conditions=("no-history", "k0"), **kept)
    guessed = ask(tmp_path / "guess", model="guess", conditions=("no-history", "k0"))
    assert [row.answer for row in recalled.rows] == [row.answer for row in guessed.rows]
    assert {row.evidence_kept for row in recalled.rows} == {0, None}
    assert {row.system for row in guessed.rows} == {"questions-guess"}
    other = ask(tmp_path / "other", model="guess", conditions=("k0",), model_seed=1)
    assert [row.answer for row in other.rows] != [row.answer for row in guessed.rows[::2]]


def test_who_has_seen_a_part_draws_from_what_is_left(tmp_path: Path) -> None:
    # Of the lesson's frames the last 37: of a path's first target, frames 0 and 1, none is left.
    rows = ask(tmp_path / "run", sampling="window", frames=38).rows
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
        if len(fits) == 1:
            assert row.success
    assert {row.success for row in rows} == {True, False}


def test_guesses_are_right_by_chance() -> None:
    buffer_set = load_buffer_set(TABLETOP)
    hits, expected, variance = 0, 0.0, 0.0
    for episode, question in questions().items():
        for seed in range(100):
            asked = Prompted(
                question, buffer_set.query(episode), seed, None, lambda: np.empty(0, np.uint8)
            )
            hits += guess(asked) == question.letters[question.right]
            expected += question.chance
            variance += question.chance * (1 - question.chance)
    assert abs(hits - expected) < 3.5 * variance**0.5


# --- what a model is shown ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "kept"),
    [
        # The live observation has index 40 under k0, and 40 + 32 = 72 under k1.
        ({"frames": 5}, [0, 10, 20, 30]),  # linspace(0, 40, 5), without the last
        ({"frames": 2}, [0]),
        ({"frames": 5, "sampling": "window"}, [36, 37, 38, 39]),
        ({"frames": 3, "sampling": "window", "conditions": ("k1",)}, [70, 71]),
        ({}, [40 * j // 31 for j in range(31)]),
        ({"sampling": "full"}, [*range(40)]),
        ({"conditions": ("no-history",)}, []),
    ],
)
def test_the_kept_frames_and_no_others_are_sent(
    tmp_path: Path, settings: dict[str, Any], kept: list[int]
) -> None:
    with ChatServer(lambda seen: "B") as server:
        [row] = ask(tmp_path / "run", **ONE, **behind(server, **settings)).rows
        [seen] = server.seen
    buffer = load_buffer_set(TABLETOP).load(MOVE, row.condition)
    expected = buffer.frames("front")
    assert len(seen.images) == len(kept) + 1
    for image, place in zip(seen.images, kept, strict=False):
        assert np.array_equal(image, expected[place])
    # So that the test says what it seems to: frames are told apart by their pixels.
    units = [place for place in kept if place >= LESSON]
    numbers = [(place, 2 * FAMILIES.index("MoveCube")) for place in kept if place < LESSON]
    assert [pixel[:2] for pixel in pixels(seen)] == [
        *numbers,
        *[(8 * (place - LESSON) if place < LESSON + 5 else 255, NOBODY) for place in units],
    ]
    question = questions()[MOVE]
    assert np.array_equal(seen.images[-1], decode_image(question.picture))
    assert buffer.query.goal in seen.text and question.text in seen.text
    for letter, words in zip("ABC", question.options, strict=True):
        assert f"{letter}: {words}\n" in seen.text
    assert (row.history_frames, row.answer) == (len(buffer), "B")


def test_frames_that_the_model_cannot_take_are_refused(tmp_path: Path) -> None:
    with ChatServer(lambda seen: "B") as server:
        for settings in ({"frames": 6}, {"sampling": "full"}):
            options = behind(server, model_options=("images=5",), **settings)
            with pytest.raises(InvalidOptionError, match="the model takes 5 images at most"):
                ask(tmp_path / "run", **ONE, **options)
        assert not (tmp_path / "run").exists()
        for changes in ({"frames": 5}, {"frames": 9, "control": "text"}):
            options = behind(server, model_options=("images=5",), **changes)
            assert ask(tmp_path / str(changes["frames"]), **ONE, **options).counts["error"] == 0


def test_who_looks_is_right_where_evidence_was_kept(tmp_path: Path) -> None:
    with ChatServer(look) as server:
        settings = behind(server, conditions=("no-history", "k0", "k1"), frames=4)
        rows = ask(tmp_path / "run", **SOME, **settings).rows
    for row in rows:
        assert row.success == bool(row.evidence_kept)
        assert row.answer == (right_letter(row.episode_id) if row.success else None)
        assert (row.model_calls, row.model_tokens) == (1, 105)
        assert row.model_faults == (not row.success) and row.model_s is not None
    assert {row.success for row in rows if row.condition == "k0"} == {True}
    assert {row.success for row in rows if row.condition == "no-history"} == {False}


def test_controls_hide_the_past_or_all_images(tmp_path: Path) -> None:
    with ChatServer(look) as server:
        rows = ask(tmp_path / "blank", **behind(server, control="blank", frames=4), **SOME).rows
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
    assert sum(row.success or False for row in rows) == sum(
        right_letter(row.episode_id) == "C" for row in rows
    )


def test_retrieval_in_front(tmp_path: Path) -> None:
    buffer_set = copy_tabletop(tmp_path / "buffer_set")
    make_index(buffer_set)
    found = {}
    with ChatServer(look) as server:
        for rule in ("oracle", "last"):
            settings = {"retrieval": "thumbnail", "retrieval_rule": rule, "sampling": "full"}
            settings |= {"buffer_set": buffer_set, "conditions": ("k1",), "families": ("MoveCube",)}
            rows = ask(tmp_path / rule, **behind(server, **settings)).rows
            found[rule] = {(row.success, row.lesson_frames) for row in rows}
            own = ask(tmp_path / f"recall-{rule}", **settings).rows
            assert {row.system for row in own} == {f"retrieval-questions-recall-full-{rule}"}
            assert {row.retrieval_model for row in rows} == {row.retrieval_model for row in own}
            assert all(row.retrieval_model for row in rows)
            if rule == "oracle":
                assert {len(seen.images) for seen in server.seen} == {LESSON + 1}
                assert {row.history_frames for row in rows} == {LESSON}
                assert all(row.success for row in own)
    assert found == {"oracle": {(True, LESSON)}, "last": {(False, 0)}}


def test_what_was_asked_and_answered_is_kept_to_be_read(tmp_path: Path) -> None:
    with ChatServer(lambda seen: "Half of a character: \ud800. The answer is A.") as server:
        ask(tmp_path / "run", **behind(server, frames=5), families=("MoveCube",))
    files = sorted((tmp_path / "run" / "answers").iterdir())
    assert [path.name for path in files] == ["MoveCube_test_0_k0.jsonl", "MoveCube_test_2_k0.jsonl"]
    [line] = map(json.loads, files[0].read_text().splitlines())
    assert line["question"] == questions()[MOVE].text
    assert (line["answer"], line["right"]) == ("A", right_letter(MOVE))
    assert "[video of 4 frames]" in line["prompt"] and "[image]" in line["prompt"]
    assert line["text"].endswith("The answer is A.")


def test_a_prompt_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(
        'system = "s"\nquestion = "<picture><history>{goal}|{question}|{options}|say A"\n'
    )
    with ChatServer(lambda seen: seen.text[-1]) as server:
        [row] = ask(tmp_path / "run", **ONE, **behind(server, prompt=str(path), frames=2)).rows
        [seen] = server.seen
    assert row.answer == "A" and seen.text.endswith("hooks the cube|say A")
    assert np.array_equal(seen.images[0], decode_image(questions()[MOVE].picture))


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


def test_an_endpoint_that_is_gone_for_good_stops_the_run(tmp_path: Path) -> None:
    for fault in (BUSY_FOR_AN_HOUR, LOCKED, GONE):
        with ChatServer(look, faults=[fault] * 9) as server:
            settings = behind(server, frames=3, max_errors=3, **FOUR)
            result = ask(tmp_path / "run", **settings)
            assert len(server.seen) == 3
        assert result.stopped is not None and result.stopped.startswith("3 in a row broke")
        assert [row.status for row in result.rows] == ["error"] * 3
    with ChatServer(look) as server:
        assert ask(tmp_path / "run", **settings | behind(server)).counts["success"] == 4


def test_a_token_count_that_no_file_can_hold_is_a_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with ChatServer(look) as server:
        monkeypatch.setattr(
            endpoint.OpenAIModel, "reply", lambda *_: Reply("The answer is A.", 10**30, 1, 0.1)
        )
        (row,) = ask(tmp_path / "run", **behind(server), **ONE).rows
    assert (row.answer, row.model_tokens, row.model_faults) == ("A", None, 1)


def test_a_damaged_picture_breaks_its_question_alone(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")
    damaged = [
        dataclasses.replace(one, picture=one.picture[:500]) if one.episode_id == MOVE else one
        for one in questions().values()
    ]
    write_questions(damaged, root)
    with ChatServer(look) as server:
        rows = ask(tmp_path / "run", buffer_set=root, **behind(server, frames=3, **FOUR)).rows
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
        *("system", "buffer_set", "split", "model_seed"),
    }
    plan = {"families", "episodes", "conditions", "shard"}
    who = {"workers", "executor", "ray_address", "cpus_per_worker", "gpus_per_worker"}
    may_differ = who | {"out", "no_resume", "cache", "rollout_timeout_s", "max_errors"}
    fields = {field.name for field in dataclasses.fields(AskConfig)}
    assert makes_the_run | plan | may_differ == fields


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": 5}, "frames is 3 there, 5 here"),
        ({"control": "blank"}, "control is 'none' there, 'blank' here"),
        ({"model_options": ("max_tokens=9",)}, "max_tokens is 256 there, 9 here"),
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
        with pytest.raises(RunError, match="holds another run") as raised:
            ask(tmp_path / "run", **usual | changes)
    assert message in raised.value.message
    assert (tmp_path / "run" / "run.json").read_bytes() == before


def test_what_may_differ_goes_on_with_the_run(tmp_path: Path) -> None:
    with ChatServer(look) as server, ChatServer(look) as other:
        ask(tmp_path / "run", **behind(server, frames=3, families=("MoveCube",)))
        moved = behind(other, frames=3, cache=True, rollout_timeout_s=9.0, max_errors=2)
        moved |= {"model_options": ("repeats=1", "response_s=9")}
        result = ask(tmp_path / "run", conditions=("k0", "k1"), **moved, **FOUR)
        assert len(server.seen) == 2 and len(other.seen) == 6
    assert result.planned == len(result.rows) == 8
    assert [start["policy"]["model"] for start in header(tmp_path / "run")["starts"]] == [
        {"model": "tiny"},
        {"model": "tiny"},
    ]


def test_other_questions_make_another_run(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")
    ask(tmp_path / "run", buffer_set=root)
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
    with pytest.raises(RunError, match="questions is"):
        ask(tmp_path / "run", buffer_set=root)
    told = header(tmp_path / "run")["identity"]["questions"]
    assert told == digest_questions(questions().values())
    # The ideal observer is right whatever the order, if it has seen all.
    full = ask(tmp_path / "full", buffer_set=root, sampling="full")
    assert full.counts["success"] == len(QUERIES)


# --- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"frames": 1}, "frames 1"),
        ({"control": "blnk"}, "control 'blnk' is none of none, blank, text"),
        ({"rollout_timeout_s": float("nan")}, "rollout_timeout_s nan"),
        ({"control": "blank"}, "`control` has no effect on recall"),
        ({"model": "guess", "frames": 8}, "`frames` has no effect on guess"),
        ({"model": "recal"}, "there is no model 'recal'; expected recall, guess, openai:URL"),
        ({"model": "openai:h/v1#m", "system": "m"}, "expected openai:URL#MODEL"),
        ({"model": "openai:http://h/v1#m", "system": "m", "prompt": "x"}, "no prompt or file 'x'"),
        ({"retrieval_rule": "last"}, "has no effect without a retrieval step"),
        ({"retrieval": "thumbnail", "conditions": ("no-history",)}, "nothing to retrieve from"),
        ({"retrieval": "thumbnail"}, "no embeddings of encoder 'thumbnail'"),
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
    root = copy_buffer_set(tmp_path / "buffer_set")
    buffer_set = load_buffer_set(root)
    revision = buffer_set.datasets[DEMONSTRATIONS].identity.revision
    picture = questions()[MOVE].picture
    write_questions(
        [
            Question(episode, revision, "Which?", ("red", "blue"), (0, 1), 1, picture)
            for episode in buffer_set.episode_ids
        ],
        root,
    )
    assert len(read_questions(buffer_set)) == 3
    with pytest.raises(InvalidOptionError, match="recall does not know"):
        ask(tmp_path / "recall", buffer_set=root)
    with ChatServer(lambda seen: "B") as server:
        rows = ask(tmp_path / "run", buffer_set=root, **behind(server, frames=3)).rows
    assert [(row.status, row.chance) for row in rows] == [("success", 0.5)] * 3
    assert len(ask(tmp_path / "guess", buffer_set=root, model="guess").rows) == 3


def test_stale_or_damaged_questions_are_refused(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")
    (root / "questions.parquet").write_bytes(b"PAR1")
    with pytest.raises(FormatError, match="questions.parquet"):
        ask(tmp_path / "run", buffer_set=root)
    write_questions([dataclasses.replace(o, revision="0") for o in questions().values()], root)
    with pytest.raises(FormatError, match="other demonstrations"):
        ask(tmp_path / "run", buffer_set=root)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"system": "oracle"}, "oracle is the name of another system"),
        ({"system": "questions-recall-full"}, "another system than recall"),
        ({"model": "openai:http://h/v1#m"}, "need a name"),
        # Sound names: what is refused is what comes after them.
        ({"system": "questions-recall-framesamp"}, "'Nothing'"),
        ({"model": "guess", "system": "questions-guess"}, "'Nothing'"),
    ],
)
def test_names_belong_to_what_answers(tmp_path: Path, given: dict[str, str], words: str) -> None:
    with pytest.raises(InterferenceError, match=words):
        ask(tmp_path / "run", families=("Nothing",), **given)


def test_the_command_prints_results_and_how_to_resume(
    tmp_path: Path, run: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "make_executor", lambda config: Serial())
    with ChatServer(look, faults=[BROKEN] * 9) as server:
        usual = {"model": f"openai:{server.url}#tiny", "system": "tiny", "families": "MoveCube"}
        usual |= {"out": tmp_path / "run", "conditions": "k0", "max-errors": 1}
        usual |= {"model-option": "repeats=0"}
        line = [
            "ask",
            str(TABLETOP),
            *(str(word) for one in usual.items() for word in (f"--{one[0]}", one[1])),
        ]
        code, _, err = run(*line)
        assert code == 1 and "Stopped: 1 in a row broke" in err and "1 questions broke" in err
        assert (
            err.rstrip()
            .splitlines()[-1]
            .startswith(f"robomme-interference ask {TABLETOP} --model 'openai:")
        )
        server.faults = []
        code, out, _ = run(*line)
    assert code == 0 and "2 of 2 questions" in out and "chance is 33.3%" in out
