"""Plan a version of a repository, and publish it: one commit, and then a tag that names it.

The tag comes last. Content without a tag is no version, so an interrupted upload publishes nothing.
"""

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from robomme_interference_data.errors import PublishError, counted
from robomme_interference_data.viz.tables import Columns, Table

from .publication import Version, versions_of
from .render import README, is_card
from .repo import Difference, HubRepository, LocalFile, RepoFiles, compare, is_unmanaged, total_size

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RepoContent:
    """What a repository is to hold.

    Attributes:
        repo_id: The repository, `namespace/name`.
        first: The version of an empty repository.
        data: Its files without the card.
        card: Makes the card of a version; None in a dry run without the libraries for it: cards
            are then not compared.
        marker_file: A file that only such a repository has.
        lerobot: The tag by which LeRobot finds the format of its dataset; None if it holds none.
    """

    repo_id: str
    first: Version
    data: RepoFiles
    card: Callable[[Version], Mapping[str, bytes]] | None
    marker_file: str
    lerobot: str | None = None

    def files(self, version: Version) -> RepoFiles:
        """Return all files of a version."""
        card = {} if self.card is None else self.card(version)
        return self.data | {path: LocalFile(data) for path, data in card.items()}


@dataclass(frozen=True)
class RepoPlan:
    """What publishing a version of a repository changes.

    `head` is the commit of its main branch (None for a new repository) and `published` that of the
    version (None until it exists).
    """

    repository: HubRepository
    content: RepoContent
    version: Version
    files: RepoFiles
    head: str | None
    difference: Difference
    published: str | None

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
        if self.difference.removed:
            status += f", removes {counted(len(self.difference.removed), 'file')}"
        return status


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


def plan_version(content: RepoContent, requested: Version | None) -> RepoPlan:
    """Compare content with its repository, and return what publishing it changes.

    Args:
        content: What the repository is to hold.
        requested: The version; None for the newest one of the repository, or its first.

    Raises:
        PublishError: The version exists with other content, or is lower than the newest one, or
            the repository holds something else.
    """
    state = _RepoState(content)
    newest = max(state.versions, default=None)
    version = requested or newest or content.first
    files = content.files(version)
    if version in state.versions:
        commit = state.versions[version]
        difference = compare(files, state.files_at(commit))
        if difference:
            raise PublishError(
                f"{content.repo_id} already has a version {version} with other content: "
                f"{difference}",
                f"Publish it as a version above {newest} (--version).",
            )
        return state.plan(version, files, commit)
    if newest is not None and version < newest:
        raise PublishError(
            f"version {version} of {content.repo_id} is too low: the newest one is {newest}",
            f"Publish it as a version above {newest} (--version).",
        )
    return state.plan(version, files)


def plan_next_version(content: RepoContent, requested: Version | None) -> RepoPlan:
    """Return the plan of the newest version if it holds the same data, else of one after it.

    Others name commits of such a repository, so equal data keeps its commit, and with it its card.

    Args:
        content: What the repository is to hold.
        requested: The version if the repository has none; None for its first.
    """
    state = _RepoState(content)
    newest = max(state.versions, default=None)
    if newest is None:
        version = requested or content.first
        return state.plan(version, content.files(version))
    commit, files = state.versions[newest], content.files(newest)
    if all(map(is_card, compare(files, state.files_at(commit)).paths)):
        return state.plan(newest, files, commit)
    version = Version(newest.major + 1, 0, 0)
    return state.plan(version, content.files(version))


def publish_version(plan: RepoPlan, *, private: bool = False) -> RepoPlan:
    """Carry out a plan; return it with the commit of the version.

    Args:
        plan: What to publish; nothing is sent if the version exists.
        private: Make a new repository private.
    """
    if plan.published is not None:
        return plan
    repository, version = plan.repository, plan.version
    logger.info("%s: sending %d files", repository.repo_id, len(plan.difference.sent))
    head = plan.head or repository.create(private)
    commit = repository.commit(plan.files, head, f"Version {version}")
    # LeRobot's tag moves to each new version. The version's own is last: see the module.
    if plan.content.lerobot is not None:
        repository.tag(plan.content.lerobot, commit, move=True)
    repository.tag(version.tag, commit)
    logger.info("%s: version %s is %s", repository.repo_id, version, commit)
    return replace(plan, published=commit)


class _RepoState:
    """What the repository of a content holds on the Hub."""

    def __init__(self, content: RepoContent):
        self.content = content
        self.repository = HubRepository(content.repo_id)
        revisions = self.repository.revisions() or {}
        self.head = revisions.get("main")
        self.versions = versions_of(revisions)
        self.existing = self.files_at(self.head) if self.head else {}
        if not self.versions:
            self._check_unused()

    def files_at(self, commit: str) -> dict[str, Any]:
        """Return its files at a commit, by path: those that the content can be compared with."""
        files = self.repository.files(commit)
        if self.content.card is None:
            return {path: file for path, file in files.items() if not is_card(path)}
        return files

    def plan(self, version: Version, files: RepoFiles, published: str | None = None) -> RepoPlan:
        """Return the plan for a version, which is `published` or changes the main branch."""
        difference = Difference() if published else compare(files, self.existing)
        return RepoPlan(
            self.repository, self.content, version, files, self.head, difference, published
        )

    def _check_unused(self) -> None:
        """Check that a repository without versions is empty, or holds an interrupted upload."""
        others = [path for path in self.existing if not is_unmanaged(path) and path != README]
        if others and self.content.marker_file not in self.existing:
            raise PublishError(
                f"{self.repository.repo_id} holds something else, such as {others[0]}",
                f"Choose another repository; the files of this one: {self.repository.page}"
                "/tree/main",
            )


def check_rights(plans: Iterable[RepoPlan]) -> None:
    """Check as far as possible that this login may write to all repositories."""
    for plan in plans:
        if plan.published is None:
            plan.repository.check_rights(plan.head is not None)
