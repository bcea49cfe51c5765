"""Recompute every hash and every rule of a buffer set, and name each violation."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
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
    INFO_PATH,
    LESSONS,
    MANIFEST_HEADER,
    MANIFEST_PATH,
    MANIFEST_ROWS,
    MANIFESTS,
    QUESTIONS_PATH,
    REPORT_PATH,
    RULE_VERSION,
    SHIFTED,
    STATS_PATH,
    SUMS_PATH,
    UNIT_MIN_RAW_FRAMES,
    UNITS,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.embeddings import IndexHeader, index_folder
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
    indented_json,
    read_header,
    read_json,
    sha256_file,
)
from robomme_interference_data.storage.parquet import open_parquet

from .identity import BuildReport, identity_of, listed_files, report_of
from .image_stats import (
    ImageStats,
    Statistics,
    episode_statistics,
    episode_table,
)
from .lerobot_checks import lerobot_violations
from .manifests import plan_manifests, planned_buffers
from .questions import planned_questions

_TOO_MANY = "is too many: it is in no list"


@dataclass(frozen=True)
class Violation:
    """Something in a buffer set that is not as recorded or as the rules say.

    Attributes:
        where: File, episode or buffer.
        what: What was found, and what was expected.
    """

    where: str
    what: str


def verify_buffer_set(
    buffer_set: BufferSet, *, decode: bool = True, progress: WorkProgress | None = None
) -> Iterator[Violation]:
    """Check a buffer set, yielding violations as they are found.

    Checked are: the SHA-256 of every file, and that none is missing or too many; with `decode`,
    every frame and vector of every episode against its recorded hashes; what LeRobot's columns
    and statistics mean; embeddings that lie beside the data, if any, against their hashes (they
    are not made anew); every manifest row, which is made anew from the datasets, rules and seed
    and compared field by field; and so every question, if there are any, but for its picture.

    Args:
        buffer_set: The buffer set; all of one on the Hub is downloaded.
        decode: Whether to decode all data: by far the longest part.
        progress: Where to show how many frames are decoded.
    """
    return _buffer_set(buffer_set, decode, progress or WorkProgress(quiet=True))


def _buffer_set(buffer_set: BufferSet, decode: bool, progress: WorkProgress) -> Iterator[Violation]:
    header, own = buffer_set.header, buffer_set.files.snapshot("*")
    yield from _json(own / MANIFEST_PATH, MANIFEST_PATH)
    for path in all_files(own / MANIFESTS):
        if path not in (MANIFEST_HEADER, MANIFEST_ROWS):
            yield Violation(f"{MANIFESTS}/{path}", _TOO_MANY)
    rows = own / MANIFESTS / MANIFEST_ROWS
    if not rows.is_file():
        yield Violation(f"{MANIFESTS}/{MANIFEST_ROWS}", "is missing")
    elif sha256_file(rows) != header.rows:
        what = f"does not have the SHA-256 of {MANIFEST_HEADER}"
        yield Violation(f"{MANIFESTS}/{MANIFEST_ROWS}", what)
    else:
        yield from _told(MANIFESTS, _table(own, f"{MANIFESTS}/{MANIFEST_ROWS}", BufferManifest))
    datasets: dict[str, Dataset] = {}
    for name in header.datasets:
        try:
            datasets[name] = Dataset(LocalFiles(buffer_set.dataset_files(name).snapshot("*")))
        except InterferenceError as error:
            yield Violation(name, error.message)
    frames = sum(dataset.identity.counts.frames for dataset in datasets.values())
    progress.start("Verifying", frames if decode else 0)
    for name, dataset in datasets.items():
        yield from _told(name, _dataset(name, dataset, header, progress if decode else None))
        yield from _indexes(name, dataset, datasets.get(DISTRACTORS))
    if len(datasets) == len(header.datasets):
        yield from _told(MANIFESTS, _buffers(buffer_set, datasets))
    if (own / QUESTIONS_PATH).is_file():
        yield from _told(QUESTIONS_PATH, _table(own, QUESTIONS_PATH, Question))
        yield from _told(QUESTIONS_PATH, _questions(buffer_set))


def _told(where: str, violations: Iterable[Violation]) -> Iterator[Violation]:
    """Yield violations; an error of what is read on the way is one, too, and the last."""
    try:
        yield from violations
    except InterferenceError as error:
        yield Violation(where, error.message)


def _json(
    file: Path, where: str, text: Callable[[Any], str] = indented_json
) -> Iterator[Violation]:
    """Check that a JSON file has the bytes that its values are written as."""
    if file.read_bytes() != text(read_json(file)).encode(errors="backslashreplace"):
        yield Violation(where, "is not written as this package writes it")


def _table(root: Path, path: str, record: type) -> Iterator[Violation]:
    """Check that a table has the columns of its records, and no others."""
    found, expected = open_parquet(root / path).schema_arrow, arrow_schema(record)
    if not found.remove_metadata().equals(expected):
        differing = {field.name for field in {*found} ^ {*expected}}
        yield Violation(path, f"does not have the declared columns; differing: {sorted(differing)}")


_LEROBOT_TEXT: dict[str, Callable[[Any], str]] = {
    INFO_PATH: partial(json.dumps, indent=4, ensure_ascii=False),
    STATS_PATH: lambda value: json.dumps(value, indent=4, sort_keys=True) + "\n",
}


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
            own = statistics[record.episode_index]
            yield from _told(where, _episode(where, dataset, record, own))
            progress.advance(record.length)


def _files(name: str, dataset: Dataset, header: ManifestHeader) -> Iterator[Violation]:
    """Check every byte of a dataset: identity, list of sums, and all files in it."""
    files, root = dataset.files, dataset.files.snapshot()
    if sha256_file(files.path(IDENTITY_PATH)) != header.datasets[name].identity:
        what = f"does not have the SHA-256 of {MANIFESTS}/{MANIFEST_HEADER}"
        yield Violation(f"{name}/{IDENTITY_PATH}", what)
    # Of a buffer set that was fetched, one dataset is at its root, and the other in a folder there.
    others = tuple(f"{other}/" for other in header.datasets if other != name)
    for path in (IDENTITY_PATH, REPORT_PATH, INFO_PATH, STATS_PATH):
        text = _LEROBOT_TEXT.get(path, indented_json)
        yield from _json(files.path(path), f"{name}/{path}", text)
    sums = dataset.sums()
    lines = "".join(f"{digest}  {path}\n" for path, digest in sorted(sums.items()))
    if files.path(SUMS_PATH).read_bytes() != lines.encode():
        yield Violation(f"{name}/{SUMS_PATH}", "is not written as this package writes it")
    there = {path for path in listed_files(root) if not path.startswith(others)}
    for path in sorted(sums.keys() | there):
        if path not in sums:
            yield Violation(f"{name}/{path}", _TOO_MANY)
        elif path not in there or not (root / path).is_file():
            yield Violation(f"{name}/{path}", "is missing")
        elif sha256_file(files.path(path)) != sums[path]:
            yield Violation(f"{name}/{path}", "does not have the recorded SHA-256")


def _identity(
    name: str, dataset: Dataset, records: list[EpisodeRecord], header: ManifestHeader
) -> Iterator[Violation]:
    given, where = dataset.identity, f"{name}/{IDENTITY_PATH}"
    made = identity_of(records, name, given.version, given.codec, given.sources, given.sums)
    for field, value in (vars(made) | {"cameras": dataset.cameras}).items():
        if getattr(given, field) != value:
            yield Violation(where, f"{field} is {getattr(given, field)}; its episodes say {value}")
    if given.codec not in CODECS:
        yield Violation(where, f"codec {given.codec!r} is unknown")
    recorded = header.datasets[name]
    for field in ("kind", "version", "revision"):
        if getattr(recorded, field) != getattr(given, field):
            what = f"{field} of the {name} is {getattr(recorded, field)}; the dataset says "
            yield Violation(f"{MANIFESTS}/{MANIFEST_HEADER}", f"{what}{getattr(given, field)}")


def _report(name: str, dataset: Dataset, records: list[EpisodeRecord]) -> Iterator[Violation]:
    where = f"{name}/{REPORT_PATH}"
    report = read_header(dataset.files.path(REPORT_PATH), BuildReport)
    skipped = {str(one.episode_id): one.why for one in report.skipped}
    if read_json(dataset.files.path(REPORT_PATH)) != report_of(dataset.identity, skipped):
        yield Violation(where, "does not have the counts of the dataset, or an order of its own")
    if there := skipped.keys() & {str(record.episode_id) for record in records}:
        yield Violation(where, f"{min(there)} is skipped, and in the dataset")
    if any(visible(why) != why for why in skipped.values()):
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

    wanted = [record.session, *spans.values()]
    session, *parts = dataset.digests(record.episode_index, wanted, count)
    codec = CODECS.get(dataset.identity.codec)
    for feature, found in images.items() if codec and codec.exact else ():
        for one, value in found.result().items():
            scaled = statistics.get(feature, {}).get(one, np.empty(0))
            # Forwards: several means are the same number once LeRobot has divided them.
            if not np.array_equal(scaled, value if one == "count" else value / 255):
                yield Violation(where, f"stats/{feature}/{one} is not that of its frames")
    for feature in sorted(session.keys() | recorded.keys()):
        if session.get(feature) != recorded.get(feature):
            yield Violation(where, f"{feature} does not have the recorded SHA-256")
    for name, part in zip(spans, parts, strict=True):
        if combine(part) != getattr(record.span_sha256, name, None):
            told = f"frames {spans[name][0]} to {spans[name][1] - 1} ({name})"
            yield Violation(where, f"{told} do not have the recorded SHA-256")


def _indexes(name: str, dataset: Dataset, units: Dataset | None) -> Iterator[Violation]:
    """Check the embeddings beside a dataset, whatever encoders and cameras they are of."""
    root = dataset.files.snapshot() / INDEX_DIR
    folders: dict[str, list[str]] = {}
    for path in all_files(root):
        folder, _, file = path.partition("/")
        if not file:
            yield Violation(f"{name}/{INDEX_DIR}/{path}", _TOO_MANY)
        elif not path.startswith("."):  # one that is being made
            folders.setdefault(f"{INDEX_DIR}/{folder}", []).append(path)
    for folder, files in folders.items():
        yield from _told(f"{name}/{folder}", _index(name, dataset, folder, units))
        for path in files:
            if not (root / path).is_file():
                yield Violation(f"{name}/{INDEX_DIR}/{path}", "leads nowhere")


def _index(name: str, dataset: Dataset, folder: str, units: Dataset | None) -> Iterator[Violation]:
    where = f"{name}/{folder}"
    path = dataset.files.path(f"{folder}/{INDEX_HEADER}")
    header = read_header(path, IndexHeader)
    yield from _json(path, where)
    made = header.encoder.name, header.camera
    if index_folder(*made) != folder:
        yield Violation(where, f"holds the embeddings of {made[0]}, camera {made[1]}")
        return
    lengths = {record.episode_index: record.length for record in dataset.records()}
    dataset.index(*made).check(lengths, units=name == DISTRACTORS)
    with suppress(InterferenceError):  # which is told where the units are checked
        if units is not None and units.index(*made).made != dataset.index(*made).made:
            yield Violation(where, f"was made with another encoder than that of the {DISTRACTORS}")


def _buffers(buffer_set: BufferSet, datasets: Mapping[str, Dataset]) -> Iterator[Violation]:
    """Plan all buffers anew, and compare them with the rows."""
    header, places = buffer_set.header, {name: one.files for name, one in datasets.items()}
    where = f"{MANIFESTS}/{MANIFEST_HEADER}"
    if header.rule_version != RULE_VERSION:
        what = f"rule version {header.rule_version}; this package can check {RULE_VERSION}"
        yield Violation(where, what)
        return
    plan = plan_manifests(places, header.conditions, header.seed, header.position_limit)
    given = {str(manifest): to_dict(manifest) for manifest in buffer_set.manifests()}
    order = list(given)
    counts = {"queries": len(plan.demonstrations), "buffers": 0, "sessions": 0}
    for number, manifest in enumerate(planned_buffers(plan)):
        counts["buffers"] += 1
        counts["sessions"] += len(manifest.sessions)
        row = given.pop(str(manifest), None)
        if row is None:
            yield Violation(str(manifest), f"is missing in {MANIFEST_ROWS}")
            continue
        if number >= len(order) or order[number] != str(manifest):
            yield Violation(str(manifest), f"is not in its place in {MANIFEST_ROWS}")
        for field, value in to_dict(manifest).items():
            if row[field] != value:
                told, rules = _difference(row[field], value)
                yield Violation(str(manifest), f"{field} is {told}; the rules give {rules}")
    yield from (Violation(name, f"should not be in {MANIFEST_ROWS}") for name in given)
    if header.counts != counts:
        yield Violation(where, f"counts are {header.counts}; there are {counts}")
    needed = set(datasets_of(plan.conditions))
    if not needed <= header.datasets.keys() <= {*DATASETS}:
        yield Violation(where, f"datasets are {sorted(header.datasets)}")


def _questions(buffer_set: BufferSet) -> Iterator[Violation]:
    """Plan all questions anew, and compare them with those that are there."""
    given = read_questions(buffer_set)
    for question, _ in planned_questions(buffer_set):
        where = f"{QUESTIONS_PATH} {question.episode_id}"
        there = given.pop(question.episode_id, None)
        if there is None:
            yield Violation(where, "is missing")
            continue
        if (found := replace(there, picture=b"")) != question:
            told, rules = _difference(to_dict(found), to_dict(question))
            yield Violation(where, f"is {told}; the rules give {rules}")
            continue
        try:  # not compared: versions of Pillow draw letters a little otherwise
            decode_image(there.picture)
        except FormatError as error:
            yield Violation(where, error.message)
    yield from (Violation(f"{QUESTIONS_PATH} {one}", "is of no query") for one in given)


def _difference(found: Any, expected: Any) -> tuple[str, str]:
    """Shorten two different values to where they differ."""
    if isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        place = next(i for i, value in enumerate(found) if value != expected[i])
        given, wanted = _difference(found[place], expected[place])
        return f"{given} at {place}", wanted
    if isinstance(found, dict) and isinstance(expected, dict):
        keys = [key for key in expected if found.get(key) != expected[key]]
        return str({key: found.get(key) for key in keys}), str({key: expected[key] for key in keys})
    return repr(found), repr(expected)
