"""`verify` plans the questions of a buffer set again, and draws their pictures."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray
from support.buffer_sets import violations
from support.damage import HEADER, edit, flipped_bits, put, renew_header
from support.messages import raises
from support.tabletop import TABLETOP, copy_tabletop
from support.verifying import expect, first_changed

from robomme_interference_data import load_buffer_set
from robomme_interference_data.build_dataset.verify import planned_again
from robomme_interference_data.build_dataset.verify.planned_again import question_violations
from robomme_interference_data.constants import QUESTIONS_PATH
from robomme_interference_data.data.questions import Question, read_questions
from robomme_interference_data.errors import FormatError
from robomme_interference_data.storage.video.encode import decode_image, png


@pytest.mark.slow
def test_questions_are_planned_anew(tmp_path: Path) -> None:
    assert violations(TABLETOP, decode=False) == []
    root = copy_tabletop(tmp_path / "buffer_set")
    path = root / QUESTIONS_PATH
    sound = path.read_bytes()
    for name, value in (("right", 2), ("text", "Which?"), ("options", ["a", "b", "c"])):
        edit(path, first_changed(name, value))
        expect(root, r"questions\.parquet does not have the SHA-256 in manifests/manifest\.json")
        renew_header(root)
        expect(root, rf"questions\.parquet VideoRepick/test/0: is .*{name}.*the rules give")
        path.write_bytes(sound)
    edit(path, first_changed("picture", b"a picture"))
    renew_header(root)
    expect(root, r"questions\.parquet VideoRepick/test/0: an image starts with the bytes")
    edit(path, lambda table: table[1:])
    renew_header(root)
    expect(root, r"questions\.parquet.* lacks the question of VideoRepick/test/0")


def test_a_flipped_bit_in_questions_is_told_or_changes_none(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")
    sound, errors = read_questions(load_buffer_set(root)), 0
    for _ in flipped_bits(root / QUESTIONS_PATH, 40):
        try:
            assert read_questions(load_buffer_set(root)) == sound  # statistics, say, are not read
        except FormatError as error:
            errors += "questions.parquet" in error.message
    assert errors > 30


def painted(view: NDArray[np.uint8], question: Question) -> NDArray[np.uint8]:
    """Make the letter of the right option red, inside its disc: 42 pixels above its point."""
    [(y, x)] = question.pixels[question.right]
    view = view.copy()
    disc = view[3 * y - 50 : 3 * y - 34, 3 * x - 8 : 3 * x + 8]
    disc[(disc < 100).all(axis=-1)] = (255, 0, 0)
    return view


def exchanged(pictures: list[bytes], question: Question) -> None:
    pictures[:2] = pictures[1::-1]


def blank(pictures: list[bytes], question: Question) -> None:
    pictures[0] = png(np.zeros_like(decode_image(pictures[0])))


def answered(pictures: list[bytes], question: Question) -> None:
    pictures[0] = png(painted(decode_image(pictures[0]), question))


@pytest.mark.parametrize("change", [exchanged, blank, answered])
def test_a_picture_of_something_else(tmp_path: Path, change: Callable[..., None]) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")

    def changed(table: pa.Table) -> pa.Table:
        pictures = table["picture"].to_pylist()
        change(pictures, next(iter(read_questions(load_buffer_set(root)).values())))
        return put(table, "picture", pictures)

    edit(root / QUESTIONS_PATH, changed)
    renew_header(root)
    [first, *_] = question_violations(load_buffer_set(root), decode=True)
    assert first.where == "questions.parquet VideoRepick/test/0"
    assert first.what == "has a picture of something else"


def test_questions_that_are_not_listed(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")
    header = json.loads((root / HEADER).read_text())
    (root / HEADER).write_text(json.dumps(header | {"questions": None}))
    expect(root, r"questions\.parquet: is not listed in manifests/manifest\.json")
    with raises(FormatError):
        read_questions(load_buffer_set(root))
    (root / QUESTIONS_PATH).unlink()
    assert violations(root, decode=False) == []
    (root / HEADER).write_text(json.dumps(header))
    expect(root, r"questions\.parquet.* missing")


@pytest.mark.slow
def test_pictures_that_cannot_be_drawn_are_named(monkeypatch: pytest.MonkeyPatch, run: Any) -> None:
    monkeypatch.setattr(planned_again, "find_spec", lambda name: None)
    report = {"violations": [], "pictures_checked": False}
    assert json.loads(run("verify", TABLETOP, "--json")[1]) == report
