"""What the two repositories of a buffer set hold: its demonstrations; its units and manifests."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
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
from robomme_interference_data.errors import MissingFileError, PublishError
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.storage.files import LocalFiles
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.storage.text import indented_json

from .checks import missing_extras
from .dataset_facts import buffer_set_facts, demonstrations_facts
from .facts import Facts
from .publication import Publication, PublishConfig, Version
from .render import card_files
from .repo import LocalFile, RepoFiles
from .repo_plan import RepoContent, RepoPlan, plan_next_version, plan_version, publish_version

_COMMIT_TO_COME = "0" * 40
"""Stands for the commit of demonstrations in plans: it exists once they are published."""


class BufferSetContent:
    """What the repositories of a buffer set are to hold.

    Args:
        buffer_set: The buffer set, which `check_buffer_set` has checked.
        config: The version to publish.
    """

    def __init__(self, buffer_set: BufferSet, config: PublishConfig):
        self.buffer_set = buffer_set
        self.config = config

    @cached_property
    def base(self) -> str | None:
        """Location of the demonstrations that the manifests name, if those are published."""
        recorded = self.buffer_set.header.datasets[DEMONSTRATIONS]
        location = recorded.location or ""
        repo_id, _, commit = location.partition("@")
        if not commit or self.config.demonstrations_id not in (None, repo_id):
            return None
        if Dataset(HubFiles.parse(location)).revision != recorded.revision:
            raise PublishError(
                f"{recorded.location} holds other demonstrations than those of "
                f"{self.buffer_set.location}",
                self.buffer_set.fix,
            )
        return recorded.location

    @cached_property
    def demonstrations(self) -> RepoContent:
        """The repository of the demonstrations."""
        dataset = self.buffer_set.datasets[DEMONSTRATIONS]
        facts, files = demonstrations_facts(dataset), dataset_files(dataset)
        return self._content(self.config.demonstrations, dataset, facts, files)

    @cached_property
    def _units(self) -> tuple[Facts, RepoFiles]:
        """Facts and files of the buffer set's repository, but for its manifest.json."""
        buffer_set, datasets = self.buffer_set, self.buffer_set.header.datasets
        files: RepoFiles = {}
        for name in (DISTRACTORS, *(name for name in OPTIONAL_DATASETS if name in datasets)):
            folder = "" if name == DISTRACTORS else f"{name}/"
            dataset = buffer_set.datasets[name]
            files |= {folder + path: file for path, file in dataset_files(dataset).items()}
        rows_path = f"{MANIFESTS}/{MANIFEST_ROWS}"
        files[rows_path] = LocalFile(buffer_set.rows_path)
        with suppress(MissingFileError):
            questions = buffer_set.files.path(QUESTIONS_PATH)
            if questions.is_file():
                files[QUESTIONS_PATH] = LocalFile(questions)
        return buffer_set_facts(buffer_set), files

    def units(self, base: str | None) -> RepoContent:
        """Return the buffer set's own repository: units at its root, and the manifests.

        Args:
            base: Location of the demonstrations, `namespace/name@commit`; None for a folder beside.
        """
        facts, files = self._units
        locations = {DEMONSTRATIONS: base, DISTRACTORS: "."}
        header = self.buffer_set.header
        datasets = {
            name: replace(dataset, location=locations.get(name, dataset.location))
            for name, dataset in header.datasets.items()
        }
        text = indented_json(to_dict(replace(header, datasets=datasets)))
        files = files | {MANIFEST_PATH: LocalFile(text.encode())}
        units = self.buffer_set.datasets[DISTRACTORS]
        return self._content(self.config.repo_id, units, facts, files, base)

    def folder(self) -> RepoFiles:
        """Return the files of the buffer set's repository, with the other one in `demonstrations/`.

        Demonstrations that are only on the Hub stay there.
        """
        base = self.buffer_set.header.datasets[DEMONSTRATIONS].location
        units = self.units(base if base and "@" in base else None)
        files = units.files(self.config.requested or units.first)
        if isinstance(self.buffer_set.dataset_files(DEMONSTRATIONS), LocalFiles):
            lessons = self.demonstrations
            lesson_files = lessons.files(self.config.requested or lessons.first)
            files |= {f"{DEMONSTRATIONS}/{path}": file for path, file in lesson_files.items()}
        return files

    def _content(
        self,
        repo_id: str,
        dataset: Dataset,
        facts: Facts,
        files: RepoFiles,
        base: str | None = None,
    ) -> RepoContent:
        # Without paths of this machine: equal data gives equal cards.
        command = f"robomme-interference publish BUFFER_SET --repo-id {self.config.repo_id}"

        def card(version: Version) -> dict[str, bytes]:
            license = self.config.license
            return card_files(facts, Publication(repo_id, str(version), license, base, command))

        first = Version.parse(dataset.identity.version) or Version(1, 0, 0)
        lerobot = str(dataset.lerobot.version)
        can_draw = "score" not in missing_extras()
        return RepoContent(
            repo_id, first, files, card if can_draw else None, IDENTITY_PATH, lerobot
        )


def plan_buffer_set(content: BufferSetContent) -> list[RepoPlan]:
    """Plan the demonstrations, unless the manifests name published ones, and the buffer set."""
    requested = content.config.requested
    if content.base is not None:
        return [plan_version(content.units(content.base), requested)]
    lessons = plan_next_version(content.demonstrations, requested)
    return [lessons, plan_version(content.units(_location(lessons)), requested)]


def publish_buffer_set(
    content: BufferSetContent, plans: Sequence[RepoPlan], *, private: bool = False
) -> list[RepoPlan]:
    """Carry out plans; return them with their commits.

    Args:
        content: What is planned.
        plans: What `plan_buffer_set` returned.
        private: Make new repositories private.
    """
    *first, units = plans
    done = [publish_version(plan, private=private) for plan in first]
    if any(plan.published is None for plan in first):
        # Now the commit exists that the manifests and the card have to name.
        units = plan_version(content.units(_location(done[0])), content.config.requested)
    return [*done, publish_version(units, private=private)]


def _location(plan: RepoPlan) -> str:
    """Return the location of demonstrations that are published, or are about to be."""
    return f"{plan.repository.repo_id}@{plan.published or _COMMIT_TO_COME}"


def dataset_files(dataset: Dataset) -> RepoFiles:
    """Return the files of a dataset: those in its list of SHA-256 sums, the list, embeddings."""
    index = [
        path
        for path in dataset.files.list(INDEX_DIR)
        if not any(part.startswith(".") for part in PurePosixPath(path).parts)  # unfinished
    ]
    paths = [*dataset.sums(), SUMS_PATH, IDENTITY_PATH, *index]
    dataset.files.fetch(paths)
    return {path: LocalFile(dataset.files.path(path)) for path in paths}
