"""Prompts of questions and subgoals, their files, and how answers are parsed."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.messages import raises

from robomme_interference_data.data.questions import LETTERS, Question
from robomme_interference_data.errors import FormatError, InvalidOptionError, UnknownNameError
from robomme_interference_data.evaluate.language.models import Video
from robomme_interference_data.evaluate.language.prompt_files import as_text
from robomme_interference_data.evaluate.language.questions import QuestionPrompt, read_letter
from robomme_interference_data.evaluate.language.subgoal_prompt import SubgoalPrompt, merge_near
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.subgoal import Subgoal

SIZE = (256, 256)
BOXES = "<|box_start|>({y},{x})<|box_end|>"
IMAGE = np.zeros((2, 2, 3), np.uint8)
NO_IMAGES: dict[str, Any] = {"<history>": [], "<picture>": []}


def question(*options: str) -> Question:
    episode, answers = EpisodeId("MoveCube", "test", 0), tuple(range(len(options)))
    return Question(episode, "r", "Which one?", options, answers, 0, ("",) * len(options), b"")


def prompt(**changes: object) -> SubgoalPrompt:
    usual = {"system": "s", "first": "<history>{goal}<image>", "then": "{subgoals}"}
    return SubgoalPrompt(**usual | changes)  # type: ignore[arg-type]


# --- answers to questions ----------------------------------------------------------------------

NO_LETTERS = st.text(st.characters(exclude_categories=("L", "M", "N"), exclude_characters="_"))


@given(st.integers(2, 8), st.sampled_from(LETTERS), NO_LETTERS, NO_LETTERS)
def test_a_single_letter_counts_in_any_punctuation(
    count: int, letter: str, before: str, after: str
) -> None:
    letters = LETTERS[:count]
    for text in (letter, letter.lower()):
        expected = letter if letter in letters else None
        assert read_letter(f"{before}{text}{after}", letters) == expected


@pytest.mark.parametrize(
    "form",
    [
        "the correct answer is: **@**",
        '{"answer": "@", "why": "A or B"}',
        "The answer is option @, as the cube moved.",
        "@: the one marked @",
        "**@**\n\nBecause # was never touched.",
        "@, because option # is wrong",
        "I choose option @.",
        "A robot lifted @.",
        "\\boxed{@}",
        "Not sure. #: no. @: yes. Answer: @",
        "Answer: #. Wait. Answer: @",
        "<think>The answer is #. Option #!</think>\n\n@",
    ],
)
@pytest.mark.parametrize(("letter", "other"), [("B", "D"), ("C", "A"), ("D", "C")])
def test_forms_of_answers(form: str, letter: str, other: str) -> None:
    """With the letter of the answer for @, and that of another option for #."""
    assert read_letter(form.replace("@", letter).replace("#", other), "ABCD") == letter


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", None),
        ("A or B", None),
        ("A, B, C", None),
        ("A: no\nB: no", None),
        ("The answer is a blue cube.", None),
        ("The answer is a blue cube, marked C", "C"),
        ("It's A's neighbour.", None),
        ("answer: a\nbecause it moved", "A"),
        ("The answer is A because it moved.", "A"),
    ],
)
def test_answers_by_hand(text: str, expected: str | None) -> None:
    assert read_letter(text, "ABCD") == expected


@given(st.text(), st.integers(2, 8))
def test_any_text_names_an_option_or_none(text: str, count: int) -> None:
    letters = LETTERS[:count]
    assert read_letter(text, letters) in (None, *letters)


@pytest.mark.parametrize("piece", ["x ", "A ", "answer ", "answer is ", "\n ", "* \n", "option\n"])
def test_long_answers_are_parsed_in_linear_time(piece: str) -> None:
    began = time.perf_counter()
    read_letter(piece * 50_000, "ABCD")
    assert time.perf_counter() - began < 30  # 0.01 s; a quadratic parse takes minutes


# --- answers with subgoals ---------------------------------------------------------------------


@given(
    st.lists(st.tuples(st.integers(0, 255), st.integers(0, 255)), max_size=3),
    st.sampled_from([0, 256]),
    st.sampled_from(["<{y}, {x}>", "({x},{y})", BOXES, "[{y} {x}]"]),
)
def test_points_are_parsed_as_the_same_pixels(
    points: list[tuple[int, int]], grid: int, form: str
) -> None:
    subgoal = Subgoal("put it" + " at <point>" * len(points), tuple(points))
    written = prompt(grid=grid, point=form)
    assert written.read(written.write(subgoal, SIZE), SIZE).subgoal == subgoal


def test_points_are_on_the_grid_of_a_thousand_as_in_the_released_client() -> None:
    """Down to the pixel above on the way in, to the nearest and half to even on the way out."""
    for value in range(1001):
        read = prompt().read(f"go <{value}, 0>", SIZE).subgoal.points[0][0]
        assert read == int(value / 1000 * 256)
    written = [prompt().write(Subgoal("go <point>", ((p, 0),)), SIZE) for p in range(257)]
    # 1 / 256 is 3.9 thousandths, 16 / 256 is 62.5, 48 / 256 is 187.5, 255 / 256 is 996.1.
    expected = {0: 0, 1: 4, 16: 62, 48: 188, 128: 500, 255: 996, 256: 1000}
    assert {p: int(written[p][4:-4]) for p in expected} == expected


@pytest.mark.parametrize(
    ("changes", "text", "expected"),
    [
        # The end of the grid is the end of the image; 3 · 256 / 1000 = 0.77, 4 · 256 / 1000 = 1.02.
        ({}, "go <500, 1000> <3,  4>", Subgoal("go <point> <point>", ((128, 256), (0, 1)))),
        (
            {"grid": 0, "box": "[{x0}, {y0}, {x1}, {y1}]", "point": "({x}, {y})"},
            "pick up [10, 20, 30, 60], not (1, 2)",  # the center of a box counts
            Subgoal("pick up <point>, not <point>", ((40, 20), (2, 1))),
        ),
        # Special tokens may be missing.
        ({"point": BOXES}, "at (500, 250) now", Subgoal("at <point> now", ((128, 64),))),
        # The first line counts, without quotes.
        ({}, "\n  pick it up \nbecause", Subgoal("pick it up")),
        ({}, '**"pick it up"**', Subgoal("pick it up")),
    ],
)
def test_subgoals_by_hand(changes: dict[str, Any], text: str, expected: Subgoal) -> None:
    assert prompt(**changes).read(text, SIZE).subgoal == expected


def test_json_may_have_text_around_it() -> None:
    parsed = prompt(answer="json", subgoal_key="task", keyframes_key="keep")
    text = '```json\n{"task": "press it at <0, 500>", "keep": [1, 3]}\n```'
    answer = parsed.read(text, SIZE, shown=3)
    assert answer.subgoal == Subgoal("press it at <point>", ((0, 128),))
    assert answer.keyframes == (0, 2)
    assert parsed.read('{"task": "go"}', SIZE).keyframes == ()


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        *(({}, text) for text in ("", " \n ", "x" * 301, "<1, 2>", "go <0, 1001>")),
        ({"grid": 0}, "go <256, 0>"),
        *(
            ({"answer": "json"}, text)
            for text in (
                *("go on", "{", "[1]", '{"subgoal": 3}', "[" * 10_000),
                *('{"subgoal": "go", "keyframes": [0]}', '{"subgoal": "go", "keyframes": [4]}'),
                '{"subgoal": "go", "keyframes": [true]}',
            )
        ),
    ],
)
def test_texts_without_a_subgoal_are_errors(changes: dict[str, Any], text: str) -> None:
    with pytest.raises(InvalidOptionError):
        prompt(**changes).read(text, SIZE, shown=3)


@given(st.text())
def test_any_text_is_a_subgoal_or_a_clear_error(text: str) -> None:
    for kind in ("text", "json"):
        try:
            answer = prompt(answer=kind, box="[{y0},{x0},{y1},{x1}]").read(text, SIZE)
        except InvalidOptionError:
            continue
        assert all(0 <= side <= 256 for point in answer.subgoal.points for side in point)


def test_near_key_frames_become_their_median() -> None:
    assert [merge_near(frames, 8) for frames in ([0, 8], [0, 9])] == [[8], [0, 9]]  # the upper one
    # 2, 10 and 18 are one group; 18 to 30 is too far.
    assert merge_near([30, 2, 10, 18, 40], 8) == [10, 30, 40]


@given(st.lists(st.integers(0, 300)), st.integers(0, 20))
def test_kept_frames_are_some_of_the_given_in_order(frames: list[int], near: int) -> None:
    kept = merge_near(frames, near)
    assert set(kept) <= set(frames)
    assert kept == sorted(set(kept))
    assert bool(kept) == bool(frames)


# --- filled prompts ----------------------------------------------------------------------------


def test_a_question_is_filled_in_order() -> None:
    filled = QuestionPrompt(
        "be brief", "see <history>; now <picture>: {goal} {question}\n{options}"
    )
    views = {"<history>": [Video(np.stack([IMAGE] * 3), 10.0)], "<picture>": [IMAGE]}
    system, user = filled.fill("do <picture> {options}", question("push it", ""), views)
    assert (system.role, system.parts) == ("system", ("be brief",))
    assert user.parts[1] is views["<history>"][0] and user.parts[3] is IMAGE
    # Placeholders in the goal stay text; an option without text is named by its letter.
    assert as_text(user.parts) == (
        "see [video of 3 frames]; now [image]: do <picture> {options} Which one?\n"
        "A: push it\nB: the one marked B"
    )
    _, user = filled.fill("g", question("x", "y"), NO_IMAGES)
    assert user.parts == ("see none; now none: g Which one?\nA: x\nB: y",)


def test_a_subgoal_prompt_is_filled_in_order() -> None:
    history, now = np.zeros((1, 1, 3), np.uint8), np.ones((1, 1, 3), np.uint8)
    views = {"<history>": [history], "<image>": [now]}
    filled = prompt(
        first="before <history> the goal: {goal} <image>{goal} {other}",
        then="so far: {subgoals}; kept: <keyframes>",
        point=BOXES,
    )
    parts = filled.fill("go to <image>", [], SIZE, views)
    assert parts[1] is history and parts[3] is now
    assert parts[::2] == ("before ", " the goal: go to <image> ", "go to <image> {other}")
    earlier = [Subgoal("pick up <point>", ((128, 0),)), Subgoal("wait")]
    [text] = filled.fill("g", earlier, SIZE, {"<keyframes>": []})
    assert text == "so far: 1. pick up <|box_start|>(500,0)<|box_end|>; 2. wait; kept: none"


def test_lists_of_images_and_a_sentence_about_the_history() -> None:
    history, one, other = (np.full((1, 1, 3), value, np.uint8) for value in range(3))
    filled = prompt(
        first="<history>{goal}, kept: [<keyframes>], now: [<recent>]",
        history="Before: <history>.\n",
        no_history="",
        separator=", ",
        no_images="",
    )
    views: dict[str, Any] = {"<history>": [history], "<recent>": [one, other]}
    parts = filled.fill("do <history>", [], SIZE, views)
    assert parts[::2] == ("Before: ", ".\ndo <history>, kept: [], now: [", ", ", "]")
    assert parts[1] is history and parts[3] is one and parts[5] is other
    parts = filled.fill("do it", [], SIZE, {"<keyframes>": [one]})
    assert parts == ("do it, kept: [", one, "], now: []")


# --- files -------------------------------------------------------------------------------------


def test_the_questions_prompt_of_the_package() -> None:
    [name] = QuestionPrompt.packaged
    loaded = QuestionPrompt.load(name)
    assert len(loaded.sha256) == 64 and "letter" in loaded.system
    views: Any = {"<history>": [Video(IMAGE[None], 10.0)], "<picture>": [IMAGE]}
    _, user = loaded.fill("g", question("x", "y"), views)
    assert [type(part).__name__ for part in user.parts] == ["str", "Video", "str", "ndarray", "str"]
    assert str(user.parts[-1]).endswith("A: x\nB: y\nAnswer with one letter.")
    assert not {"<", "{"} & {*as_text(user.parts)}


@pytest.mark.parametrize("name", SubgoalPrompt.packaged)
def test_subgoal_prompts_of_the_package_parse_their_own_examples(name: str) -> None:
    loaded = SubgoalPrompt.load(name)
    assert len(loaded.sha256) == 64
    now = "<recent>" if name == "memer" else "<image>"
    for text in (loaded.first, loaded.then):
        assert "<history>" in text and now in text and "{goal}" in text
    assert loaded.watches is (name == "memer")
    example = "pick it up" if name == "simple" else "pick it up at <420, 615>"
    answer = json.dumps({"subgoal": example, "keyframes": []}) if name == "memer" else example
    points = () if name == "simple" else ((107, 157),)
    assert loaded.read(answer, SIZE).subgoal.points == points


QUESTION = "system = 's'\nquestion = '<history><picture>{question}{options}'"
SUBGOAL = "system = 'a'\nfirst = 'b'\nthen = 'c'"


@pytest.mark.parametrize(
    ("load", "text", "words"),
    [
        (QuestionPrompt.load, "system = 's'", "lacks question"),
        (QuestionPrompt.load, QUESTION.replace("<history>", ""), "lacks <history>"),
        (QuestionPrompt.load, QUESTION.replace("<picture>", ""), "lacks <picture>"),
        (QuestionPrompt.load, QUESTION.replace("{question}", ""), "lacks {question}"),
        (QuestionPrompt.load, QUESTION.replace("{options}", ""), "lacks {options}"),
        (QuestionPrompt.load, QUESTION.replace("'s'", "' '"), "system is empty"),
        (QuestionPrompt.load, "a = " + "[" * 5000, "no prompt"),
        (SubgoalPrompt.load, f"{SUBGOAL}\ncolor = 'red'", "'color'"),
        (SubgoalPrompt.load, "system = 'a'\nfirst = 'b'\nthen = 3", "then is 3"),
        (SubgoalPrompt.load, f"{SUBGOAL}\ngrid = true", "grid is True"),
        (SubgoalPrompt.load, f"{SUBGOAL}\ngrid = -1", "grid"),
        (SubgoalPrompt.load, f"{SUBGOAL}\nanswer = 'xml'", "answer"),
        (SubgoalPrompt.load, f"{SUBGOAL}\npoint = '{{y}}'", "{x}"),
        (SubgoalPrompt.load, SUBGOAL.replace("'a'", "' '"), "system is empty"),
        (SubgoalPrompt.load, SUBGOAL.replace("'b'", "'<histroy>'"), "mean '<history>'?"),
        (SubgoalPrompt.load, f"{SUBGOAL}\nhistory = 'x'", "<history> once"),
        (SubgoalPrompt.load, SUBGOAL.replace("'c'", "'{goals}'"), "placeholder {goals}"),
        (SubgoalPrompt.load, "nonsense", "no prompt"),
        (SubgoalPrompt.load, "\udcff\udcfe", "no prompt"),  # no UTF-8
        (SubgoalPrompt.load, "# " + "x" * (1 << 16), "at most"),
    ],
)
def test_invalid_files_are_errors(
    tmp_path: Path, load: Callable[[str], Any], text: str, words: str
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text, errors="surrogateescape")
    with pytest.raises(FormatError) as raised:
        load(str(path))
    assert words in raised.value.message and str(path) in raised.value.message
    assert "/reference/prompts.html" in str(raised.value.hint)


def test_special_tokens_of_models_are_no_placeholders() -> None:
    text = "<think> at <|box_start|>({y},{x}) <box>: {goal} <image>"
    assert prompt(first=text).first == text


def test_no_such_prompt() -> None:
    with raises(UnknownNameError):
        SubgoalPrompt.load("grouded")
