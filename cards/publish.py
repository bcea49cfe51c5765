"""Check a buffer set, and publish it: its demonstrations, then its units and manifests."""

import logging
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path, PurePosixPath

from robomme_interference_data.build_dataset.verify.audit import audit_buffer_set
from robomme_interference_data.build_dataset.verify.buffer_set import verify_buffer_set
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
from robomme_interference_data.data.questions import digest_questions, read_questions
from robomme_interference_data.errors import MissingFileError, PublishError, counted
from robomme_interference_data.runtime.progress import WorkProgress
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.storage.files import (
    LocalFiles,
    digest_json,
    indented_json,
    with_filename,
)
from robomme_interference_data.storage.hub import HubFiles

from .dataset_facts import buffer_set_facts, demonstrations_facts
from .facts import Facts
from .publication import Publication, PublishConfig, Version
from .publisher import Publisher, RepoContent, RepoPlan
from .render import card_files
from .repo import LocalFile, RepoFiles


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
        parts = parts_of_dataset(dataset)
        return self._content(self.config.demonstrations, dataset, facts, files, parts)

    @cached_property
    def _units(self) -> tuple[Facts, RepoFiles, dict[str, str]]:
        """Facts, files and parts of the buffer set's repository, but for its manifest.json."""
        buffer_set, datasets = self.buffer_set, self.buffer_set.header.datasets
        files: RepoFiles = {}
        parts = parts_of_buffers(buffer_set.manifests())
        for name in (DISTRACTORS, *(name for name in OPTIONAL_DATASETS if name in datasets)):
            folder = "" if name == DISTRACTORS else f"{name}/"
            dataset = buffer_set.datasets[name]
            files |= {folder + path: file for path, file in dataset_files(dataset).items()}
            parts |= parts_of_dataset(dataset)
        rows_path = f"{MANIFESTS}/{MANIFEST_ROWS}"
        files[rows_path] = LocalFile(buffer_set.files.path(rows_path))
        with suppress(MissingFileError):
            questions = buffer_set.files.path(QUESTIONS_PATH)
            if questions.is_file():
                files[QUESTIONS_PATH] = LocalFile(questions)
                parts |= parts_of_questions(buffer_set)
        return buffer_set_facts(buffer_set), files, parts

    def units(self, base: str | None, *, pending: bool = False) -> RepoContent:
        """Return the buffer set's own repository: units at its root, and the manifests.

        Args:
            base: Location of the demonstrations, `namespace/name@commit`; None for a folder beside.
            pending: The demonstrations get a location when they are published, after this.
        """
        facts, files, parts = self._units
        if not pending:
            locations = {DEMONSTRATIONS: base, DISTRACTORS: "."}
            header = self.buffer_set.header
            datasets = {
                name: replace(dataset, location=locations.get(name, dataset.location))
                for name, dataset in header.datasets.items()
            }
            text = indented_json(to_dict(replace(header, datasets=datasets)))
            files = files | {MANIFEST_PATH: LocalFile(text.encode())}
        units = self.buffer_set.datasets[DISTRACTORS]
        content = self._content(self.config.repo_id, units, facts, files, parts, base)
        return replace(content, pending=pending)

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
        parts: dict[str, str],
        base: str | None = None,
    ) -> RepoContent:
        # Without paths of this machine: equal data gives equal cards.
        command = f"robomme-interference publish BUFFER_SET --repo-id {self.config.repo_id}"

        def card(version: Version) -> dict[str, bytes]:
            license = self.config.license
            return card_files(facts, Publication(repo_id, str(version), license, base, command))

        first = Version.parse(dataset.identity.version) or Version(1, 0, 0)
        lerobot = str(dataset.lerobot.version)
        made = None if "score" in missing_extras() else card
        return RepoContent(repo_id, first, files, parts, made, IDENTITY_PATH, lerobot)


def plan_buffer_set(content: BufferSetContent, publisher: Publisher) -> list[RepoPlan]:
    """Plan the demonstrations, unless the manifests name published ones, and the buffer set."""
    if content.base is not None:
        return [publisher.plan(content.units(content.base))]
    first = publisher.plan(content.demonstrations, follows=True)
    base = _location(first)
    return [first, publisher.plan(content.units(base, pending=base is None))]


def publish_buffer_set(
    content: BufferSetContent, publisher: Publisher, plans: Sequence[RepoPlan]
) -> list[RepoPlan]:
    """Carry out plans; return them with their commits."""
    *first, last = plans
    done = [publisher.put(plan) for plan in first]
    if last.content.pending:
        last = publisher.plan(content.units(_location(done[0])))
    return [*done, publisher.put(last)]


def _location(plan: RepoPlan) -> str | None:
    """Return the location of demonstrations, the same while only their card changes."""
    commit = plan.same or plan.published
    return commit and f"{plan.repository.repo_id}@{commit}"


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


# --- digests of parts ----------------------------------------------------------------------------


def parts_of_dataset(dataset: Dataset) -> dict[str, str]:
    """Return a digest of each episode of a dataset, whatever its position."""
    records = ((record, to_dict(record)) for record in dataset.records())
    return {
        f"{dataset.kind} {record.episode_id}": digest_json([row | {"episode_index": None}])
        for record, row in records
    }


def parts_of_buffers(manifests: Iterable[BufferManifest]) -> dict[str, str]:
    """Return a digest of each buffer, wherever its sessions are stored."""
    parts = {}
    for manifest in manifests:
        row = to_dict(manifest)
        sessions = row.pop("sessions")
        del row["query"]
        held = [[one[name] for name in ("role", "source", "repeat", "sha256")] for one in sessions]
        parts[str(manifest)] = digest_json([[row, held]])
    return parts


def parts_of_questions(buffer_set: BufferSet) -> dict[str, str]:
    """Return a digest of each question, its picture included."""
    return {
        f"question {question.episode_id}": digest_questions([question])
        for question in read_questions(buffer_set).values()
    }


# --- checks --------------------------------------------------------------------------------------


_EXTRAS = {"build": ("lerobot", "datasets"), "score": ("jinja2", "matplotlib")}
"""Extras that publishing needs, and their libraries."""


def missing_extras() -> list[str]:
    """Return the extras that publishing needs, and that are not installed."""
    return [
        extra
        for extra, libraries in _EXTRAS.items()
        if any(find_spec(library) is None for library in libraries)
    ]


def check_buffer_set(buffer_set: BufferSet, progress: WorkProgress | None = None) -> None:
    """Check hashes, rules and leaks, and that LeRobot, if installed, opens the datasets."""
    buffer_set.check_is_whole()
    violations = list(verify_buffer_set(buffer_set, progress=progress))
    if violations:
        first = violations[0]
        raise PublishError(
            f"{buffer_set.location} has {counted(len(violations), 'violation')}, such as "
            f"{first.where}: {first.what}",
            "List all violations.",
            f"verify {buffer_set.location}",
        )
    leaks = audit_buffer_set(buffer_set).leaks
    if leaks:
        raise PublishError(
            f"{buffer_set.location} has {counted(len(leaks), 'leak')}, such as {leaks[0].kind}: "
            f"{leaks[0].where}",
            "List all leaks.",
            f"audit {buffer_set.location}",
        )
    for name in buffer_set.header.datasets if "build" not in missing_extras() else ():
        files = buffer_set.dataset_files(name)
        if isinstance(files, LocalFiles):  # one on the Hub was checked when it was published
            open_with_lerobot(name, files.root)


def open_with_lerobot(name: str, root: Path) -> None:
    """Open a dataset with LeRobot, and read its first and last frame."""
    from datasets import config

    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        dataset = LeRobotDataset(f"local/{name}", root=root, video_backend="pyav")
        for index in (0, len(dataset) - 1):
            dataset[index]
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None:  # LeRobot copies tables to a cache, and that disk may be full
            if isinstance(cause, OSError) and cause.errno is not None:
                with with_filename(config.HF_DATASETS_CACHE):
                    raise cause from None
            cause = cause.__cause__
        raise PublishError(
            f"LeRobot cannot open {root}: {type(error).__name__}: {error}",
            "The files match their recorded hashes: check the version of lerobot.",
            "doctor",
        ) from error
    finally:
        logging.disable(before)
