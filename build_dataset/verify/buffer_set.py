"""Recompute every hash and every rule of a buffer set, and list each violation."""

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.manifests import plan_manifests, planned_buffers
from robomme_interference_data.build_dataset.questions import Marks, planned_questions
from robomme_interference_data.constants import (
    DATASETS,
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    FETCH_RECORD,
    MANIFEST_HEADER,
    MANIFEST_ROWS,
    MANIFESTS,
    QUESTIONS_PATH,
    RULE_VERSION,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.fetched_copy import FetchedCopy
from robomme_interference_data.data.loading import built_datasets
from robomme_interference_data.data.query import Query
from robomme_interference_data.data.questions import Question, read_questions
from robomme_interference_data.data.set_files import pending_rows
from robomme_interference_data.errors import FormatError, InterferenceError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.schema.codec import arrow_schema, to_dict
from robomme_interference_data.schema.conditions import datasets_of, in_order
from robomme_interference_data.schema.manifest import BufferManifest, ManifestHeader
from robomme_interference_data.storage.arrays import combine
from robomme_interference_data.storage.encode import CODECS, decode_image
from robomme_interference_data.storage.files import LocalFiles, all_files, is_hidden, sha256_file
from robomme_interference_data.storage.parquet import open_parquet
from robomme_interference_data.storage.staging import staging_path

from .dataset import HEADER, UNLISTED, Violation, caught, dataset_violations, index_violations
from .set_files import further_files, unfinished_builds

_ROWS = f"{MANIFESTS}/{MANIFEST_ROWS}"


def verify_buffer_set(
    buffer_set: BufferSet, *, decode: bool = True, progress: WorkProgress | None = None
) -> Iterator[Violation]:
    """Check a buffer set, yielding violations as they are found.

    Checked are: the SHA-256 of every file, and that none is missing or unlisted; with `decode`,
    every frame and vector of every episode against its recorded hashes; LeRobot's columns;
    the hashes of embeddings, which are not recomputed; every manifest row and question,
    which are planned again from the datasets, rules and seed and compared; with `decode`, the first
    frame of every execution against the query frame, and the questions' pictures, if Pillow is
    installed.

    Args:
        buffer_set: The buffer set; one on the Hub is downloaded completely.
        decode: Whether to decode all data, which takes most of the time.
        progress: Shows how many frames are decoded.
    """
    progress = progress or WorkProgress(quiet=True)
    header, root, copy = buffer_set.header, buffer_set.files.snapshot("*"), buffer_set.copy
    yield from _files(buffer_set, root)
    datasets: dict[str, Dataset] = {}
    for name in buffer_set.datasets:
        try:
            folder = buffer_set.dataset_files(name).snapshot("*")
            datasets[name] = Dataset(LocalFiles(folder))
        except InterferenceError as error:
            yield Violation(name, error.message)
            continue
        if not folder.is_relative_to(root):  # in a repository of its own
            for path in further_files(folder, ()):
                yield Violation(f"{name}/{path}", "is not part of the dataset")
    yield from _datasets(datasets, header, copy, progress if decode else None)
    if len(datasets) == len(buffer_set.datasets):
        yield from caught(MANIFESTS, _buffers(buffer_set, datasets))
    if decode and {DEMONSTRATIONS, EXECUTIONS} <= datasets.keys():
        executions, demonstrations = datasets[EXECUTIONS], datasets[DEMONSTRATIONS]
        yield from caught(EXECUTIONS, _executions(executions, demonstrations, copy))
    if header.questions is not None and (copy is None or copy.lists(root, QUESTIONS_PATH)):
        yield from caught(QUESTIONS_PATH, _table(root, QUESTIONS_PATH, Question))
        yield from caught(QUESTIONS_PATH, _questions(buffer_set, decode=decode))
    elif (root / QUESTIONS_PATH).exists():
        yield Violation(QUESTIONS_PATH, f"is not listed in {HEADER}")


def verify_datasets(
    root: Path, *, decode: bool = True, progress: WorkProgress | None = None
) -> Iterator[Violation]:
    """Check the datasets in a folder for which no buffers are planned yet; see `verify_buffer_set`.

    Args:
        root: The folder.
        decode: Whether to decode all data.
        progress: Shows how many frames are decoded.
    """
    progress = progress or WorkProgress(quiet=True)
    built = built_datasets(root)
    yield from _unfinished(root)
    for path in further_files(root, built):
        yield Violation(path, "is not part of the buffer set")
    datasets: dict[str, Dataset] = {}
    for name in built:
        try:
            datasets[name] = Dataset(LocalFiles(root / name))
        except InterferenceError as error:
            yield Violation(name, error.message)
    yield from _datasets(datasets, None, None, progress if decode else None)


def _datasets(
    datasets: Mapping[str, Dataset],
    header: ManifestHeader | None,
    copy: FetchedCopy | None,
    progress: WorkProgress | None,
) -> Iterator[Violation]:
    """Check datasets and the embeddings beside them; see `dataset_violations`."""
    frames = sum(_frames(dataset, copy) for dataset in datasets.values())
    if progress is not None and frames:
        progress.start("Verifying", frames)
    units = datasets.get(DISTRACTORS)
    for name, dataset in datasets.items():
        yield from caught(name, dataset_violations(name, dataset, header, units, progress, copy))
        yield from index_violations(name, dataset, units, copy)


def undecoded_frames(buffer_set: BufferSet) -> int:
    """Return the number of frames that a copy holds and `verify_buffer_set` cannot decode.

    They are of episodes of which only some cameras were fetched: hashes need all of them.
    """
    copy = buffer_set.copy
    if copy is None:
        return 0
    return sum(
        record.length
        for dataset in buffer_set.datasets.values()
        for record in dataset.records()
        if copy.holds(dataset, record.episode_index)
        and not copy.holds_all(dataset, record.episode_index)
    )


def _files(buffer_set: BufferSet, root: Path) -> Iterator[Violation]:
    """Check the manifests' files; name what a copy has lost, and what belongs to nothing."""
    header = buffer_set.header
    for path in all_files(root / MANIFESTS):
        # Of our own, hidden rows belong to manifests whose replacement was interrupted; the next
        # build removes them.
        known = (MANIFEST_HEADER, MANIFEST_ROWS, Path(FETCH_RECORD).name)
        if path not in known and not is_hidden(path):
            yield Violation(f"{MANIFESTS}/{path}", UNLISTED)
    pending = pending_rows(header)
    rows = pending if (root / pending).is_file() else _ROWS
    if not (root / rows).is_file():
        yield Violation(rows, "is missing")
    elif sha256_file(root / rows) != header.rows:
        yield Violation(rows, f"does not have the SHA-256 of {MANIFEST_HEADER}")
    else:
        yield from caught(MANIFESTS, _table(root, rows, BufferManifest))
    yield from _unfinished(root)
    unplanned = [name for name in built_datasets(root) if name not in header.datasets]
    for name in unplanned:
        command = shlex.join(["robomme-interference", "build", str(root), "--only", MANIFESTS])
        yield Violation(name, f"is built, but no buffers are planned with it: run {command}")
    for path in further_files(root, [*header.datasets, *unplanned]):
        yield Violation(path, "is not part of the buffer set")
    recorded = buffer_set.copy.record.files if buffer_set.copy is not None else ()
    for path in recorded:
        if "/" not in path and not (root / path).is_file():
            yield Violation(path, "is missing")


def _unfinished(root: Path) -> Iterator[Violation]:
    for name in unfinished_builds(root):
        folder = staging_path(root / name)
        what = f"is an unfinished build of the {name}: resume it with the command that began it, or"
        yield Violation(folder.name, f"{what} remove it with rm -r {shlex.quote(str(folder))}")


def _frames(dataset: Dataset, copy: FetchedCopy | None) -> int:
    """Return how many frames of a dataset are decoded."""
    if copy is None:
        return dataset.identity.counts.frames
    held = (record for record in dataset.records() if copy.holds_all(dataset, record.episode_index))
    return sum(record.length for record in held)


def _table(root: Path, path: str, record: type) -> Iterator[Violation]:
    """Check that a table has the columns of its records, and no others."""
    schema, expected = open_parquet(LocalFiles(root).path(path)).schema_arrow, arrow_schema(record)
    if not schema.remove_metadata().equals(expected):
        differing = {field.name for field in {*schema} ^ {*expected}}
        yield Violation(path, f"does not have the declared columns; differing: {sorted(differing)}")


def _buffers(buffer_set: BufferSet, datasets: Mapping[str, Dataset]) -> Iterator[Violation]:
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
                yield Violation(name, f"{field} is {_difference(row[field], value)}")
    yield from (Violation(name, f"should not be in {MANIFEST_ROWS}") for name in stored)
    if header.counts != counts:
        yield Violation(HEADER, f"counts are {header.counts}; expected {counts}")
    needed = {*datasets_of(in_order(header.conditions))}
    if not needed <= header.datasets.keys() <= {*DATASETS}:
        yield Violation(HEADER, f"datasets are {sorted(header.datasets)}")


def _executions(
    executions: Dataset, demonstrations: Dataset, copy: FetchedCopy | None
) -> Iterator[Violation]:
    """Check that executions begin with the query frames of demonstrations, bit for bit."""
    codecs = [CODECS.get(dataset.identity.codec) for dataset in (executions, demonstrations)]
    if not all(codec and codec.exact for codec in codecs):
        return
    queries = {record.episode_id: record.span_sha256 for record in demonstrations.records()}
    for record in executions.records():
        if copy is not None and not copy.holds_all(executions, record.episode_index):
            continue
        [first] = executions.digests(record.episode_index, [(0, 1)])
        query = queries.get(record.episode_id)
        if query is not None and combine(first) != query.query:
            what = f"does not begin with the query frame of the {DEMONSTRATIONS}"
            yield Violation(f"{EXECUTIONS} {record.episode_id}", what)


def _questions(buffer_set: BufferSet, *, decode: bool) -> Iterator[Violation]:
    """Plan all questions again, draw their pictures, and compare them with the stored ones."""
    stored = read_questions(buffer_set)
    drawn = decode and find_spec("PIL") is not None
    for question, marks in planned_questions(buffer_set):
        where = f"{QUESTIONS_PATH} {question.episode_id}"
        kept = stored.pop(question.episode_id)
        if (found := replace(kept, picture=b"")) != question:
            yield Violation(where, f"is {_difference(to_dict(found), to_dict(question))}")
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


def _is_picture(stored: NDArray[np.uint8], query: Query, marks: Marks) -> bool:
    from robomme_interference_data.build_dataset.question_pictures import is_picture

    return is_picture(stored, query.frame(), marks)


def _difference(stored: Any, expected: Any) -> str:
    """Return two different values, shortened to where they differ."""
    position = ""
    while isinstance(stored, list) and isinstance(expected, list) and len(stored) == len(expected):
        index = next(i for i, value in enumerate(stored) if value != expected[i])
        stored, expected, position = stored[index], expected[index], f"{position} at {index}"
    if isinstance(stored, dict) and isinstance(expected, dict):
        keys = [key for key in expected if stored.get(key) != expected[key]]
        stored, expected = ({key: values.get(key) for key in keys} for values in (stored, expected))
    return f"{stored!r}{position}; the rules give {expected!r}"
