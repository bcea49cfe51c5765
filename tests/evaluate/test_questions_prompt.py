"""How a question is put to a model, and which option its answer names: pure rules, prompt files."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robomme_interference_data.data.questions import LETTERS, Question
from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.models.model import Video
from robomme_interference_data.evaluate.models.prompts import as_text
from robomme_interference_data.evaluate.questions.prompt import (
    PROMPTS,
    QuestionPrompt,
    load_prompt,
    read_letter,
)
from robomme_interference_data.ids import EpisodeId

PLACES = "<history><picture>{goal}{question}{options}"
IMAGE = np.zeros((2, 2, 3), np.uint8)


def question(*options: str, **changes: Any) -> Question:
    answers = tuple(range(len(options)))
    told = {"text": "Which one?", "right": 0, "picture": b"", "revision": "r"} | changes
    return Question(EpisodeId("MoveCube", "test", 0), options=options, answers=answers, **told)


# --- answers -----------------------------------------------------------------------------------


@given(
    st.integers(2, 8),
    st.data(),
    st.text(st.characters(exclude_categories=("L", "M", "N"), exclude_characters="_")),
    st.text(st.characters(exclude_categories=("L", "M", "N"), exclude_characters="_")),
)
def test_a_letter_alone_whatever_stands_around_it(
    count: int, data: st.DataObject, before: str, after: str
) -> None:
    letters = LETTERS[:count]
    letter = data.draw(st.sampled_from(LETTERS))
    for written in (letter, letter.lower()):
        expected = letter if letter in letters else None
        assert read_letter(f"{before}{written}{after}", letters) == expected


FORMS = (
    "The answer is @.",
    "the correct answer is: **@**",
    "Answer: @",
    "answer: (@)",
    "<answer>@</answer>",
    '{"answer": "@", "why": "A or B"}',
    "The answer is option @, as the cube moved.",
    "@: the one marked @",
    "@. Option # shows something else.",
    "**@**\n\nBecause # was never touched.",
    "@, because option # is wrong",
    "I choose option @.",
    "The right letter is @",
    "It is the cube marked @.",
    "A robot lifted @.",
    "\\boxed{@}",
    "Ответ: @",
    "Not sure. #: no. @: yes. Answer: @",
    "Answer: #. Wait. Answer: @",
    "<think>The answer is #. Option #!</think>\n\n@",
)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("letter", "other"), [("B", "D"), ("C", "A"), ("D", "C")])
def test_forms_of_answers(form: str, letter: str, other: str) -> None:
    """With the letter of the answer for @, and that of another option for #."""
    said = form.replace("@", letter).replace("#", other)
    assert read_letter(said, "ABCD") == letter


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ("", None),
        ("I cannot tell.", None),
        ("E", None),  # of no option
        ("A or B", None),
        ("The answer is A or B.", None),
        ("Answer: A, B", None),
        ("A, B, C", None),
        ("option A or option B", None),
        ("A: no\nB: no", None),
        ("The answer is a blue cube.", None),
        ("The answer is a blue cube, marked C", "C"),
        ("It's A's neighbour.", None),
        ("Answer: b", "B"),
        ("answer: a\nbecause it moved", "A"),
        ("A", "A"),
        ("The answer is A because it moved.", "A"),
    ],
)
def test_answers_by_hand(said: str, expected: str | None) -> None:
    assert read_letter(said, "ABCD") == expected


@given(st.text(), st.integers(2, 8))
def test_any_text_names_an_option_or_none(text: str, count: int) -> None:
    letters = LETTERS[:count]
    assert read_letter(text, letters) in (None, *letters)


@pytest.mark.parametrize("piece", ["x ", "A ", "answer ", "answer is ", "\n ", "* \n", "option\n"])
def test_a_long_answer_is_read_at_once(piece: str) -> None:
    began = time.perf_counter()
    read_letter(piece * 50_000, "ABCD")
    assert time.perf_counter() - began < 2


# --- questions ---------------------------------------------------------------------------------


def test_what_a_model_is_asked() -> None:
    prompt = QuestionPrompt(
        "be brief", "before <history>; now <picture>: {goal} {question}\n{options}"
    )
    views = {"<history>": [Video(np.stack([IMAGE] * 3), 10.0)], "<picture>": [IMAGE]}
    system, user = prompt.fill("do <picture> {options}", question("push it", ""), views)
    assert (system.role, system.parts) == ("system", ("be brief",))
    before, video, now, picture, words = user.parts
    assert (before, now) == ("before ", "; now ")
    assert video is views["<history>"][0] and picture is IMAGE
    # Words of a goal stay words; an option without words is told by its letter.
    assert words == ": do <picture> {options} Which one?\nA: push it\nB: the one marked B"
    assert as_text(user.parts) == (
        "before [video of 3 frames]; now [image]: do <picture> {options} Which one?\n"
        "A: push it\nB: the one marked B"
    )


def test_without_images_none_is_written() -> None:
    prompt = QuestionPrompt("s", "<history>|<picture>|{goal}|{question}|{options}")
    _, user = prompt.fill("g", question("x", "y"), {"<history>": [], "<picture>": []})
    assert user.parts == ("none|none|g|Which one?|A: x\nB: y",)


def test_the_goal_need_not_be_told(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("system = 's'\nquestion = '<history><picture>{question}{options}'")
    _, user = load_prompt(str(path))[0].fill(
        "secret", question("x", "y"), {"<history>": [], "<picture>": []}
    )
    assert user.parts == ("nonenoneWhich one?A: x\nB: y",)


def test_our_prompt_shows_all_and_asks_for_a_letter() -> None:
    [name] = PROMPTS
    prompt, digest = load_prompt(name)
    assert len(digest) == 64 and "letter" in prompt.system
    _, user = prompt.fill(
        "g", question("x", "y"), {"<history>": [Video(IMAGE[None], 10.0)], "<picture>": [IMAGE]}
    )
    assert [type(part).__name__ for part in user.parts] == ["str", "Video", "str", "ndarray", "str"]
    assert str(user.parts[-1]).endswith("A: x\nB: y\nAnswer with one letter.")
    assert not {"<", "{"} & {*as_text(user.parts)}


# --- files -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("system = 's'", "lacks question"),
        *(
            (f"system = 's'\nquestion = '{PLACES.replace(place, '')}'", f"lacks {place}")
            for place in ("<history>", "<picture>", "{question}", "{options}")
        ),
        ("a = " + "[" * 5000, "no prompt"),
        (f"system = ' '\nquestion = '{PLACES}'", "system is empty"),
    ],
)
def test_what_is_no_prompt(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(FormatError) as raised:
        load_prompt(str(path))
    assert words in raised.value.message and str(path) in raised.value.message
    assert "docs/reference/prompts.md" in str(raised.value.hint)


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(FormatError, match="no prompt"):
        load_prompt(str(path))
