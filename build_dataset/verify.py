"""Recompute every hash and every rule of a split, and name each violation."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import Any

from robomme_interference_data.build_dataset.identity import counts_of, listed_files, revision_of
from robomme_interference_data.build_dataset.lerobot_meaning import lerobot_violations
from robomme_interference_data.build_dataset.manifests import plan_manifests, planned_buffers
from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    IDENTITY_PATH,
    INDEX_DIR,
    INDEX_HEADER,
    MANIFEST_HEADER,
    MANIFEST_ROWS,
    MANIFESTS,
    RULE_VERSION,
    UNIT_FRAMES,
    UNIT_STRIDE,
)
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.embeddings import IndexHeader, index_folder
from robomme_interference_data.encode import CODECS
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.files import LocalFiles, sha256_file
from robomme_interference_data.records import EpisodeRecord, ManifestHeader
from robomme_interference_data.rows import read_header, to_dict
from robomme_interference_data.split import load_split

__all__ = ["Violation", "frames_of", "verify_split"]


@dataclass(frozen=True)
class Violation:
    """Something in a split that is not as recorded or as the rules say.

    Attributes:
        where: File, episode or buffer.
        what: What was found, and what was expected.
    """

    where: str
    what: str


def frames_of(root: Path) -> int:
    """Return how many frames a split stores; 0 if it cannot be told.

    Raises:
        MissingFileError, FormatError: The folder is not a split, or its header cannot be read.
    """
    names = load_split(root).header.datasets
    try:
        opened = [Dataset(LocalFiles(root / name)) for name in names]
    except InterferenceError:
        return 0
    return sum(dataset.identity.counts.frames for dataset in opened)


def verify_split(
    root: Path, *, decode: bool = True, advance: Callable[[int], None] = lambda frames: None
) -> Iterator[Violation]:
    """Check a split, yielding violations as they are found.

    Checked are: the SHA-256 of every file, and that none is missing or too many; with `decode`,
    every frame and vector of every episode against its recorded hashes; what LeRobot's columns
    and statistics mean; embeddings that lie beside the data, if any, against their hashes (they
    are not made anew); and every manifest row, which is made anew from the datasets, rules and
    seed and compared field by field.

    Args:
        root: Folder of the split.
        decode: Whether to decode all data: by far the longest part.
        advance: Called with a number of frames whenever so many have been checked.

    Raises:
        MissingFileError, FormatError: The folder is not a split, or its header cannot be read.
    """
    header = load_split(root).header
    rows = root / MANIFESTS / MANIFEST_ROWS
    if not rows.is_file():
        yield Violation(f"{MANIFESTS}/{MANIFEST_ROWS}", "is missing")
    elif sha256_file(rows) != header.rows:
        what = f"does not have the SHA-256 of {MANIFEST_HEADER}"
        yield Violation(f"{MANIFESTS}/{MANIFEST_ROWS}", what)
    found: list[Violation] = []
    datasets: dict[str, Dataset] = {}
    for name in header.datasets:
        with _told(name, found):
            datasets[name] = Dataset(LocalFiles(root / name))
    yield from found
    for name, dataset in datasets.items():
        yield from _dataset(name, dataset, header, decode=decode, advance=advance)
        pool = datasets.get(DISTRACTORS)
        broken: list[Violation] = []
        with _told(name, broken):
            broken += [] if pool is None else _indexes(name, dataset, pool.revision)
        yield from broken
    if not found:
        yield from _buffers(root, header)


@contextmanager
def _told(where: str, found: list[Violation]) -> Iterator[None]:
    """Turn an error of what is read inside into a violation."""
    try:
        yield
    except InterferenceError as error:
        found.append(Violation(where, error.message))


def _dataset(
    name: str,
    dataset: Dataset,
    header: ManifestHeader,
    *,
    decode: bool,
    advance: Callable[[int], None],
) -> Iterator[Violation]:
    found: list[Violation] = []
    with _told(name, found):
        found += _files(name, dataset, header)
        records = list(dataset.records())
        found += _identity(name, dataset, records, header)
        found += (Violation(f"{name}/{where}", what) for where, what in lerobot_violations(dataset))
        yield from found
        found.clear()
        for record in records:
            yield from _record(name, record)
            if decode:
                yield from _episode(name, dataset, record)
                advance(record.length)
    yield from found


def _files(name: str, dataset: Dataset, header: ManifestHeader) -> Iterator[Violation]:
    """Check every byte of a dataset: identity, list of sums, and all files in it."""
    files = dataset.files
    if sha256_file(files.path(IDENTITY_PATH)) != header.datasets[name].identity:
        what = f"does not have the SHA-256 of {MANIFESTS}/{MANIFEST_HEADER}"
        yield Violation(f"{name}/{IDENTITY_PATH}", what)
    sums, there = dataset.sums(), set(listed_files(files))
    for path in sorted(sums.keys() | there):
        if path not in there:
            yield Violation(f"{name}/{path}", "is missing")
        elif path not in sums:
            yield Violation(f"{name}/{path}", "is too many: it is in no list")
        elif sha256_file(files.path(path)) != sums[path]:
            yield Violation(f"{name}/{path}", "does not have the recorded SHA-256")


def _identity(
    name: str, dataset: Dataset, records: list[EpisodeRecord], header: ManifestHeader
) -> Iterator[Violation]:
    identity, where = dataset.identity, f"{name}/{IDENTITY_PATH}"
    unit = {"frames": UNIT_FRAMES, "stride": UNIT_STRIDE} if name == DISTRACTORS else None
    expected: dict[str, Any] = {
        "kind": name,
        "revision": revision_of(records),
        "exact": all(record.exact for record in records),
        "cameras": dataset.cameras,
        "unit": unit,
        "simulators": tuple(sorted({r.simulator for r in records if r.simulator})),
        "counts": counts_of(records),
    }
    for field, value in expected.items():
        given = getattr(identity, field)
        if given != value:
            yield Violation(where, f"{field} is {given}; its episodes say {value}")
    if identity.codec not in CODECS:
        yield Violation(where, f"codec {identity.codec!r} is unknown")
    recorded = header.datasets[name]
    for field in ("kind", "version", "revision"):
        if getattr(recorded, field) != getattr(identity, field):
            what = f"{field} of the {name} is {getattr(recorded, field)}; the dataset says "
            yield Violation(f"{MANIFESTS}/{MANIFEST_HEADER}", f"{what}{getattr(identity, field)}")


def _record(name: str, record: EpisodeRecord) -> Iterator[Violation]:
    start = record.exec_start_idx
    where = f"{name} {record.episode_id}"
    if (start is None) != (name == DISTRACTORS) or (start is None) != (
        record.lesson_sha256 is None
    ):
        yield Violation(where, f"exec_start_idx is {start}")
    elif record.length != (expected := UNIT_FRAMES if start is None else start + 1):
        yield Violation(where, f"holds {record.length} frames, not {expected}")


def _episode(name: str, dataset: Dataset, record: EpisodeRecord) -> Iterator[Violation]:
    where = f"{name} {record.episode_id}"
    spans = {"frames": (record.length, record.feature_sha256)}
    if record.exec_start_idx is not None and record.lesson_sha256 is not None:
        spans["lesson"] = (record.exec_start_idx, record.lesson_sha256)
    found: list[Violation] = []
    with _told(where, found):
        stops = [stop for stop, _ in spans.values()]
        decoded = dataset.digests(record.episode_index, 0, stops)
        for (what, (_, recorded)), digests in zip(spans.items(), decoded, strict=True):
            for feature in sorted(digests.keys() | recorded.keys()):
                if digests.get(feature) != recorded.get(feature):
                    told = f"{feature} ({what}) does not have the recorded SHA-256"
                    found.append(Violation(where, told))
    yield from found


def _indexes(name: str, dataset: Dataset, pool: str) -> Iterator[Violation]:
    """Check the embeddings beside a dataset, whatever encoders and cameras they are of."""
    lengths = {record.episode_index: record.length for record in dataset.records()}
    for path in dataset.files.list(INDEX_DIR, f"/{INDEX_HEADER}"):
        folder = str(PurePath(path).parent)
        found: list[Violation] = []
        with _told(f"{name}/{folder}", found):
            header = read_header(dataset.files.path(path), IndexHeader)
            made = header.encoder.name, header.camera
            if index_folder(*made) != folder:
                what = f"holds the embeddings of {made[0]}, camera {made[1]}"
                found.append(Violation(f"{name}/{folder}", what))
            else:
                dataset.index(*made).check(lengths)
            if header.pool != pool:
                what = "its centre and typical cosine are of other distractors"
                found.append(Violation(f"{name}/{folder}", what))
        yield from found


def _buffers(root: Path, header: ManifestHeader) -> Iterator[Violation]:
    """Plan all buffers anew, and compare them with the rows."""
    where = f"{MANIFESTS}/{MANIFEST_HEADER}"
    if header.rule_version != RULE_VERSION:
        what = f"rule version {header.rule_version}; this package can check {RULE_VERSION}"
        yield Violation(where, what)
        return
    found: list[Violation] = []
    with _told(MANIFESTS, found):
        plan = plan_manifests(root, header.conditions, header.seed, header.position_limit)
        given = {str(manifest): to_dict(manifest) for manifest in load_split(root).manifests()}
        order = list(given)
        counts = {"queries": len(plan.demonstrations), "buffers": 0, "sessions": 0}
        for number, manifest in enumerate(planned_buffers(plan)):
            counts["buffers"] += 1
            counts["sessions"] += len(manifest.sessions)
            row = given.pop(str(manifest), None)
            if row is None:
                found.append(Violation(str(manifest), f"is missing in {MANIFEST_ROWS}"))
                continue
            if number >= len(order) or order[number] != str(manifest):
                found.append(Violation(str(manifest), f"is not in its place in {MANIFEST_ROWS}"))
            for field, value in to_dict(manifest).items():
                if row[field] != value:
                    told, rules = _difference(row[field], value)
                    what = f"{field} is {told}; the rules give {rules}"
                    found.append(Violation(str(manifest), what))
        found += (Violation(name, f"should not be in {MANIFEST_ROWS}") for name in given)
        if header.counts != counts:
            found.append(Violation(where, f"counts are {header.counts}; there are {counts}"))
        if set(header.datasets) != {DEMONSTRATIONS, DISTRACTORS}:
            found.append(Violation(where, f"datasets are {sorted(header.datasets)}"))
    yield from found


def _difference(found: Any, expected: Any) -> tuple[str, str]:
    """Shorten two different values to where they differ."""
    if isinstance(found, list) and isinstance(expected, list) and len(found) == len(expected):
        place = next(i for i, value in enumerate(found) if value != expected[i])
        given, wanted = _difference(found[place], expected[place])
        return f"{given} at {place}", wanted
    if isinstance(found, dict) and isinstance(expected, dict):
        keys = [key for key in expected if found.get(key) != expected[key]]
        both = ({key: one.get(key) for key in keys} for one in (found, expected))
        return str(next(both)), str(next(both))
    return repr(found), repr(expected)
