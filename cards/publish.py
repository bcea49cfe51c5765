"""Publish a buffer set: its demonstrations, then its units with the manifests that name them."""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from hashlib import sha256
from pathlib import PurePosixPath

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    DISTRACTORS,
    IDENTITY_PATH,
    INDEX_DIR,
    MANIFEST_PATH,
    MANIFEST_ROWS,
    MANIFESTS,
    OPTIONAL_DATASETS,
    QUESTIONS_PATH,
    SUMS_PATH,
)
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.questions import read_questions
from robomme_interference_data.errors import MissingFileError, PublishError
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.manifest import BufferManifest, ManifestHeader
from robomme_interference_data.storage.files import LocalFiles, indented_json
from robomme_interference_data.storage.hub import HubFiles

from .facts import Facts, buffer_set_facts, demonstrations_facts
from .publication import Publication, PublishConfig, Version
from .publisher import Publisher, RepoContent, RepoPlan, digest
from .render import card_files
from .repo import LocalFile, RepoFiles

_UNKNOWN = "0" * 40
"""Stands for the commit of demonstrations that are not published yet."""


class BufferSetContent:
    """What the repositories of a buffer set hold.

    Args:
        buffer_set: The buffer set, whose checks have passed.
        config: As what it is published.
    """

    def __init__(self, buffer_set: BufferSet, config: PublishConfig):
        self.buffer_set = buffer_set
        self.config = config

    @cached_property
    def base(self) -> str | None:
        """The published demonstrations that the buffer set is for, `namespace/name@commit`, or None."""
        recorded = self.buffer_set.header.datasets[DEMONSTRATIONS]
        repo_id, _, commit = (recorded.location or "").partition("@")
        if not commit or self.config.demonstrations_id not in (None, repo_id):
            return None
        if Dataset(HubFiles(repo_id, commit)).revision != recorded.revision:
            raise PublishError(
                f"{recorded.location} holds other demonstrations than those that "
                f"{self.buffer_set.location} is for",
                self.buffer_set.fix,
            )
        return recorded.location

    @cached_property
    def demonstrations(self) -> RepoContent:
        """What the repository of the demonstrations holds."""
        dataset = self.buffer_set.datasets[DEMONSTRATIONS]
        facts, files = demonstrations_facts(dataset), dataset_files(dataset)
        parts = parts_of_dataset(dataset)
        return self._content(self.config.demonstrations, dataset, facts, files, parts)

    @cached_property
    def _facts(self) -> Facts:
        return buffer_set_facts(self.buffer_set)

    def units(self, base: str | None) -> RepoContent:
        """Return what the buffer set's own repository holds: units at its root, and the manifests.

        Args:
            base: Where the demonstrations are, `namespace/name@commit`; None for a folder beside.
        """
        buffer_set, datasets = self.buffer_set, self.buffer_set.header.datasets
        names = [DISTRACTORS, *(name for name in OPTIONAL_DATASETS if name in datasets)]
        files: RepoFiles = {}
        parts = parts_of_buffers(buffer_set.manifests()) | parts_of_questions(buffer_set)
        for name in names:
            folder = "" if name == DISTRACTORS else f"{name}/"
            dataset = buffer_set.datasets[name]
            files |= {folder + path: file for path, file in dataset_files(dataset).items()}
            parts |= parts_of_dataset(dataset)
        header = indented_json(to_dict(with_locations(buffer_set.header, base))).encode()
        files[MANIFEST_PATH] = LocalFile(header)
        for path in (f"{MANIFESTS}/{MANIFEST_ROWS}", *[QUESTIONS_PATH] * has_questions(buffer_set)):
            files[path] = LocalFile(buffer_set.files.path(path))
        units, repo_id = buffer_set.datasets[DISTRACTORS], self.config.repo_id
        return self._content(repo_id, units, self._facts, files, parts, base)

    def folder(self) -> RepoFiles:
        """Return the files of the buffer set's repository, with the other one in `demonstrations/`.

        Demonstrations that are only on the Hub stay there.
        """
        base = self.buffer_set.header.datasets[DEMONSTRATIONS].location
        own = self.units(base if base and "@" in base else None)
        files = own.files(self.config.wanted or own.first)
        if isinstance(self.buffer_set.dataset_files(DEMONSTRATIONS), LocalFiles):
            other = self.demonstrations
            lessons = other.files(self.config.wanted or other.first)
            files |= {f"{DEMONSTRATIONS}/{path}": file for path, file in lessons.items()}
        return files

    def _content(
        self,
        repo_id: str,
        dataset: Dataset,
        facts: Facts,
        files: RepoFiles,
        parts: dict[str, str],
        base: str | None = None,
    ) -> RepoContent:
        # No paths of this machine: the same data gives the same card.
        command = f"robomme-interference publish BUFFER_SET --repo-id {self.config.repo_id}"

        def card(version: Version) -> dict[str, bytes]:
            license = self.config.license
            return card_files(facts, Publication(repo_id, str(version), license, base, command))

        first = Version.parse(dataset.identity.version) or Version(1, 0, 0)
        lerobot = str(dataset.lerobot.version)
        return RepoContent(repo_id, first, files, parts, card, IDENTITY_PATH, lerobot)


def plan_buffer_set(content: BufferSetContent, publisher: Publisher) -> list[RepoPlan]:
    """Return what is to be done: the demonstrations, unless they are published, then the buffer set."""
    if content.base is not None:
        return [publisher.plan(content.units(content.base))]
    first = publisher.plan(content.demonstrations, follows=True)
    return [first, publisher.plan(content.units(_location(first)))]


def publish_buffer_set(
    content: BufferSetContent, publisher: Publisher, plans: Sequence[RepoPlan]
) -> list[RepoPlan]:
    """Do what was planned; return the plans with their commits."""
    *first, last = plans
    done = [publisher.put(plan) for plan in first]
    if [*map(_location, done)] != [*map(_location, first)]:  # their commit is known only now
        last = publisher.plan(content.units(_location(done[0])))
    return [*done, publisher.put(last)]


def _location(plan: RepoPlan) -> str:
    """Return what a buffer set names of its demonstrations: it stays when only their card changes."""
    return f"{plan.repository.repo_id}@{plan.same or plan.published or _UNKNOWN}"


def with_locations(header: ManifestHeader, base: str | None) -> ManifestHeader:
    """Return a header that says where the datasets of a published buffer set lie."""
    places = {DEMONSTRATIONS: base, DISTRACTORS: "."}
    datasets = {
        name: replace(one, location=places.get(name, one.location))
        for name, one in header.datasets.items()
    }
    return replace(header, datasets=datasets)


def dataset_files(dataset: Dataset) -> RepoFiles:
    """Return the files of a dataset: those that its list names, the list, and embeddings."""
    index = [
        path
        for path in dataset.files.list(INDEX_DIR)
        if not any(part.startswith(".") for part in PurePosixPath(path).parts)  # being made
    ]
    paths = [*dataset.sums(), SUMS_PATH, IDENTITY_PATH, *index]
    dataset.files.fetch(paths)
    return {path: LocalFile(dataset.files.path(path)) for path in paths}


# --- digests of parts ----------------------------------------------------------------------------


def parts_of_dataset(dataset: Dataset) -> dict[str, str]:
    """Return a digest of each episode of a dataset, wherever it stands in it."""
    records = ((record, to_dict(record)) for record in dataset.records())
    return {
        f"{dataset.kind} {record.episode_id}": digest(row | {"episode_index": None})
        for record, row in records
    }


def parts_of_buffers(manifests: Iterable[BufferManifest]) -> dict[str, str]:
    """Return a digest of each buffer, wherever the datasets keep its sessions."""
    parts = {}
    for manifest in manifests:
        row = to_dict(manifest)
        sessions = row.pop("sessions")
        del row["query"]
        held = [[one[name] for name in ("role", "source", "repeat", "sha256")] for one in sessions]
        parts[str(manifest)] = digest([row, held])
    return parts


def has_questions(buffer_set: BufferSet) -> bool:
    """Tell whether a buffer set has questions about the past."""
    with suppress(MissingFileError):
        return buffer_set.files.path(QUESTIONS_PATH).is_file()
    return False


def parts_of_questions(buffer_set: BufferSet) -> dict[str, str]:
    """Return a digest of each question with its picture; of a buffer set without questions, none."""
    if not has_questions(buffer_set):
        return {}
    return {
        f"question {one.episode_id}": digest(
            to_dict(one) | {"picture": sha256(one.picture).hexdigest()}
        )
        for one in read_questions(buffer_set).values()
    }
