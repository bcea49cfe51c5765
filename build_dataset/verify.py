"""Recompute every hash and every rule of a split, and name each violation."""

import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import pyarrow.compute as pc

from robomme_interference_data.build_dataset.finish import revision_of
from robomme_interference_data.build_dataset.manifests import expected_rows, plan_manifests
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    MANIFEST_JSONL,
    MANIFEST_PARQUET,
    MANIFESTS,
    RULE_VERSION,
    UNIT_FRAMES,
)
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.digest import combine
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.files import LocalFiles, sha256_file
from robomme_interference_data.manifest_io import ManifestReader
from robomme_interference_data.schema import EpisodeRecord

__all__ = ["Violation", "verify_split"]

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
    every frame and vector of every episode against its recorded hashes; and every manifest row,
    which is made anew from the datasets, rules and seed and compared field by field.

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
        for index in range(len(dataset)):
            record = dataset.record(index)
            if record.exec_start_idx is None and record.length != UNIT_FRAMES:
                yield Violation(f"{name} {record.id}", f"a unit of {record.length} frames")
            if decode:
                yield from _episode(name, dataset, record)
                advance(record.length)
    yield from _rows(root, reader, datasets)


def _identity(name: str, dataset: Dataset, reader: ManifestReader) -> Iterator[Violation]:
    own = [
        column
        for column in dataset.episodes.column_names
        if column not in _LEROBOT_COLUMNS and not column.startswith(_LEROBOT_PREFIXES)
    ]
    if revision_of(dataset.episodes.select(own).to_pylist()) != dataset.revision:
        yield Violation(name, "the episode table is not the one that the revision was made from")
    counts = {
        "episodes": len(dataset),
        "frames": pc.sum(dataset.episodes["length"]).as_py(),
        "families": dict(Counter(dataset.episodes["family"].to_pylist())),
    }
    if dataset.identity["counts"] != counts:
        yield Violation(name, f"counts are {dataset.identity['counts']}; there are {counts}")
    exact = pc.all(dataset.episodes["exact"]).as_py()
    if dataset.identity["exact"] != exact:
        yield Violation(name, f"exact is {dataset.identity['exact']}; its episodes say {exact}")
    if reader.header["datasets"][name]["revision"] != dataset.revision:
        yield Violation(name, "is not the revision that the manifests were made for")


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
        with (root / MANIFESTS / MANIFEST_JSONL).open(encoding="utf-8") as lines:
            pairs = zip_longest(reader.rows(), expected_rows(plan), lines)
            for number, (found, expected, line) in enumerate(pairs):
                yield from _row(number, found, expected, line)
    except InterferenceError as error:
        yield Violation(MANIFESTS, error.message)
    except OSError as error:
        yield Violation(f"{MANIFESTS}/{MANIFEST_JSONL}", f"cannot be read: {error}")


def _row(
    number: int,
    found: dict[str, Any] | None,
    expected: dict[str, Any] | None,
    line: str | None,
) -> Iterator[Violation]:
    if found is None or expected is None:
        what = "is missing" if found is None else "should not be there"
        row = found or expected or {}
        yield Violation(_name(row), f"the row {what} in {MANIFEST_PARQUET}")
        return
    for field, value in expected.items():
        if found[field] != value:
            given, wanted = _difference(found[field], value)
            yield Violation(_name(expected), f"{field} is {given}; the rules give {wanted}")
    try:
        same = line is not None and json.loads(line) == found
    except ValueError:
        same = False
    if not same:
        yield Violation(
            f"{MANIFESTS}/{MANIFEST_JSONL}",
            f"line {number + 1} is not the row of {MANIFEST_PARQUET}",
        )


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
