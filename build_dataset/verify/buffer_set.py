"""Recompute every hash and every rule of a buffer set, and list each violation."""

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path

from robomme_interference_data.constants import (
    DAYS,
    DEMONSTRATIONS,
    DISTRACTORS,
    EXECUTIONS,
    FETCH_RECORD,
    MANIFEST_HEADER,
    MANIFEST_ROWS,
    MANIFESTS,
    QUESTIONS_PATH,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.fetched_copy import FetchedCopy
from robomme_interference_data.data.loading import built_datasets
from robomme_interference_data.data.questions import Question
from robomme_interference_data.data.set_files import pending_rows
from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.progress import WorkProgress
from robomme_interference_data.schema.codec import arrow_schema
from robomme_interference_data.schema.manifest import BufferManifest, ManifestHeader
from robomme_interference_data.storage.arrays import combine
from robomme_interference_data.storage.files import LocalFiles, all_files, is_hidden, sha256_file
from robomme_interference_data.storage.parquet import open_parquet
from robomme_interference_data.storage.staging import staging_path
from robomme_interference_data.storage.video.encode import CODECS

from .dataset import HEADER, UNLISTED, Violation, caught, dataset_violations, index_violations
from .planned_again import buffer_violations, question_violations
from .planned_days import day_violations
from .set_files import further_files, unfinished_builds

_ROWS = f"{MANIFESTS}/{MANIFEST_ROWS}"


def verify_buffer_set(
    buffer_set: BufferSet, *, decode: bool = True, progress: WorkProgress | None = None
) -> Iterator[Violation]:
    """Check a buffer set, yielding violations as they are found.

    Checked are: the SHA-256 of every file, and that none is missing or unlisted; with `decode`,
    every frame and vector of every episode against its recorded hashes; LeRobot's columns;
    the hashes of embeddings, which are not recomputed; days, abilities, every manifest row and
    every question, which are planned again from the datasets, rules and seed and compared; with
    `decode`, the first frame of every execution against the first live observation, and the
    questions' pictures, if Pillow is installed.

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
        location = header.datasets[name].location
        own = copy is None and folder == root / name
        if own and location is not None and not _is_downloaded(folder, location):
            # The folder is read; whoever publishes the manifests would send readers elsewhere.
            what = f"location of the {name} is {location}; the folder {name} is no download of it"
            yield Violation(HEADER, f"{what}: expected none")
        if not folder.is_relative_to(root):  # in a repository of its own
            for path in further_files(folder, ()):
                yield Violation(f"{name}/{path}", "is not part of the dataset")
    yield from _datasets(datasets, header, copy, progress if decode else None)
    changed = [
        name
        for name, dataset in datasets.items()
        if dataset.revision != header.datasets[name].revision
    ]
    for name in changed:
        yield Violation(name, f"changed after the buffers were planned: {_plan_again(buffer_set)}")
    # Of buffers that are planned from other episodes, every row would differ.
    if len(datasets) == len(buffer_set.datasets) and not changed:
        yield from caught(MANIFESTS, buffer_violations(buffer_set, datasets))
    if decode and {DEMONSTRATIONS, EXECUTIONS} <= datasets.keys():
        executions, demonstrations = datasets[EXECUTIONS], datasets[DEMONSTRATIONS]
        yield from caught(EXECUTIONS, _executions(executions, demonstrations, copy))
    listed = header.questions is not None and (copy is None or copy.lists(root, QUESTIONS_PATH))
    if listed and not changed:
        yield from caught(QUESTIONS_PATH, _table(root, QUESTIONS_PATH, Question))
        yield from caught(QUESTIONS_PATH, question_violations(buffer_set, decode=decode))
    elif not listed and (root / QUESTIONS_PATH).exists():
        yield Violation(QUESTIONS_PATH, f"is not listed in {HEADER}")


def _plan_again(buffer_set: BufferSet) -> str:
    """Return what to do about datasets that are not those of the manifests."""
    if buffer_set.copy is not None or not isinstance(buffer_set.files, LocalFiles):
        return "fetch it again"
    root = str(buffer_set.files.root)
    return f"run {shlex.join(['robomme-interference', 'build', root, '--only', MANIFESTS])}"


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
    yield from caught(DAYS, day_violations(datasets))


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


def _is_downloaded(folder: Path, location: str) -> bool:
    """Whether `hf download` filled a folder from a location, a commit of a repository.

    It notes the commit of each file:
    https://huggingface.co/docs/huggingface_hub/guides/download#download-files-to-a-local-folder
    """
    notes = folder.glob(".cache/huggingface/download/**/*.metadata")
    commits = {note.read_text(encoding="utf-8").partition("\n")[0] for note in notes}
    return commits == {location.rpartition("@")[2]}


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


def _executions(
    executions: Dataset, demonstrations: Dataset, copy: FetchedCopy | None
) -> Iterator[Violation]:
    """Check that executions begin with first live observations of demonstrations, bit for bit."""
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
            what = f"does not begin with the first live observation of the {DEMONSTRATIONS}"
            yield Violation(f"{EXECUTIONS} {record.episode_id}", what)
