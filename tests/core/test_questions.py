"""Questions of a buffer set: how they are stored, and which files are invalid."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from support import damage
from support.buffer_sets import copy_buffer_set
from support.lerobot_layouts import edit_columns
from support.messages import raises
from support.tabletop import QUERIES, TABLETOP, copy_tabletop

from robomme_interference_data import load_buffer_set
from robomme_interference_data.constants import QUESTIONS_PATH
from robomme_interference_data.data.questions import Question, read_questions
from robomme_interference_data.errors import FormatError, InterferenceError, MissingFileError
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.storage.video.encode import decode_image

MOVE = EpisodeId("MoveCube", "test", 0)
COLUMNS = {
    **{"episode_id": "string", "family": "string", "split": "string", "index": "int64"},
    **{"revision": "string", "text": "string"},
    "options": "list<element: string not null>",
    "answers": "list<element: int64 not null>",
    "right": "int64",
    "points": "list<element: string not null>",
    "picture": "binary",
}


def question(**changes: Any) -> Question:
    known = {"options": ("", "", ""), "answers": (4, 0, 9), "right": 1}
    fields = (
        {"revision": "r", "text": "Which?", "picture": b"", "points": ("",) * 3} | known | changes
    )
    return Question(episode_id=MOVE, **fields)


def test_letters_and_chance() -> None:
    assert (question().letters, question().chance) == ("ABC", 1 / 3)
    eight = question(options=("",) * 8, answers=tuple(range(8)), points=("",) * 8)
    assert (eight.letters, eight.chance) == ("ABCDEFGH", 0.125)


@pytest.mark.parametrize(
    "changes",
    [
        {"options": ("",), "answers": (0,), "right": 0},
        {"options": ("",) * 9, "answers": tuple(range(9))},
        {"answers": (4, 0)},
        {"answers": (4, 0, 4)},
        {"answers": (4, 0, -2)},
        {"right": 3},
        {"points": ("", "")},
        {"points": ("1,2", "3", "")},
    ],
)
def test_what_is_no_question(changes: dict[str, Any]) -> None:
    with pytest.raises(FormatError):
        question(**changes)


def test_the_columns_are_these() -> None:
    schema = pq.read_schema(TABLETOP / QUESTIONS_PATH)
    assert {field.name: str(field.type) for field in schema} == COLUMNS
    assert list(COLUMNS) == schema.names
    assert not any(field.nullable for field in schema)


def test_the_golden_questions() -> None:
    found = read_questions(load_buffer_set(TABLETOP))
    assert tuple(found) == QUERIES
    one, peg = found[MOVE], found[EpisodeId("InsertPeg", "test", 0)]
    assert one.text == "In which manner was the cube moved to the target?"
    words = ("pushes the cube with the closed gripper", "grasps the cube", "hooks the cube")
    assert (one.options, one.answers, one.right) == (words, (0, 1, 2), 0)
    assert decode_image(one.picture).shape == (512, 512, 3)
    # Of two pegs, two ends and two sides: the first peg is inserted from the right.
    assert (peg.letters, peg.answers, peg.right) == ("ABCD", (0, 7, 4, 1), 3)
    assert peg.options[3] == "held at its head, inserted from the right"
    assert peg.options[0] == peg.options[2]  # of different pegs, as the picture shows
    assert [len(points) for points in peg.pixels] == [2] * 4 and one.points == ("",) * 3
    assert question(points=("1,2 -3,40", "5,6", "")).pixels == (((1, 2), (-3, 40)), ((5, 6),), ())


# --- invalid questions -------------------------------------------------------------------------


def put(name: str, value: Any) -> Callable[[pa.Table], pa.Table]:
    """Another value in the first row of a column."""
    return lambda table: damage.put(table, name, [value, *table[name].to_pylist()[1:]])


DAMAGED: dict[str, tuple[Callable[[pa.Table], pa.Table], str]] = {
    "a column is missing": (lambda table: table.drop(["right"]), "right is missing"),
    "a column is of another type": (
        lambda table: table.set_column(8, "right", table["text"]),
        "expected a whole number",
    ),
    "a query twice": (lambda table: pa.concat_tables([table, table[:1]]), "two questions"),
    "an empty value": (put("text", None), "text"),
    "an answer twice": (put("answers", [1, 1, 2]), "with 2 different answers"),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damage_is_one_error(tmp_path: Path, name: str) -> None:
    change, words = DAMAGED[name]
    root = copy_tabletop(tmp_path / "buffer_set")
    damage.edit(root / QUESTIONS_PATH, change)
    damage.renew_header(root)
    with pytest.raises(FormatError) as raised:
        read_questions(load_buffer_set(root))
    assert words in raised.value.message and str(root / QUESTIONS_PATH) in raised.value.message


@pytest.mark.parametrize(
    "change",
    [
        put("revision", "0" * 64),
        lambda table: put("index", 49)(put("episode_id", "VideoRepick/test/49")(table)),
    ],
)
def test_questions_of_other_demonstrations_are_stale(tmp_path: Path, change: Any) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")
    damage.edit(root / QUESTIONS_PATH, change)
    damage.renew_header(root)
    with raises(FormatError) as raised:
        read_questions(load_buffer_set(root))
    assert raised.value.command == f"build {root} --only questions"


def test_further_columns_are_left_aside(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")
    edit_columns(root / QUESTIONS_PATH, colour=pa.array(["red"] * len(QUERIES)))
    damage.renew_header(root)
    assert len(read_questions(load_buffer_set(root))) == len(QUERIES)


def test_a_buffer_set_without_questions_says_how_to_make_them(tmp_path: Path) -> None:
    root = copy_buffer_set(tmp_path / "buffer_set")
    with raises(MissingFileError) as raised:
        read_questions(load_buffer_set(root))
    assert raised.value.command == f"build {root} --only questions"
    (root / QUESTIONS_PATH).mkdir()
    with pytest.raises(InterferenceError):
        read_questions(load_buffer_set(root))


# --- `show --question` --------------------------------------------------------------------


def test_a_question_is_shown_in_words_and_as_a_picture(tmp_path: Path, run: Any) -> None:
    code, out, err = run("show", TABLETOP, MOVE, "--question", "--out", tmp_path / "q.png")
    one = read_questions(load_buffer_set(TABLETOP))[MOVE]
    assert code == 0 and str(tmp_path / "q.png") in err
    assert (tmp_path / "q.png").read_bytes() == one.picture
    assert [line[10:] for line in out.splitlines()[1:]] == [one.text, *one.lines, "A"]
    code, out, _ = run("show", TABLETOP, MOVE, "--question", "--json")
    assert code == 0 and json.loads(out)["options"] == list(one.lines)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("MoveCube/test/9",), "'MoveCube/test/9' is not in"),
        (("MoveCube",), "is not an episode id"),
        ((MOVE, "--out", "q.svg"), "a name that ends in .png"),
        ((MOVE, "--out", TABLETOP / "manifests" / "q.png"), "a part of a buffer set"),
    ],
)
def test_what_cannot_be_shown(words: tuple[object, ...], message: str, run: Any) -> None:
    code, out, err = run("show", TABLETOP, "--question", *words)
    assert (code, out) == (1, "") and message in err
