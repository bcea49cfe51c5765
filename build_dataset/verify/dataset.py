"""Recompute every hash and every rule of one of a buffer set's datasets."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.build_dataset.dataset.identity import (
    BuildReport,
    identity_of,
    listed_files,
    report_of,
)
from robomme_interference_data.constants import (
    DAYS,
    DISTRACTORS,
    EXECUTIONS,
    FETCH_RECORD,
    IDENTITY_PATH,
    INDEX_DIR,
    INDEX_HEADER,
    LESSONS,
    MANIFEST_HEADER,
    MANIFESTS,
    PAPER_UNIT,
    REPORT_PATH,
    SHIFTED,
    UNITS,
    Unit,
)
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.embeddings import normalized, open_index
from robomme_interference_data.data.fetched_copy import FetchedCopy
from robomme_interference_data.data.index_layout import IndexHeader, index_folder
from robomme_interference_data.errors import InterferenceError, visible
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.retrieval.segment import typical_cosine
from robomme_interference_data.schema.manifest import ManifestHeader
from robomme_interference_data.schema.records import Day, EpisodeRecord
from robomme_interference_data.schema.shifts import SHIFTS
from robomme_interference_data.storage.arrays import combine
from robomme_interference_data.storage.files import all_files, is_hidden, sha256_file
from robomme_interference_data.storage.text import digest_json, read_header, read_json
from robomme_interference_data.storage.video.encode import CODECS
from robomme_interference_data.storage.video.file import open_video

from .lerobot_files import lerobot_violations

UNLISTED = "is not listed"
HEADER = f"{MANIFESTS}/{MANIFEST_HEADER}"


@dataclass(frozen=True)
class Violation:
    """Something in a buffer set that differs from its records or from the rules.

    Attributes:
        where: File, episode or buffer.
        what: The value found, and the expected one.
    """

    where: str
    what: str


def caught(where: str, violations: Iterable[Violation]) -> Iterator[Violation]:
    """Yield violations; an error on the way is the last one."""
    try:
        yield from violations
    except InterferenceError as error:
        yield Violation(where, error.message)


def dataset_violations(
    name: str,
    dataset: Dataset,
    header: ManifestHeader | None,
    units: Dataset | None,
    progress: WorkProgress | None,
    copy: FetchedCopy | None,
) -> Iterator[Violation]:
    """Check a dataset.

    Args:
        name: Its name in the buffer set.
        dataset: The dataset.
        header: Header of the manifests; None if there are none yet.
        units: The distractors, if they can be opened.
        progress: Shows how many frames are decoded; None to decode none.
        copy: What is there, if the dataset is in a copy of a published buffer set.
    """
    unit = units.unit if units is not None and name in UNITS else PAPER_UNIT
    if header is not None:
        yield from _recorded(name, dataset, header)
    yield from _files(name, dataset, copy)
    records = list(dataset.records())
    yield from _identity(name, dataset, records, unit)
    yield from _report(name, dataset, records)
    yield from (
        Violation(f"{name}/{where}", what) for where, what in lerobot_violations(dataset, copy)
    )
    for record in records:
        yield from _record(f"{name} {record.episode_id}", name, record, unit)
    yield from start_violations(name, records, unit)
    if progress is None:
        return
    for record in records:
        where = f"{name} {record.episode_id}"
        if copy is not None and not copy.holds_all(dataset, record.episode_index):
            continue  # hashes of what it holds of the episode need all of its cameras
        yield from caught(where, _episode(where, dataset, record))
        progress.advance(record.length)


def _recorded(name: str, dataset: Dataset, header: ManifestHeader) -> Iterator[Violation]:
    """Check that the manifests were made for this dataset."""
    recorded, stored = header.datasets[name], dataset.identity
    if recorded.revision != stored.revision:  # a violation of the whole buffer set
        return
    if sha256_file(dataset.files.path(IDENTITY_PATH)) != recorded.identity:
        yield Violation(f"{name}/{IDENTITY_PATH}", f"does not have the SHA-256 of {HEADER}")
    for field in ("kind", "version"):
        if getattr(recorded, field) != getattr(stored, field):
            what = f"{field} of the {name} is {getattr(recorded, field)}; the dataset has "
            yield Violation(HEADER, f"{what}{getattr(stored, field)}")


def _files(name: str, dataset: Dataset, copy: FetchedCopy | None) -> Iterator[Violation]:
    """Check every byte of a dataset: list of sums, and all files in it."""
    files, root = dataset.files, dataset.files.snapshot()
    sums, existing = dataset.sums(), {*listed_files(root)}
    for path in sorted(sums.keys() | existing):
        if path not in existing and copy is not None and not copy.lists(root, path):
            continue  # not fetched
        if path in existing and copy is not None and not copy.lists(root, path):
            # Loading goes by the record: it refuses the buffers of such a file.
            yield Violation(f"{name}/{path}", f"{UNLISTED} in {FETCH_RECORD}")
        if path not in sums:
            yield Violation(f"{name}/{path}", UNLISTED)
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
    name: str, dataset: Dataset, records: list[EpisodeRecord], unit: Unit
) -> Iterator[Violation]:
    stored, where = dataset.identity, f"{name}/{IDENTITY_PATH}"
    kept = stored.version, stored.codec, stored.sources, stored.sums
    made = identity_of(records, dataset.lerobot.info, name, *kept, unit)
    for field, value in (vars(made) | {"cameras": dataset.cameras}).items():
        if getattr(stored, field) != value:
            what = f"{field} is {getattr(stored, field)}; the episodes give {value}"
            yield Violation(where, what)
    if stored.codec not in CODECS:
        yield Violation(where, f"codec {stored.codec!r} is unknown")


def _report(name: str, dataset: Dataset, records: list[EpisodeRecord]) -> Iterator[Violation]:
    where = f"{name}/{REPORT_PATH}"
    report = read_header(dataset.files.path(REPORT_PATH), BuildReport)
    if read_json(dataset.files.path(REPORT_PATH)) != report_of(dataset.identity, report.reasons):
        yield Violation(where, "does not have the counts of the dataset, or is not in order")
    if stored := report.reasons.keys() & {str(record.episode_id) for record in records}:
        yield Violation(where, f"{min(stored)} is skipped, and in the dataset")
    if any(visible(reason) != reason for reason in report.reasons.values()):
        yield Violation(where, "has control characters")


def _record(where: str, name: str, record: EpisodeRecord, unit: Unit) -> Iterator[Violation]:
    start = record.exec_start_idx
    lessons = {name in LESSONS, start is not None, record.span_sha256 is not None}
    if len(lessons) > 1:
        yield Violation(where, f"exec_start_idx is {start}")
        return
    if start is not None:
        expected = range(start + 1, start + 2)
    elif name == SHIFTED:
        expected = range(len(SHIFTS), len(SHIFTS) + 1)
    elif name in (EXECUTIONS, DAYS):
        expected = range(1, record.length + 1)
    else:
        stored = unit.in_dataset(name)
        expected = range((unit.raw_frames - 1) // stored.stride + 1, stored.frames + 1)
    if record.length not in expected:
        yield Violation(where, f"holds {record.length} frames, not {expected[-1]}")
    if (record.day is not None) != (name == DAYS):
        yield Violation(where, "has no tasks" if record.day is None else "has tasks")
    if record.day is not None:
        yield from _day(where, record.day, record.length)


def _day(where: str, day: Day, length: int) -> Iterator[Violation]:
    """Check that the spans of a day are all its frames, and that its queries are asked in it."""
    borders = [0, *(border for span in day.spans for border in (span.start, span.stop)), length]
    if any(before != after for before, after in zip(borders[::2], borders[1::2], strict=True)):
        yield Violation(where, f"its spans are not its {length} frames, one after the other")
    for span in day.spans:
        if not all(span.start <= shown.start < shown.stop <= span.stop for shown in span.evidence):
            yield Violation(where, f"evidence of {span.source} is outside of its frames")
    tasks = [span for span in day.spans if span.part != "transition"]
    for query in day.queries:
        own = [number for number, span in enumerate(tasks) if span.source.scene == query.episode]
        if query.task not in range(max(own, default=0), len(tasks)):
            what = f"{query.episode} is asked after task {query.task} of {len(tasks)}"
            yield Violation(where, f"{what}; its lessons are {own}")


def start_violations(
    name: str, records: Iterable[EpisodeRecord], unit: Unit
) -> Iterator[Violation]:
    """Check that the units of a recorded episode are no more than allowed, and do not overlap."""
    starts: dict[EpisodeId, list[int]] = {}
    for record in records:
        starts.setdefault(replace(record.episode_id, start=0), []).append(record.episode_id.start)
    most, apart = (unit.per_episode, unit.frames * unit.stride) if name in UNITS else (1, 1)
    for episode, found in starts.items():
        near = any(after - before < apart for before, after in pairwise(sorted(found)))
        if min(found) != 0 or len(found) > most or near:
            yield Violation(
                f"{name} {episode}",
                f"episodes begin at the raw frames {', '.join(map(str, sorted(found)))}; expected "
                f"0, then at most {most - 1} more, each {apart} or more later",
            )


def _episode(where: str, dataset: Dataset, record: EpisodeRecord) -> Iterator[Violation]:
    recorded, spans = record.feature_sha256, record.spans
    tasks = () if record.day is None else record.day.spans
    formats = _pixel_formats(dataset, record)
    exact = formats <= {codec.pix_fmt for codec in CODECS.values() if codec.exact}
    stated = CODECS.get(dataset.identity.codec)
    if stated is not None and not formats <= {stated.pix_fmt}:
        yield Violation(where, f"has videos in {', '.join(sorted(formats))}, not {stated.name}")
    if record.exact and not exact:
        yield Violation(where, "is exact, but its videos are lossy")
    held = [record.session, *spans.values(), *((span.start, span.stop) for span in tasks)]
    session, *parts = dataset.digests(record.episode_index, held)
    for feature in sorted(session.keys() | recorded.keys()):
        if session.get(feature) != recorded.get(feature):
            yield Violation(where, f"{feature} does not have the recorded SHA-256")
    for span, part in zip(tasks, parts[len(spans) :], strict=True):
        if combine(part) != span.sha256:
            what = f"frames {span.start} to {span.stop - 1} do not have the recorded SHA-256"
            yield Violation(where, what)
    for (name, (start, stop)), part in zip(spans.items(), parts, strict=False):
        if combine(part) != getattr(record.span_sha256, name, None):
            what = f"frames {start} to {stop - 1} ({name}) do not have the recorded SHA-256"
            yield Violation(where, what)


def _pixel_formats(dataset: Dataset, record: EpisodeRecord) -> set[str]:
    """Return the pixel formats of an episode's videos."""
    formats = set()
    for feature in dataset.lerobot.video_features:
        location = dataset.lerobot.locate_video(record.episode_index, feature)
        with open_video(dataset.files.path(location.path)) as (_, stream):
            formats.add(str(stream.codec_context.pix_fmt))
    return formats


def index_violations(
    name: str, dataset: Dataset, units: Dataset | None, copy: FetchedCopy | None
) -> Iterator[Violation]:
    """Check the embeddings beside a dataset, of any encoders and cameras."""
    root = dataset.files.snapshot() / INDEX_DIR
    folders: set[str] = set()
    for path in all_files(root):
        folder, _, file = path.partition("/")
        if is_hidden(path):  # such as an index that is being made
            continue
        if not file:
            yield Violation(f"{name}/{INDEX_DIR}/{path}", UNLISTED)
        else:
            folders.add(f"{INDEX_DIR}/{folder}")
            if not (root / path).is_file():
                yield Violation(f"{name}/{INDEX_DIR}/{path}", "is a broken link, or no file")
    for folder in sorted(folders):
        yield from caught(f"{name}/{folder}", _index(name, dataset, folder, units, copy))


def _index(
    name: str, dataset: Dataset, folder: str, units: Dataset | None, copy: FetchedCopy | None
) -> Iterator[Violation]:
    where = f"{name}/{folder}"
    header = read_header(dataset.files.path(f"{folder}/{INDEX_HEADER}"), IndexHeader)
    encoder, camera = header.encoder.name, header.camera
    if index_folder(encoder, camera) != folder:
        yield Violation(where, f"holds the embeddings of {encoder}, camera {camera}")
        return
    lengths = {record.episode_index: record.length for record in dataset.records()}
    held = [index for index in lengths if copy is None or copy.holds(dataset, index)]
    index = open_index(dataset, encoder, camera)
    index.check(lengths, units=name == DISTRACTORS, held=held)
    if header.encoder.sha256 != digest_json([header.encoder.fingerprint]):
        yield Violation(where, "the encoder's fingerprint does not have its SHA-256")
    if header.typical_cosine is not None and len(held) == len(lengths):

        def embeddings(episode: int) -> NDArray[np.float32]:
            return normalized(index.span(episode, 0, lengths[episode]), index.center)

        typical = typical_cosine(len(lengths), embeddings)
        # It has four digits, and the last one may differ between machines.
        if not np.isclose(header.typical_cosine, typical, 0, 2e-4):
            what = f"the typical cosine is {header.typical_cosine}; the embeddings give {typical}"
            yield Violation(where, what)
    with suppress(InterferenceError):  # reported where the units are checked
        made = open_index(dataset, encoder, camera).key
        if units is not None and open_index(units, encoder, camera).key != made:
            yield Violation(where, f"was made with another encoder than that of the {DISTRACTORS}")
