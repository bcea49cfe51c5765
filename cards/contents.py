"""What the repositories of a split hold: its demonstrations, and its units with the manifests."""

import hashlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import PurePosixPath

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    IDENTITY_PATH,
    INDEX_DIR,
    MANIFEST_PATH,
    OPTIONAL_DATASETS,
    QUESTIONS_PATH,
    SUMS_PATH,
)
from robomme_interference_data.data.buffer_set import Split
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.errors import HashMismatchError, MissingFileError
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.manifest import BufferManifest, ManifestHeader
from robomme_interference_data.storage.files import canonical_json, indented_json

from .metadata import BUFFERS_FILE
from .tree import Content, Tree


def dataset_tree(dataset: Dataset) -> Tree:
    """Return the files of a dataset: those that its list names, the list, and embeddings.

    Raises:
        FormatError: The list is not the recorded one.
        MissingFileError: A file is missing.
        HubError: The dataset is on the Hub, and cannot be fetched.
    """
    sums = dataset.sums()
    index = [path for path in dataset.files.list(INDEX_DIR) if not _hidden(path)]
    paths = [*sums, SUMS_PATH, IDENTITY_PATH, *index]
    dataset.files.fetch(paths)
    known = {**sums, SUMS_PATH: dataset.identity.sums}
    return {path: Content(dataset.files.path(path), known.get(path)) for path in paths}


def split_tree(split: Split, base: str | None) -> Tree:
    """Return the files of a split's own repository: its units at the root, and its manifests.

    Further datasets are folders there.

    Args:
        split: The split.
        base: Where the demonstrations lie, `namespace/name@commit`; None for a folder beside.

    Raises:
        HashMismatchError: The rows are not those that the header names.
        FormatError, MissingFileError, HubError: See `dataset_tree`.
    """
    rows = Content(split.files.path(BUFFERS_FILE))
    if rows.sha256 != split.header.rows:
        raise HashMismatchError(
            f"{BUFFERS_FILE} of {split.location} does not have the SHA-256 of {MANIFEST_PATH}",
            split.mend,
        )
    header = indented_json(to_dict(placed(split.header, base))).encode()
    further = {
        f"{name}/{path}": content
        for name in OPTIONAL_DATASETS
        if name in split.datasets
        for path, content in dataset_tree(split.datasets[name]).items()
    }
    return {
        **dataset_tree(split.datasets[DISTRACTORS]),
        **further,
        **questions_of(split),
        MANIFEST_PATH: Content(header),
        BUFFERS_FILE: rows,
    }


def questions_of(split: Split) -> Tree:
    """Return the file of a split's questions, if it has some."""
    try:
        return {QUESTIONS_PATH: Content(split.files.path(QUESTIONS_PATH))}
    except MissingFileError:
        return {}


def placed(header: ManifestHeader, base: str | None) -> ManifestHeader:
    """Return a header that says where the datasets of a published split lie."""
    places = {DEMONSTRATIONS: base, DISTRACTORS: "."}
    datasets = {
        name: replace(one, place=places.get(name, one.place))
        for name, one in header.datasets.items()
    }
    return replace(header, datasets=datasets)


def parts_of_dataset(dataset: Dataset) -> dict[str, str]:
    """Return what each episode of a dataset holds, wherever it stands in it."""
    parts = {}
    for record in dataset.records():
        told = to_dict(record)
        del told["episode_index"]
        parts[f"{dataset.kind} {record.episode_id}"] = canonical_json(told)
    return parts


def parts_of_buffers(manifests: Iterable[BufferManifest]) -> dict[str, str]:
    """Return what each buffer holds, wherever the datasets keep its sessions."""
    parts = {}
    for manifest in manifests:
        told = to_dict(manifest)
        sessions = told.pop("sessions")
        del told["query"]
        held = [[one[name] for name in ("role", "source", "repeat", "sha256")] for one in sessions]
        parts[str(manifest)] = canonical_json([told, held])
    return parts


def parts_of_questions(split: Split) -> dict[str, str]:
    """Return what each question asks, and what its picture is."""
    parts = {}
    for one in read_questions(split).values() if questions_of(split) else ():
        told = to_dict(one)
        told["picture"] = hashlib.sha256(one.picture).hexdigest()
        parts[f"question {one.episode_id}"] = canonical_json(told)
    return parts


def _hidden(path: str) -> bool:
    """Tell whether a file is one that is being made."""
    return any(part.startswith(".") for part in PurePosixPath(path).parts)
