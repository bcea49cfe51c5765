"""Make the questions about the past of a buffer set."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from robomme_interference_data.constants import DEMONSTRATIONS, MANIFEST_PATH, QUESTIONS_PATH
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.query import Query
from robomme_interference_data.data.questions import NOT_SHOWN, Question
from robomme_interference_data.errors import BuildError
from robomme_interference_data.lazy import load_extra
from robomme_interference_data.schema.codec import arrow_schema, to_dict, to_table
from robomme_interference_data.schema.manifest import ManifestHeader
from robomme_interference_data.schema.subgoal import Pixel
from robomme_interference_data.simulators.registry import recorded_scene
from robomme_interference_data.storage.files import sha256_file, write_json
from robomme_interference_data.storage.parquet import writing
from robomme_interference_data.storage.text import read_header
from robomme_interference_data.storage.video.encode import png

_MOST, _DRAWN = 5, 4
"""Most options of a question; if the scene has more answers, the number that is drawn."""

_NOT_SHOWN_WORDS = "it was not shown"

Marks = Sequence[Sequence[Pixel]]
"""The points of each option of the scene, (y, x) in pixels of the first live observation; none if
words describe it."""


def make_questions(buffer_set: BufferSet) -> Iterator[Question]:
    """Make the questions of a buffer set, in canonical order."""
    module = "robomme_interference_data.build_dataset.question_pictures"
    picture = load_extra(module, "picture", "build --only questions", "retrieval")
    for question, marks in planned_questions(buffer_set):
        view = buffer_set.query(question.episode_id).frame()
        scene = recorded_scene(buffer_set.query(question.episode_id))
        assert scene is not None  # or no question was planned
        side = scene.side
        if view.shape != (side, side, 3):
            raise BuildError(
                f"the first live observation of {question.episode_id} has "
                f"{view.shape[1]}×{view.shape[0]} pixels; expected {side}×{side}, in which the "
                "positions of objects are known",
                "Build the demonstrations with the simulator itself and without `resize`; training "
                "resizes frames by itself (`image_size`).",
            )
        yield replace(question, picture=png(picture(view, marks)))


def planned_questions(buffer_set: BufferSet) -> Iterator[tuple[Question, Marks]]:
    """Yield the questions of a buffer set without their pictures, and the marks on these."""
    revision = buffer_set.datasets[DEMONSTRATIONS].identity.revision
    for episode in sorted(buffer_set.episode_ids):
        yield _planned(buffer_set.query(episode), revision)


def write_questions(questions: Sequence[Question], folder: Path) -> Path:
    """Write questions into a buffer set's folder, and their SHA-256 into its header.

    Returns the file. After an interruption between the two, the questions are an error until they
    are made again.
    """
    out = folder / QUESTIONS_PATH
    schema = arrow_schema(Question)
    with (
        writing(out) as file,
        pq.ParquetWriter(file, schema, compression="none", write_page_checksum=True) as writer,
    ):
        for question in questions:  # one row group each: the pictures are already compressed
            writer.write_table(to_table([question], schema))
    header = read_header(folder / MANIFEST_PATH, ManifestHeader)
    write_json(folder / MANIFEST_PATH, to_dict(replace(header, questions=sha256_file(out))))
    return out


def _planned(query: Query, revision: str) -> tuple[Question, Marks]:
    scene, seed, name = recorded_scene(query), query.seed, str(query.episode_id)
    if scene is None or seed is None:
        recorded = f"with the simulator {query.simulator!r}"
        if query.simulator is None:
            recorded = "without a simulator"
        raise BuildError(
            f"{name} was recorded {recorded}, which does not list the possible answers",
            "Questions need demonstrations of a simulator that does, such as tabletop.",
        )
    numbers: dict[Any, int] = {}  # choice to its first answer
    for number, answer in enumerate(scene.answers):
        numbers.setdefault(scene.choice(answer), number)
    right = scene.choice(scene.own_answer(seed))
    others = sorted(
        (choice for choice in numbers if choice != right),
        key=lambda choice: _lot(name, "of", choice),
    )
    if len(others) >= _MOST:
        others = others[: _DRAWN - 1]
    chosen = sorted([right, *others], key=lambda choice: _lot(name, "order", choice))
    options = [scene.option(choice) for choice in chosen]
    marks = [scene.pixels(option.marks) for option in options]
    words = [option.words for option in options]
    answers = [numbers[choice] for choice in chosen]
    correct = chosen.index(right)
    points = [" ".join(f"{y},{x}" for y, x in marked) for marked in marks]
    if query.record.ability is not None:
        # The picture cannot show this option, so it has no marks.
        words.append(_NOT_SHOWN_WORDS)
        answers.append(NOT_SHOWN)
        points.append("")
        if query.record.ability == "absent":
            correct = len(answers) - 1
    question = Question(
        query.episode_id,
        revision,
        scene.question,
        tuple(words),
        tuple(answers),
        correct,
        tuple(points),
        picture=b"",
    )
    return question, marks


def _lot(*parts: Any) -> bytes:
    return hashlib.sha256("/".join(map(repr, parts)).encode()).digest()
