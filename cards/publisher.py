"""Publish a version of a repository: one commit, and then a tag that names the version.

The tag comes last. Content without a tag is no version, so an interrupted upload publishes nothing.
"""

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

from robomme_interference_data.constants import PARTS_PATH
from robomme_interference_data.errors import FormatError, MissingFileError, PublishError, counted
from robomme_interference_data.storage.files import indented_json, read_json
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.viz.tables import Columns, Table

from .publication import Publication, Version, versions_of
from .render import README, is_card
from .repo import Difference, HubRepository, LocalFile, RepoFiles, compare, is_unmanaged, total_size

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RepoContent:
    """What a repository is to hold.

    `data` are its files without the card, `parts` the digests that decide the next version (one
    for each episode, buffer, question or rollout), `card` makes the card of a version (None in a
    dry run without the libraries for it: cards are then not compared), `first` is
    the version of an empty repository, `marker_file` a file that only such a repository has, and
    `lerobot` the tag by which LeRobot finds the format of its dataset.

    Content is `pending` while it has to name a commit that does not exist yet: the files that
    name it are missing.
    """

    repo_id: str
    first: Version
    data: RepoFiles
    parts: Mapping[str, str]
    card: Callable[[Version], Mapping[str, bytes]] | None
    marker_file: str
    lerobot: str | None = None
    pending: bool = False

    def files(self, version: Version) -> RepoFiles:
        """Return all files of a version."""
        parts = {PARTS_PATH: indented_json(dict(self.parts)).encode()}
        card = {} if self.pending or self.card is None else self.card(version)
        return self.data | {path: LocalFile(data) for path, data in (parts | dict(card)).items()}


@dataclass(frozen=True)
class RepoPlan:
    """What publishing a version of a repository changes.

    `head` is the commit of its main branch (None for a new repository) and `published` that of the
    version (None until it exists). `same` is the first of the latest versions that hold equal data
    and differ in the card alone; None if there is none.
    """

    repository: HubRepository
    content: RepoContent
    version: Version
    files: RepoFiles
    head: str | None
    difference: Difference
    published: str | None
    same: str | None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        sent = self.difference.sent
        return {
            "repo_id": self.repository.repo_id,
            "version": str(self.version),
            "commit": self.published,
            "new_repository": self.head is None,
            "files": len(self.files),
            "bytes": total_size(self.files),
            "sent_files": len(sent),
            "sent_bytes": total_size(self.files, sent),
            "removed_files": list(self.difference.removed),
        }

    @property
    def status(self) -> str:
        """The state of the repository, in words."""
        if self.published is not None:
            return f"published, {self.published[:12]}"
        status = "new repository" if self.head is None else "exists"
        if self.difference.removed and not self.content.pending:
            status += f", removes {counted(len(self.difference.removed), 'file')}"
        return status + ", without files that name the demonstrations" * self.content.pending


def plan_table(plans: Iterable[RepoPlan]) -> Table:
    """Return plans as a table, one row per repository."""
    columns: Columns = {
        "repository": "text",
        "version": "text",
        "files": "count",
        "bytes": "count",
        "sent": "count",
        "sent_bytes": "count",
        "state": "text",
    }
    names = ("repo_id", "version", "files", "bytes", "sent_files", "sent_bytes")
    rows = [(*map(plan.to_dict().get, names), plan.status) for plan in plans]
    return Table("publish", "Repositories", columns, rows)


class Publisher:
    """Plans and publishes versions of repositories.

    Args:
        config: The version to publish.
        private: Create new repositories as private.
    """

    def __init__(self, config: Publication, *, private: bool = False):
        self._requested = config.requested
        self._private = private

    def plan(self, content: RepoContent, *, follows: bool = False) -> RepoPlan:
        """Compare content with the repository, and return what publishing it changes.

        Raises a `PublishError` if the version exists with other content, if its number is too low
        for what changed, or if the repository holds something else.

        Args:
            content: What the repository is to hold.
            follows: Ignore the requested version if anything changed, and take the next one that
                fits: the repository counts its own versions.
        """
        repository = HubRepository(content.repo_id)
        revisions = repository.revisions() or {}
        head = revisions.get("main")

        @cache  # the files of a commit never change
        def files_at(commit: str) -> Any:
            files = repository.files(commit)
            return files if content.card is not None else _without_card(files)

        existing = files_at(head) if head else {}
        versions = versions_of(revisions)
        if not versions:
            _check_unused(content, repository, existing)
        newest = max(versions, default=self._requested or content.first)
        version = newest if follows or self._requested is None else self._requested
        files, published, difference = content.files(version), versions.get(version), Difference()
        if published is not None and (difference := compare(files, files_at(published))):
            published = None
        if published is None and versions:
            fitting = newest.following(_parts_at(content.repo_id, versions[newest]), content.parts)
            if follows:
                version, files = fitting, content.files(fitting)
            elif difference or version < fitting:
                changes = "other demonstrations" if content.pending else difference
                raise PublishError(
                    f"{content.repo_id} already has a version {version} with other content: "
                    f"{changes}"
                    if difference
                    else f"version {version} of {content.repo_id} is too low for what changed "
                    f"since {newest}",
                    f'The next version that fits: version="{fitting}"',
                )
        same = None
        for earlier in reversed(versions.values() if follows else ()):
            if compare(_without_card(files), _without_card(files_at(earlier))):
                break
            same = earlier
        difference = Difference() if published else compare(files, existing)
        return RepoPlan(repository, content, version, files, head, difference, published, same)

    def check_rights(self, plans: Iterable[RepoPlan]) -> None:
        """Check as far as possible that this login may write to all repositories."""
        for plan in plans:
            if plan.published is None:
                plan.repository.check_rights(plan.head is not None)

    def put(self, plan: RepoPlan) -> RepoPlan:
        """Carry out a plan; return it with the commit of the version."""
        if plan.published is not None:
            return plan
        repository, version = plan.repository, plan.version
        logger.info("%s: sending %d files", repository.repo_id, len(plan.difference.sent))
        head = plan.head or repository.create(self._private)
        commit = repository.commit(plan.files, head, f"Version {version}")
        if plan.content.lerobot is not None:
            repository.tag(plan.content.lerobot, commit, move=True)
        repository.tag(version.tag, commit)
        logger.info("%s: version %s is %s", repository.repo_id, version, commit)
        return replace(plan, published=commit)


def _without_card[F](files: Mapping[str, F]) -> dict[str, F]:
    return {path: file for path, file in files.items() if not is_card(path)}


def _parts_at(repo_id: str, commit: str) -> dict[str, str]:
    """Return the digests of the parts of a published version."""
    try:
        return read_json(HubFiles(repo_id, commit).path(PARTS_PATH))
    except (FormatError, MissingFileError):
        return {"unreadable": ""}


def _check_unused(
    content: RepoContent, repository: HubRepository, existing: Mapping[str, object]
) -> None:
    """Check that a repository without versions is empty, or holds an interrupted upload."""
    others = [path for path in existing if not is_unmanaged(path) and path != README]
    if others and content.marker_file not in existing:
        raise PublishError(
            f"{repository.repo_id} holds something else, such as {others[0]}",
            f"Choose another repository; the files of this one: {repository.page}/tree/main",
        )
