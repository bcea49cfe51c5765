"""Questions that are asked: what is kept and shown of the past, and what the rows say."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.asking import ask, behind, look, pixels, questions, right_letter
from support.chat_server import ChatServer
from support.retrieval import make_index
from support.runs import untimed
from support.tabletop import LESSON, NOBODY, QUERIES, TABLETOP, copy_tabletop, scene_of, shown

from robomme_interference_data import load_split
from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.questions.answers import Asked, Guesser
from robomme_interference_data.runtime.executor import Processes
from robomme_interference_data.storage.encode import decode_image

MOVE = QUERIES[FAMILIES.index("MoveCube") * 2]
UNIT = 32
ONE: dict[str, Any] = {"families": ("MoveCube",), "episodes": "0"}
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
    split = load_split(TABLETOP)
    hits, expected, variance = 0, 0.0, 0.0
    for episode, question in questions().items():
        for seed in range(100):
            asked = Asked(question, split.query(episode), seed, None, lambda: np.empty(0, np.uint8))
            answer = Guesser().answer(asked)
            hits += answer.letter == question.letters[question.right]
            expected += question.chance
            variance += question.chance * (1 - question.chance)
    assert abs(hits - expected) < 3.5 * variance**0.5


# --- what a model is shown ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "kept"),
    [
        # The live observation has index 40 under k0, and 40 + 32 = 72 under k1.
        ({"frames": 5}, [0, 10, 20, 30]),  # linspace(0, 40, 5), without the last
        ({"frames": 4}, [0, 13, 26]),
        ({"frames": 2}, [0]),
        ({"frames": 5, "sampling": "window"}, [36, 37, 38, 39]),
        ({"frames": 5, "conditions": ("k1",)}, [0, 18, 36, 54]),
        ({"frames": 3, "sampling": "window", "conditions": ("k1",)}, [70, 71]),
        ({}, [40 * j // 31 for j in range(31)]),
        ({"sampling": "full"}, [*range(40)]),
        ({"frames": 100}, [*range(40)]),
        ({"conditions": ("no-history",)}, []),
    ],
)
def test_the_kept_frames_and_no_others_are_sent(
    tmp_path: Path, settings: dict[str, Any], kept: list[int]
) -> None:
    with ChatServer(lambda seen: "B") as server:
        [row] = ask(tmp_path / "run", **ONE, **behind(server, **settings)).rows
        [seen] = server.seen
    buffer = load_split(TABLETOP).load(MOVE, row.condition)
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
    split = copy_tabletop(tmp_path / "split")
    make_index(split)
    found = {}
    with ChatServer(look) as server:
        for rule in ("oracle", "last"):
            settings = {"retrieval": "thumbnail", "retrieval_rule": rule, "sampling": "full"}
            settings |= {"split": split, "conditions": ("k1",), "families": ("MoveCube",)}
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


def test_two_workers_write_the_rows_of_one(tmp_path: Path) -> None:
    one = ask(tmp_path / "one", sampling="window", frames=30)
    two = ask(tmp_path / "two", executor=Processes(2), sampling="window", frames=30)
    assert untimed(one.rows) == untimed(two.rows)
