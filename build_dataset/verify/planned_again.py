"""Plan the buffers and questions of a buffer set again, and compare them with the stored ones."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.manifests import plan_manifests, planned_buffers
from robomme_interference_data.build_dataset.questions import Marks, planned_questions
from robomme_interference_data.constants import (
    DATASETS,
    MANIFEST_ROWS,
    QUESTIONS_PATH,
    RULE_VERSION,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.query import Query
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.errors import FormatError
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.conditions import datasets_of, in_order
from robomme_interference_data.schema.manifest import ManifestHeader
from robomme_interference_data.storage.video.encode import decode_image

from .dataset import HEADER, Violation


def buffer_violations(
    buffer_set: BufferSet, datasets: Mapping[str, Dataset]
) -> Iterator[Violation]:
    """Plan all buffers again, and compare them with the rows.

    Of a partial copy, those are left out that need a dataset which it lacks.
    """
    header, files = buffer_set.header, {name: dataset.files for name, dataset in datasets.items()}
    if header.rule_version != RULE_VERSION:
        what = f"rule version {header.rule_version}; this package can check {RULE_VERSION}"
        yield Violation(HEADER, what)
        return
    conditions = in_order(header.conditions)
    if buffer_set.copy is not None:
        conditions = tuple(
            condition for condition in conditions if files.keys() >= {*condition.kind.needs}
        )
    plan = plan_manifests(files, conditions, header.seed, header.position_limit)
    counts = {"queries": len(plan.demonstrations), "buffers": 0, "sessions": 0}
    stored: dict[str, dict[str, Any]] = {}
    left_out = {*header.conditions} - {condition.name for condition in conditions}
    for manifest in buffer_set.planned_manifests():
        if manifest.condition in left_out:
            counts["buffers"] += 1
            counts["sessions"] += len(manifest.sessions)
        else:
            stored[str(manifest)] = to_dict(manifest)
    order = list(stored)
    for number, manifest in enumerate(planned_buffers(plan)):
        name = str(manifest)
        counts["buffers"] += 1
        counts["sessions"] += len(manifest.sessions)
        row = stored.pop(name, None)
        if row is None:
            yield Violation(name, f"is missing in {MANIFEST_ROWS}")
            continue
        if number >= len(order) or order[number] != name:
            yield Violation(name, f"is out of order in {MANIFEST_ROWS}")
        for field, value in to_dict(manifest).items():
            if row[field] != value:
                yield Violation(name, f"{field} is {difference(row[field], value)}")
    yield from (Violation(name, f"should not be in {MANIFEST_ROWS}") for name in stored)
    yield from _header_violations(header, counts)


def _header_violations(header: ManifestHeader, counts: Mapping[str, int]) -> Iterator[Violation]:
    conditions = in_order(header.conditions)
    names = tuple(condition.name for condition in conditions)
    if header.conditions != names:
        yield Violation(HEADER, f"conditions are {header.conditions}; expected {names}")
    if header.counts != counts:
        yield Violation(HEADER, f"counts are {header.counts}; expected {counts}")
    if not {*datasets_of(conditions)} <= header.datasets.keys() <= {*DATASETS}:
        yield Violation(HEADER, f"datasets are {sorted(header.datasets)}")


def question_violations(buffer_set: BufferSet, *, decode: bool) -> Iterator[Violation]:
    """Plan all questions again, draw their pictures, and compare them with the stored ones."""
    stored = read_questions(buffer_set)
    drawn = decode and can_draw()
    for question, marks in planned_questions(buffer_set):
        where = f"{QUESTIONS_PATH} {question.episode_id}"
        kept = stored.pop(question.episode_id)
        if (found := replace(kept, picture=b"")) != question:
            yield Violation(where, f"is {difference(to_dict(found), to_dict(question))}")
            continue
        try:
            shown = decode_image(kept.picture)
            if drawn and not _is_picture(shown, buffer_set.query(question.episode_id), marks):
                yield Violation(where, "has a picture of something else")
        except FormatError as error:
            yield Violation(where, error.message)
    yield from (
        Violation(f"{QUESTIONS_PATH} {episode}", "belongs to no query") for episode in stored
    )


def can_draw() -> bool:
    """Return whether the pictures of questions can be drawn here: Pillow is optional."""
    return find_spec("PIL") is not None


def _is_picture(stored: NDArray[np.uint8], query: Query, marks: Marks) -> bool:
    from robomme_interference_data.build_dataset.question_pictures import picture

    return np.array_equal(stored, picture(query.frame(), marks))


def difference(stored: Any, expected: Any, gives: str = "the rules give") -> str:
    """Return two different values, shortened to where they differ; `gives` is before the second."""
    position = ""
    while isinstance(stored, list) and isinstance(expected, list) and len(stored) == len(expected):
        index = next(i for i, value in enumerate(stored) if value != expected[i])
        stored, expected, position = stored[index], expected[index], f"{position} at {index}"
    if isinstance(stored, dict) and isinstance(expected, dict):
        keys = [key for key in expected if stored.get(key) != expected[key]]
        stored, expected = ({key: values.get(key) for key in keys} for values in (stored, expected))
    return f"{stored!r}{position}; {gives} {expected!r}"
