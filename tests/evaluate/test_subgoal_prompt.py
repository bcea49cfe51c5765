"""How a model is asked for subgoals, and what its answers say: pure rules, and prompt files."""

import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.errors import FormatError, InvalidOptionError, UnknownNameError
from robomme_interference_data.evaluate.subgoals.prompt import (
    PROMPTS,
    Prompt,
    load_prompt,
    merge_near,
)
from robomme_interference_data.schema.subgoal import Subgoal

SIZE = (256, 256)
BOXES = "<|box_start|>({y},{x})<|box_end|>"


def prompt(**changes: object) -> Prompt:
    usual = {"system": "s", "first": "<history>{goal}<image>", "then": "{subgoals}"}
    return Prompt(**usual | changes)  # type: ignore[arg-type]


# --- points ------------------------------------------------------------------------------------


@given(
    st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255)), max_size=3),
    st.sampled_from([0, 256, 1000]),
    st.sampled_from(["<{y}, {x}>", "({x},{y})", BOXES, "[{y} {x}]"]),
)
def test_points_come_back_as_the_pixels_they_were(
    points: list[tuple[int, int]], grid: int, form: str
) -> None:
    subgoal = Subgoal("put it" + " at <point>" * len(points), tuple(points))
    asked = prompt(grid=grid, point=form)
    assert asked.read(asked.write(subgoal, SIZE), SIZE).subgoal == subgoal


@pytest.mark.parametrize(
    ("grid", "text", "points"),
    [
        (1000, "at <500, 1000>", ((128, 255),)),  # the end of the grid is the last pixel
        (1000, "at <3,  4>", ((0, 1),)),  # 3 · 256 / 1000 = 0.77, 4 · 256 / 1000 = 1.02
        (0, "at <12, 255>", ((12, 255),)),
        (1000, "at <0, 0> and <999, 0>", ((0, 0), (255, 0))),
    ],
)
def test_points_by_hand(grid: int, text: str, points: tuple[tuple[int, int], ...]) -> None:
    found = prompt(grid=grid).read(f"go {text}", SIZE).subgoal
    assert found.points == points
    assert found.text.count("<point>") == len(points)


def test_the_middle_of_a_box_counts() -> None:
    asked = prompt(grid=0, box="[{x0}, {y0}, {x1}, {y1}]", point="({x}, {y})")
    found = asked.read("pick up [10, 20, 30, 60], not (1, 2)", SIZE).subgoal
    assert found == Subgoal("pick up <point>, not <point>", ((40, 20), (2, 1)))


@pytest.mark.parametrize("said", ["<|box_start|>(500,250)<|box_end|>", "(500, 250)"])
def test_special_tokens_may_be_missing(said: str) -> None:
    asked = prompt(point=BOXES)
    found = asked.read(f"pick up the cube at {said} now", SIZE).subgoal
    assert found == Subgoal("pick up the cube at <point> now", ((128, 64),))
    told = "pick up the cube at <|box_start|>(500,250)<|box_end|> now"
    assert asked.write(found, SIZE) == told


@pytest.mark.parametrize(("grid", "text"), [(1000, "go <0, 1001>"), (0, "go <256, 0>")])
def test_a_point_outside_is_no_answer(grid: int, text: str) -> None:
    with pytest.raises(InvalidOptionError, match="a point of the answer"):
        prompt(grid=grid).read(text, SIZE)


# --- answers -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    ["pick it up", "\n  pick it up \nbecause", '"pick it up"', "**pick it up**", "`pick it up`"],
)
def test_the_first_line_counts_without_quotes(text: str) -> None:
    assert prompt().read(text, SIZE).subgoal == Subgoal("pick it up")


@pytest.mark.parametrize("text", ["", " \n ", "x" * 301, "<1, 2>"])
def test_what_is_no_subgoal(text: str) -> None:
    with pytest.raises(InvalidOptionError):
        prompt().read(text, SIZE)


def test_json_with_words_around_it() -> None:
    asked = prompt(answer="json", subgoal_key="task", keyframes_key="keep")
    said = '```json\n{"task": "press it at <0, 500>", "keep": [1, 3]}\n```'
    answer = asked.read(said, SIZE, shown=3)
    assert answer.subgoal == Subgoal("press it at <point>", ((0, 128),))
    assert answer.keyframes == (0, 2)
    assert asked.read('{"task": "go"}', SIZE).keyframes == ()


@pytest.mark.parametrize(
    "said",
    [
        *("go on", "{", "[1]", "{}", '{"subgoal": 3}', "[" * 10_000),
        *('{"subgoal": "go", "keyframes": [0]}', '{"subgoal": "go", "keyframes": [4]}'),
        *('{"subgoal": "go", "keyframes": "all"}', '{"subgoal": "go", "keyframes": [true]}'),
    ],
)
def test_what_is_no_answer_in_json(said: str) -> None:
    with pytest.raises(InvalidOptionError):
        prompt(answer="json").read(said, SIZE, shown=3)


@given(st.text())
def test_any_text_is_an_answer_or_refused(text: str) -> None:
    for kind in ("text", "json"):
        try:
            answer = prompt(answer=kind, box="[{y0},{x0},{y1},{x1}]").read(text, SIZE)
        except InvalidOptionError:
            continue
        assert all(0 <= side < 256 for point in answer.subgoal.points for side in point)


# --- questions ---------------------------------------------------------------------------------


def test_words_and_images_stand_where_the_prompt_says() -> None:
    history, now = np.zeros((1, 1, 3), np.uint8), np.ones((1, 1, 3), np.uint8)
    views = {"<history>": [history], "<image>": [now]}
    asked = prompt(first="before <history> the goal: {goal} <image>{goal} {other}")
    parts = asked.fill("go to <image>", [], SIZE, views)
    assert parts[0] == "before "
    assert parts[1] is history
    assert parts[2] == " the goal: go to <image> "  # words of a goal stay words
    assert parts[3] is now
    assert parts[4] == "go to <image> {other}"


def test_earlier_subgoals_are_numbered_and_written_as_the_model_writes() -> None:
    earlier = [Subgoal("pick up <point>", ((128, 0),)), Subgoal("wait")]
    asked = prompt(then="so far: {subgoals}; kept: <keyframes>", point=BOXES)
    [text] = asked.fill("g", earlier, SIZE, {"<keyframes>": []})
    assert text == "so far: 1. pick up <|box_start|>(500,0)<|box_end|>; 2. wait; kept: none"


# --- key frames --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frames", "kept"),
    [
        ([], []),
        ([5], [5]),
        ([0, 8], [8]),  # of two the upper one
        ([0, 9], [0, 9]),
        ([30, 2, 10, 18, 40], [10, 30, 40]),  # 2, 10 and 18 hang together; 18 to 30 is too far
    ],
)
def test_near_key_frames_become_their_median(frames: list[int], kept: list[int]) -> None:
    assert merge_near(frames, 8) == kept


@given(st.lists(st.integers(0, 300)), st.integers(0, 20))
def test_kept_frames_are_some_of_those_given_and_far_apart(frames: list[int], near: int) -> None:
    kept = merge_near(frames, near)
    assert set(kept) <= set(frames)
    assert kept == sorted(set(kept))
    assert bool(kept) == bool(frames)


# --- files -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", PROMPTS)
def test_our_prompts_show_history_and_present_and_read_their_own_examples(name: str) -> None:
    asked, digest = load_prompt(name)
    assert len(digest) == 64
    now = "<recent>" if name == "memer" else "<image>"
    for text in (asked.first, asked.then):
        assert "<history>" in text and now in text and "{goal}" in text
    assert asked.watches is (name == "memer")
    said = "pick it up" if name == "simple" else "pick it up at <420, 615>"
    answer = json.dumps({"subgoal": said, "keyframes": []}) if name == "memer" else said
    points = () if name == "simple" else ((107, 157),)
    assert asked.read(answer, SIZE).subgoal.points == points


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("system = 'a'\nfirst = 'b'", "lacks then"),
        ("system = 'a'\nfirst = 'b'\nthen = 'c'\ncolour = 'red'", "'colour'"),
        ("system = 'a'\nfirst = 'b'\nthen = 3", "then is 3"),
        ("system = 'a'\nfirst = 'b'\nthen = 'c'\ngrid = true", "grid is True"),
        ("system = 'a'\nfirst = 'b'\nthen = 'c'\ngrid = -1", "grid"),
        ("system = 'a'\nfirst = 'b'\nthen = 'c'\nanswer = 'xml'", "answer"),
        ("system = 'a'\nfirst = 'b'\nthen = 'c'\npoint = '{y}'", "{x}"),
        ("system = ' '\nfirst = 'b'\nthen = 'c'", "system is empty"),
        ("system = 'a'\nfirst = '<histroy>'\nthen = 'c'", "Did you mean '<history>'?"),
        (
            "system = 'a'\nfirst = 'b'\nthen = '{goals}'",
            "its then has the unknown placeholder {goals}",
        ),
        ("nonsense", "no prompt"),
        ("# " + "x" * (1 << 16), "at most"),
    ],
)
def test_what_is_no_prompt(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(FormatError) as raised:
        load_prompt(str(path))
    assert words in raised.value.message


def test_words_that_only_look_like_places_stay() -> None:
    text = "<think> at <|box_start|>({y},{x}) <box>: {goal} <image>"
    assert prompt(first=text).first == text


def test_no_such_prompt() -> None:
    with pytest.raises(UnknownNameError, match="no prompt or file 'grouded'"):
        load_prompt("grouded")
