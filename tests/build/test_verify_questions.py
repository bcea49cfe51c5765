"""`verify` plans the questions of a buffer set again, and draws their pictures."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from numpy.typing import NDArray
from support.buffer_sets import violations
from support.damage import HEADER, edit, flipped_bits, put, renew_header
from support.messages import raises
from support.tabletop import TABLETOP, copy_tabletop
from support.verifying import expect, first_changed

from robomme_interference_data import load_buffer_set
from robomme_interference_data.constants import QUESTIONS_PATH
from robomme_interference_data.data.questions import read_questions
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


def painted(view: NDArray[np.uint8]) -> NDArray[np.uint8]:
    view = view.copy()
    view[-20:-10, -20:-10] = (255, 255, 0)
    return view


@pytest.mark.slow
@pytest.mark.parametrize("change", [np.zeros_like, painted, lambda view: view[::2, ::2].copy()])
def test_a_picture_of_something_else(tmp_path: Path, change: Callable[[Any], Any]) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")
    path = root / QUESTIONS_PATH
    pictures = pq.read_table(path)["picture"].to_pylist()
    edit(path, first_changed("picture", png(change(decode_image(pictures[0])))))
    renew_header(root)
    expect(root, r"questions\.parquet VideoRepick/test/0: has a picture of", decode=True)


@pytest.mark.slow
def test_exchanged_pictures(tmp_path: Path) -> None:
    root = copy_tabletop(tmp_path / "buffer_set")

    def exchange(table: pa.Table) -> pa.Table:
        first, second, *others = table["picture"].to_pylist()
        return put(table, "picture", [second, first, *others])

    edit(root / QUESTIONS_PATH, exchange)
    renew_header(root)
    number = r"questions\.parquet VideoRepick/test/{}: has a picture of something else"
    expect(root, number.format(0), number.format(2), decode=True)


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
