"""Recompute every hash and every rule of a split, and name each violation."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from robomme_interference_data.build_dataset.finish import revision_of
from robomme_interference_data.build_dataset.manifests import expected_rows, plan_manifests
from robomme_interference_data.constants import (
    CAMERA_PREFIX,
    DEMONSTRATIONS,
    DISTRACTORS,
    IDENTITY_PATH,
    INDEX_DIR,
    INDEX_HEADER,
    MANIFEST_JSON,
    MANIFEST_JSONL,
    MANIFEST_PARQUET,
    MANIFESTS,
    RULE_VERSION,
    UNIT_FRAMES,
)
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.digest import combine
from robomme_interference_data.embeddings import index_folder
from robomme_interference_data.errors import InterferenceError, InvalidIdError
from robomme_interference_data.files import LocalFiles, read_json, sha256_file
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.manifest_io import ManifestReader
from robomme_interference_data.schema import EpisodeRecord

__all__ = ["Violation", "verify_split"]

Row = dict[str, Any]
Rows = Iterator[Row]

_LEROBOT_COLUMNS = (
    "episode_index",
    "tasks",
    "length",
    "dataset_from_index",
    "dataset_to_index",
)
_LEROBOT_PREFIXES = ("data/", "videos/", "meta/", "stats/")


@dataclass(frozen=True)
class Violation:
    """Something in a split that is not as recorded or as the rules say.

    Attributes:
        where: File, episode or buffer.
        what: What was found, and what was expected.
    """

    where: str
    what: str


def verify_split(
    root: Path, *, decode: bool = True, advance: Callable[[int], None] = lambda frames: None
) -> Iterator[Violation]:
    """Check a split, yielding violations as they are found.

    Checked are: the hashes of the manifest files; the identity of both datasets; with `decode`,
    every frame and vector of every episode against its recorded hashes; embeddings that lie
    beside the data, if any, against theirs (they are not made anew); and every manifest row, which
    is made anew from the datasets, rules and seed and compared field by field.

    Args:
        root: Folder of the split.
        decode: Whether to decode all data: by far the longest part.
        advance: Called with a number of frames whenever so many have been checked.

    Raises:
        MissingFileError, FormatError: The folder is not a split, or not one that can be read.
    """
    reader = ManifestReader(LocalFiles(root / MANIFESTS))
    for name, recorded in reader.header["files"].items():
        path = root / MANIFESTS / name
        if not path.is_file():
            yield Violation(f"{MANIFESTS}/{name}", "is missing")
        elif sha256_file(path) != recorded["sha256"]:
            yield Violation(f"{MANIFESTS}/{name}", "does not have the SHA-256 of manifest.json")
    datasets = {name: Dataset(LocalFiles(root / name)) for name in (DEMONSTRATIONS, DISTRACTORS)}
    for name, dataset in datasets.items():
        yield from _identity(name, dataset, reader)
        for record, tasks in zip(
            dataset.records(), dataset.episodes["tasks"].to_pylist(), strict=True
        ):
            yield from _record(name, record, tasks)
            if decode:
                yield from _episode(name, dataset, record)
                advance(record.length)
        yield from _indexes(name, dataset, datasets[DISTRACTORS].revision)
    yield from _rows(root, reader, datasets)


def _identity(name: str, dataset: Dataset, reader: ManifestReader) -> Iterator[Violation]:
    own = [
        column
        for column in dataset.episodes.column_names
        if column not in _LEROBOT_COLUMNS and not column.startswith(_LEROBOT_PREFIXES)
    ]
    if revision_of(dataset.episodes.select(own).to_pylist()) != dataset.revision:
        yield Violation(name, "the episode table is not the one that the revision was made from")
    found = {
        "counts": {
            "episodes": len(dataset),
            "frames": pc.sum(dataset.episodes["length"]).as_py(),
            "families": dict(Counter(dataset.episodes["family"].to_pylist())),
        },
        "exact": pc.all(dataset.episodes["exact"]).as_py(),
        "cameras": [camera.removeprefix(CAMERA_PREFIX) for camera in dataset.cameras],
        "simulators": sorted({*dataset.episodes["simulator"].to_pylist()} - {None}),
    }
    for field, value in found.items():
        if dataset.identity.get(field) != value:
            what = f"{field} is {dataset.identity.get(field)}; its episodes say {value}"
            yield Violation(f"{name}/{IDENTITY_PATH}", what)
    recorded = reader.header["datasets"][name]
    if recorded["revision"] != dataset.revision:
        yield Violation(name, "is not the revision that the manifests were made for")
    for field, value in recorded.items():
        own_value = dataset.identity.get(field)
        if field != "revision" and value != own_value:
            what = f"{field} of the {name} is {value}; the dataset says {own_value}"
            yield Violation(f"{MANIFESTS}/{MANIFEST_JSON}", what)


def _record(name: str, record: EpisodeRecord, tasks: list[str]) -> Iterator[Violation]:
    start = record.exec_start_idx
    if (start is None) != (name == DISTRACTORS):
        yield Violation(f"{name} {record.id}", f"exec_start_idx is {start}")
    elif record.length != (expected := UNIT_FRAMES if start is None else start + 1):
        yield Violation(f"{name} {record.id}", f"holds {record.length} frames, not {expected}")
    if tasks != [record.goals[0]]:
        yield Violation(f"{name} {record.id}", f"its task is {tasks}; its goal {record.goals[0]!r}")


def _episode(name: str, dataset: Dataset, record: EpisodeRecord) -> Iterator[Violation]:
    spans: list[tuple[str, int, dict[str, str], str | None]] = [
        ("frames", record.length, record.feature_sha256, record.sha256)
    ]
    if record.exec_start_idx is not None:
        recorded = record.lesson_feature_sha256, record.lesson_sha256
        spans.append(("lesson", record.exec_start_idx, *recorded))
    where = f"{name} {record.id}"
    try:
        found = dataset.prefix_digests(record.episode_index, [stop for _, stop, *_ in spans])
    except InterferenceError as error:
        yield Violation(where, error.message)
        return
    for (what, _, features, whole), digests in zip(spans, found, strict=True):
        for feature, digest in digests.items():
            if digest != features.get(feature):
                yield Violation(where, f"{feature} ({what}) does not have the recorded SHA-256")
        if combine(features) != whole:
            yield Violation(where, f"the SHA-256 of its {what} is not that of their features")


def _indexes(name: str, dataset: Dataset, pool: str) -> Iterator[Violation]:
    """Check the embeddings beside a dataset, whatever encoders and cameras they are of."""
    for path in dataset.files.list(INDEX_DIR, f"/{INDEX_HEADER}"):
        folder = str(PurePath(path).parent)
        where = f"{name}/{folder}"
        try:
            header = read_json(dataset.files.path(path))
            made = header["encoder"]["name"], header["camera"]
            if index_folder(*made) != folder:
                yield Violation(where, f"holds the embeddings of {made[0]}, camera {made[1]}")
                continue
            index = dataset.index(*made)
            index.check()
        except InterferenceError as error:
            yield Violation(where, error.message)
        except (KeyError, TypeError, AttributeError):
            yield Violation(where, f"its {INDEX_HEADER} does not say of which encoder and camera")
        else:
            if index.pool != pool:
                yield Violation(where, "its centre and typical cosine are of other distractors")


def _rows(root: Path, reader: ManifestReader, datasets: dict[str, Dataset]) -> Iterator[Violation]:
    header = reader.header
    if header["rule_version"] != RULE_VERSION:
        yield Violation(
            f"{MANIFESTS}/manifest.json",
            f"rule version {header['rule_version']}; this package can check {RULE_VERSION}",
        )
        return
    try:
        plan = plan_manifests(
            datasets[DEMONSTRATIONS],
            datasets[DISTRACTORS],
            header["k"],
            header["seed"],
            header["position_limit"],
        )
        counts = {"queries": 0, "buffers": 0, "sessions": 0}
        for expected, found in _aligned(expected_rows(plan), reader.rows()):
            yield from _row(expected, found)
            if expected is not None:
                counts["queries"] += expected["k"] == plan.k[0]
                counts["buffers"] += 1
                counts["sessions"] += len(expected["sessions"])
        if header["counts"] != counts:
            what = f"counts are {header['counts']}; there are {counts}"
            yield Violation(f"{MANIFESTS}/{MANIFEST_JSON}", what)
        yield from _lines(root / MANIFESTS / MANIFEST_JSONL, reader)
    except InterferenceError as error:
        yield Violation(MANIFESTS, error.message)
    except (pa.ArrowException, OSError) as error:
        yield Violation(f"{MANIFESTS}/{MANIFEST_PARQUET}", f"cannot be read: {error}")


def _aligned(expected: Rows, found: Rows) -> Iterator[tuple[Row | None, Row | None]]:
    """Pair the rows of two streams in canonical order; None where one has no such row."""
    other = next(found, None)
    for row in expected:
        while other is not None and _key(other) < _key(row):
            yield None, other
            other = next(found, None)
        if other is not None and _key(other) == _key(row):
            yield row, other
            other = next(found, None)
        else:
            yield row, None
    while other is not None:
        yield None, other
        other = next(found, None)


def _key(row: Row) -> tuple[tuple[int | str, ...], int]:
    try:
        return EpisodeId.parse(row["episode_id"]).sort_key, int(row["k"])
    except (InvalidIdError, AttributeError, KeyError, TypeError, ValueError):
        return (-1,), -1  # before all others


def _row(expected: Row | None, found: Row | None) -> Iterator[Violation]:
    if expected is None or found is None:
        what = "should not be there" if expected is None else "is missing"
        row = expected or found or {}
        yield Violation(_name(row), f"the row {what} in {MANIFEST_PARQUET}, or not in its place")
        return
    for field, value in expected.items():
        if found[field] != value:
            given, wanted = _difference(found[field], value)
            yield Violation(_name(expected), f"{field} is {given}; the rules give {wanted}")


def _lines(path: Path, reader: ManifestReader) -> Iterator[Violation]:
    """Check that the JSON lines are the rows of the parquet file."""
    broken: list[int] = []
    if not path.is_file():
        return
    with path.open(encoding="utf-8", errors="replace") as lines:
        for row, line in _aligned(reader.rows(), _parsed(lines, broken)):
            if row != line:
                name = _name(row or line or {})
                what = f"{name} is not the same row as in {MANIFEST_PARQUET}"
                yield Violation(f"{MANIFESTS}/{MANIFEST_JSONL}", what)
    for number in broken:
        yield Violation(f"{MANIFESTS}/{MANIFEST_JSONL}", f"line {number} is not a JSON object")


def _parsed(lines: Iterable[str], broken: list[int]) -> Rows:
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
        except ValueError:
            row = None
        if isinstance(row, dict):
            yield row
        else:
            broken.append(number)


def _difference(found: Any, expected: Any) -> tuple[str, str]:
    """Shorten two different values to where they differ."""
    if isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        place = next(i for i, value in enumerate(found) if value != expected[i])
        given, wanted = _difference(found[place], expected[place])
        return f"{given} at {place}", wanted
    if isinstance(found, dict) and isinstance(expected, dict):
        keys = [key for key in expected if found.get(key) != expected[key]]
        return (
            str({key: found.get(key) for key in keys}),
            str({key: expected[key] for key in keys}),
        )
    return repr(found), repr(expected)


def _name(row: dict[str, Any]) -> str:
    return f"{row.get('episode_id')} at k={row.get('k')}"
