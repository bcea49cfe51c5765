"""Recompute every hash and every rule of a buffer set, and list each violation."""

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    DATASETS,
    DISTRACTORS,
    IDENTITY_PATH,
    INDEX_DIR,
    INDEX_HEADER,
    LESSONS,
    MANIFEST_HEADER,
    MANIFEST_ROWS,
    MANIFESTS,
    QUESTIONS_PATH,
    REPORT_PATH,
    RULE_VERSION,
    SHIFTED,
    UNIT_MIN_RAW_FRAMES,
    UNITS,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.embeddings import IndexHeader, index_folder
from robomme_interference_data.data.manifest_table import pending_rows
from robomme_interference_data.data.questions import Question, read_questions
from robomme_interference_data.errors import FormatError, InterferenceError, visible
from robomme_interference_data.runtime.progress import WorkProgress
from robomme_interference_data.schema.codec import arrow_schema, to_dict
from robomme_interference_data.schema.conditions import datasets_of
from robomme_interference_data.schema.manifest import BufferManifest, ManifestHeader
from robomme_interference_data.schema.records import EpisodeRecord
from robomme_interference_data.schema.shifts import SHIFTS
from robomme_interference_data.storage.arrays import combine
from robomme_interference_data.storage.encode import CODECS, decode_image
from robomme_interference_data.storage.files import (
    LocalFiles,
    all_files,
    read_header,
    read_json,
    sha256_file,
)
from robomme_interference_data.storage.parquet import open_parquet

from .identity import BuildReport, identity_of, listed_files, report_of
from .image_stats import ImageStats, Statistics, episode_statistics, episode_table
from .lerobot_checks import lerobot_violations
from .manifests import plan_manifests, planned_buffers
from .questions import planned_questions

_UNLISTED = "is not listed"
_HEADER = f"{MANIFESTS}/{MANIFEST_HEADER}"
_ROWS = f"{MANIFESTS}/{MANIFEST_ROWS}"


@dataclass(frozen=True)
class Violation:
    """Something in a buffer set that differs from its records or from the rules.

    Attributes:
        where: File, episode or buffer.
        what: The value found, and the expected one.
    """

    where: str
    what: str


def verify_buffer_set(
    buffer_set: BufferSet, *, decode: bool = True, progress: WorkProgress | None = None
) -> Iterator[Violation]:
    """Check a buffer set, yielding violations as they are found.

    Checked are: the SHA-256 of every file, and that none is missing or unlisted; with `decode`,
    every frame and vector of every episode against its recorded hashes; LeRobot's columns and
    statistics; the hashes of embeddings, which are not recomputed; every manifest row and question,
    which are planned again from the datasets, rules and seed and compared, except the questions'
    pictures.

    Args:
        buffer_set: The buffer set; one on the Hub is downloaded completely.
        decode: Whether to decode all data, which takes most of the time.
        progress: Shows how many frames are decoded.
    """
    return _buffer_set(buffer_set, decode, progress or WorkProgress(quiet=True))


def _buffer_set(buffer_set: BufferSet, decode: bool, progress: WorkProgress) -> Iterator[Violation]:
    header, root = buffer_set.header, buffer_set.files.snapshot("*")
    for path in all_files(root / MANIFESTS):
        # Hidden rows belong to manifests whose replacement was interrupted; the next build removes
        # them.
        hidden = path.startswith(".") and path.endswith(".parquet")
        if path not in (MANIFEST_HEADER, MANIFEST_ROWS) and not hidden:
            yield Violation(f"{MANIFESTS}/{path}", _UNLISTED)
    rows = pending if (root / (pending := pending_rows(header))).is_file() else _ROWS
    if not (root / rows).is_file():
        yield Violation(rows, "is missing")
    elif sha256_file(root / rows) != header.rows:
        yield Violation(rows, f"does not have the SHA-256 of {MANIFEST_HEADER}")
    else:
        yield from _caught(MANIFESTS, _table(root, rows, BufferManifest))
    datasets: dict[str, Dataset] = {}
    for name in header.datasets:
        try:
            datasets[name] = Dataset(LocalFiles(buffer_set.dataset_files(name).snapshot("*")))
        except InterferenceError as error:
            yield Violation(name, error.message)
    frames = sum(dataset.identity.counts.frames for dataset in datasets.values())
    progress.start("Verifying", frames if decode else 0)
    for name, dataset in datasets.items():
        yield from _caught(name, _dataset(name, dataset, header, progress if decode else None))
        yield from _indexes(name, dataset, datasets.get(DISTRACTORS))
    if len(datasets) == len(header.datasets):
        yield from _caught(MANIFESTS, _buffers(buffer_set, datasets))
    if (root / QUESTIONS_PATH).is_file():
        yield from _caught(QUESTIONS_PATH, _table(root, QUESTIONS_PATH, Question))
        yield from _caught(QUESTIONS_PATH, _questions(buffer_set))


def _caught(where: str, violations: Iterable[Violation]) -> Iterator[Violation]:
    """Yield violations; an error on the way is the last one."""
    try:
        yield from violations
    except InterferenceError as error:
        yield Violation(where, error.message)


def _table(root: Path, path: str, record: type) -> Iterator[Violation]:
    """Check that a table has the columns of its records, and no others."""
    schema, expected = open_parquet(root / path).schema_arrow, arrow_schema(record)
    if not schema.remove_metadata().equals(expected):
        differing = {field.name for field in {*schema} ^ {*expected}}
        yield Violation(path, f"does not have the declared columns; differing: {sorted(differing)}")


def _dataset(
    name: str, dataset: Dataset, header: ManifestHeader, progress: WorkProgress | None
) -> Iterator[Violation]:
    yield from _files(name, dataset, header)
    records = list(dataset.records())
    yield from _identity(name, dataset, records, header)
    yield from _report(name, dataset, records)
    yield from (Violation(f"{name}/{where}", what) for where, what in lerobot_violations(dataset))
    statistics = None if progress is None else episode_statistics(episode_table(dataset))
    for record in records:
        where = f"{name} {record.episode_id}"
        yield from _record(where, name, record)
        if progress is not None and statistics is not None:
            stored = statistics[record.episode_index]
            yield from _caught(where, _episode(where, dataset, record, stored))
            progress.advance(record.length)


def _files(name: str, dataset: Dataset, header: ManifestHeader) -> Iterator[Violation]:
    """Check every byte of a dataset: identity, list of sums, and all files in it."""
    files, root = dataset.files, dataset.files.snapshot()
    if sha256_file(files.path(IDENTITY_PATH)) != header.datasets[name].identity:
        yield Violation(f"{name}/{IDENTITY_PATH}", f"does not have the SHA-256 of {_HEADER}")
    sums = dataset.sums()
    # A fetched buffer set has one dataset at its root, and the others in folders there.
    others = tuple(f"{other}/" for other in header.datasets if other != name)
    existing = {path for path in listed_files(root) if not path.startswith(others)}
    for path in sorted(sums.keys() | existing):
        if path not in sums:
            yield Violation(f"{name}/{path}", _UNLISTED)
        elif problem := _file_problem(root, path):
            yield Violation(f"{name}/{path}", problem)
        elif sha256_file(files.path(path)) != sums[path]:
            yield Violation(f"{name}/{path}", "does not have the recorded SHA-256")


def _file_problem(root: Path, path: str) -> str | None:
    """Return why a listed file cannot be read as a file of its dataset, if so."""
    folders = [root / folder for folder in Path(path).parents if folder != Path()]
    if linked := [folder for folder in folders if folder.is_symlink()]:
        return f"is in {linked[-1].relative_to(root)}, a link; expected a folder"
    if (root / path).is_file():
        return None
    return "is not a regular file" if (root / path).exists() else "is missing"


def _identity(
    name: str, dataset: Dataset, records: list[EpisodeRecord], header: ManifestHeader
) -> Iterator[Violation]:
    stored, where = dataset.identity, f"{name}/{IDENTITY_PATH}"
    made = identity_of(records, name, stored.version, stored.codec, stored.sources, stored.sums)
    for field, value in (vars(made) | {"cameras": dataset.cameras}).items():
        if getattr(stored, field) != value:
            what = f"{field} is {getattr(stored, field)}; the episodes give {value}"
            yield Violation(where, what)
    if stored.codec not in CODECS:
        yield Violation(where, f"codec {stored.codec!r} is unknown")
    recorded = header.datasets[name]
    for field in ("kind", "version", "revision"):
        if getattr(recorded, field) != getattr(stored, field):
            what = f"{field} of the {name} is {getattr(recorded, field)}; the dataset has "
            yield Violation(_HEADER, f"{what}{getattr(stored, field)}")


def _report(name: str, dataset: Dataset, records: list[EpisodeRecord]) -> Iterator[Violation]:
    where = f"{name}/{REPORT_PATH}"
    report = read_header(dataset.files.path(REPORT_PATH), BuildReport)
    skipped = {str(one.episode_id): one.why for one in report.skipped}
    if read_json(dataset.files.path(REPORT_PATH)) != report_of(dataset.identity, skipped):
        yield Violation(where, "does not have the counts of the dataset, or is not in order")
    if stored := skipped.keys() & {str(record.episode_id) for record in records}:
        yield Violation(where, f"{min(stored)} is skipped, and in the dataset")
    if any(visible(reason) != reason for reason in skipped.values()):
        yield Violation(where, "has control characters")


def _record(where: str, name: str, record: EpisodeRecord) -> Iterator[Violation]:
    start = record.exec_start_idx
    lessons = {name in LESSONS, start is not None, record.span_sha256 is not None}
    if len(lessons) > 1:
        yield Violation(where, f"exec_start_idx is {start}")
        return
    if start is not None:
        expected = range(start + 1, start + 2)
    elif name == SHIFTED:
        expected = range(len(SHIFTS), len(SHIFTS) + 1)
    else:
        most, stride = UNITS[name]
        expected = range((UNIT_MIN_RAW_FRAMES - 1) // stride + 1, most + 1)
    if record.length not in expected:
        yield Violation(where, f"holds {record.length} frames, not {expected[-1]}")


def _episode(
    where: str, dataset: Dataset, record: EpisodeRecord, statistics: Statistics
) -> Iterator[Violation]:
    recorded, spans = record.feature_sha256, record.spans
    images: defaultdict[str, ImageStats] = defaultdict(ImageStats)

    def count(feature: str, value: NDArray[Any]) -> None:
        if feature.startswith(CAMERA_PREFIX):
            images[feature].add(value)

    session, *parts = dataset.digests(
        record.episode_index, [record.session, *spans.values()], count
    )
    codec = CODECS.get(dataset.identity.codec)
    for feature, counted in images.items() if codec and codec.exact else ():
        for name, value in counted.result().items():
            stored = statistics.get(feature, {}).get(name, np.empty(0))
            # Compared as LeRobot scales them: different means can become one number.
            if not np.array_equal(stored, value if name == "count" else value / 255):
                yield Violation(where, f"stats/{feature}/{name} is not that of its frames")
    for feature in sorted(session.keys() | recorded.keys()):
        if session.get(feature) != recorded.get(feature):
            yield Violation(where, f"{feature} does not have the recorded SHA-256")
    for (name, (start, stop)), part in zip(spans.items(), parts, strict=True):
        if combine(part) != getattr(record.span_sha256, name, None):
            what = f"frames {start} to {stop - 1} ({name}) do not have the recorded SHA-256"
            yield Violation(where, what)


def _indexes(name: str, dataset: Dataset, units: Dataset | None) -> Iterator[Violation]:
    """Check the embeddings beside a dataset, of any encoders and cameras."""
    root = dataset.files.snapshot() / INDEX_DIR
    folders: set[str] = set()
    for path in all_files(root):
        folder, _, file = path.partition("/")
        if not file:
            yield Violation(f"{name}/{INDEX_DIR}/{path}", _UNLISTED)
        elif not path.startswith("."):  # an index that is being made
            folders.add(f"{INDEX_DIR}/{folder}")
            if not (root / path).is_file():
                yield Violation(f"{name}/{INDEX_DIR}/{path}", "is a broken link, or no file")
    for folder in sorted(folders):
        yield from _caught(f"{name}/{folder}", _index(name, dataset, folder, units))


def _index(name: str, dataset: Dataset, folder: str, units: Dataset | None) -> Iterator[Violation]:
    where = f"{name}/{folder}"
    header = read_header(dataset.files.path(f"{folder}/{INDEX_HEADER}"), IndexHeader)
    encoder, camera = header.encoder.name, header.camera
    if index_folder(encoder, camera) != folder:
        yield Violation(where, f"holds the embeddings of {encoder}, camera {camera}")
        return
    lengths = {record.episode_index: record.length for record in dataset.records()}
    dataset.index(encoder, camera).check(lengths, units=name == DISTRACTORS)
    with suppress(InterferenceError):  # reported where the units are checked
        made = dataset.index(encoder, camera).made
        if units is not None and units.index(encoder, camera).made != made:
            yield Violation(where, f"was made with another encoder than that of the {DISTRACTORS}")


def _buffers(buffer_set: BufferSet, datasets: Mapping[str, Dataset]) -> Iterator[Violation]:
    """Plan all buffers again, and compare them with the rows."""
    header, files = buffer_set.header, {name: one.files for name, one in datasets.items()}
    if header.rule_version != RULE_VERSION:
        what = f"rule version {header.rule_version}; this package can check {RULE_VERSION}"
        yield Violation(_HEADER, what)
        return
    plan = plan_manifests(files, header.conditions, header.seed, header.position_limit)
    stored = {str(manifest): to_dict(manifest) for manifest in buffer_set.manifests()}
    order = list(stored)
    counts = {"queries": len(plan.demonstrations), "buffers": 0, "sessions": 0}
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
        yield Violation(_HEADER, f"counts are {header.counts}; expected {counts}")
    needed = set(datasets_of(plan.conditions))
    if not needed <= header.datasets.keys() <= {*DATASETS}:
        yield Violation(_HEADER, f"datasets are {sorted(header.datasets)}")


def _questions(buffer_set: BufferSet) -> Iterator[Violation]:
    """Plan all questions again, and compare them with the stored ones."""
    stored = read_questions(buffer_set)
    for question, _ in planned_questions(buffer_set):
        where = f"{QUESTIONS_PATH} {question.episode_id}"
        one = stored.pop(question.episode_id)
        if (found := replace(one, picture=b"")) != question:
            yield Violation(where, f"is {_difference(to_dict(found), to_dict(question))}")
            continue
        try:  # not compared: versions of Pillow draw letters a little differently
            decode_image(one.picture)
        except FormatError as error:
            yield Violation(where, error.message)
    yield from (Violation(f"{QUESTIONS_PATH} {one}", "belongs to no query") for one in stored)


def _difference(stored: Any, expected: Any) -> str:
    """Return two different values, shortened to where they differ."""
    position = ""
    while isinstance(stored, list) and isinstance(expected, list) and len(stored) == len(expected):
        index = next(i for i, value in enumerate(stored) if value != expected[i])
        stored, expected, position = stored[index], expected[index], f"{position} at {index}"
    if isinstance(stored, dict) and isinstance(expected, dict):
        keys = [key for key in expected if stored.get(key) != expected[key]]
        stored, expected = ({key: one.get(key) for key in keys} for one in (stored, expected))
    return f"{stored!r}{position}; the rules give {expected!r}"
