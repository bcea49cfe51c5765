"""What every publication is: a repository gets a version in one commit, and a tag that names it.

The tag comes last. What has no tag is no version, whatever an upload that failed has left behind.
"""

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from hashlib import sha256
from typing import Any

from robomme_interference_data.constants import PARTS_PATH
from robomme_interference_data.errors import FormatError, MissingFileError, PublishError
from robomme_interference_data.storage.files import canonical_json, indented_json, read_json
from robomme_interference_data.storage.hub import HubFiles
from robomme_interference_data.viz.tables import Table

from .publication import Version, VersionConfig, versions_of
from .render import README, is_card
from .repo import (
    Difference,
    HubRepository,
    LocalFile,
    RepoFiles,
    RepoState,
    compare,
    is_unmanaged,
    total_size,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class RepoContent:
    """What is published in one repository.

    Attributes:
        repo_id: The repository.
        first: The version that it has if it has none yet and none is asked for.
        data: Its files without the card.
        parts: Digest of each part of it, such as an episode: they decide the next version.
        card: Makes the card of a version: bytes by path.
        marker_file: A file that tells such a repository from others.
        lerobot: Tag by which LeRobot finds a dataset of its format, such as `v3.0`; None if it is
            no dataset of LeRobot.
    """

    repo_id: str
    first: Version
    data: RepoFiles
    parts: Mapping[str, str]
    card: Callable[[Version], Mapping[str, bytes]]
    marker_file: str
    lerobot: str | None = None

    def files(self, version: Version) -> RepoFiles:
        """Return all files of a version."""
        more = {PARTS_PATH: indented_json(dict(self.parts)).encode(), **self.card(version)}
        return self.data | {path: LocalFile(content) for path, content in more.items()}


@dataclass(frozen=True)
class RepoPlan:
    """What is to become of one repository.

    Attributes:
        repository: The repository.
        version: Version that it is to have.
        files: All files of that version.
        state: What it holds now; None if the repository is to be created.
        difference: What has to be sent and removed.
        published: Commit of the version; None as long as it is not there.
        lerobot: See `RepoContent`.
        same: Commit of the first version that holds the same but for the card, of a repository
            whose versions count on their own; None if none does.
    """

    repository: HubRepository
    version: Version
    files: RepoFiles
    state: RepoState | None
    difference: Difference
    published: str | None
    lerobot: str | None
    same: str | None

    def to_dict(self) -> dict[str, Any]:
        """Return it as plain values, for JSON."""
        sent = self.difference.sent
        return {
            "repo_id": self.repository.repo_id,
            "version": str(self.version),
            "commit": self.published,
            "new_repository": self.state is None,
            "files": len(self.files),
            "bytes": total_size(self.files),
            "sent_files": len(sent),
            "sent_bytes": total_size(self.files, sent),
            "removed_files": list(self.difference.removed),
        }

    @property
    def status(self) -> str:
        """What is there, in words."""
        if self.published is not None:
            return f"published, {self.published[:12]}"
        if self.state is None:
            return "new repository"
        removed = len(self.difference.removed)
        return f"exists, {removed} files are removed" if removed else "exists"


def digest(value: Any) -> str:
    """Return the digest of a part: SHA-256 of its plain values as JSON."""
    return sha256(canonical_json(value).encode(errors="backslashreplace")).hexdigest()


def plan_table(plans: Iterable[RepoPlan]) -> Table:
    """Return plans as a table, a row a repository."""
    columns = "repository version files:count bytes:count sent:count sent_bytes:count state"
    names = ("repo_id", "version", "files", "bytes", "sent_files", "sent_bytes")
    rows = [(*map(plan.to_dict().get, names), plan.status) for plan in plans]
    return Table.make("publish", "What is published", columns, rows)


class Publisher:
    """Gives repositories their versions.

    Args:
        config: As what something is published.
        private: Whether repositories that have to be created are private.
    """

    def __init__(self, config: VersionConfig, *, private: bool = False):
        self._wanted = config.wanted
        self._private = private

    def plan(self, content: RepoContent, *, follows: bool = False) -> RepoPlan:
        """Look at what is there; return what is to become of a repository.

        A `PublishError` says that the version is there already and is another one, or does not say
        how much has changed, or that the repository holds something else.

        Args:
            content: What it is to hold.
            follows: Its versions count on their own: if it has changed it takes the next one that
                fits, whatever version is asked for.
        """
        repository = HubRepository(content.repo_id)
        state = repository.state()
        files_at = cache(repository.files)  # what a commit holds never changes
        existing = files_at(state.head) if state else {}
        versions = versions_of(state.tags) if state else {}
        if not versions:
            _check_ours(content, repository, existing)
        newest = max(versions, default=self._wanted or content.first)
        version = newest if follows or self._wanted is None else self._wanted
        files, published, difference = content.files(version), versions.get(version), Difference()
        if published is not None and (difference := compare(files, files_at(published))):
            published = None
        if published is None and versions:
            fits = newest.following(_parts_at(content.repo_id, versions[newest]), content.parts)
            if follows:
                version, files = fits, content.files(fits)
            elif difference or version < fits:
                raise PublishError(
                    f"{content.repo_id} has the version {version} already, and it is another one: "
                    f"{difference}"
                    if difference
                    else f"version {version} of {content.repo_id} does not say how much has "
                    f"changed since {newest}",
                    f'The next version that fits: version="{fits}"',
                )
        same = None
        for earlier in reversed(versions.values() if follows else ()):
            if compare(_without_card(files), _without_card(files_at(earlier))):
                break
            same = earlier
        difference = Difference() if published else compare(files, existing)
        return RepoPlan(
            repository, version, files, state, difference, published, content.lerobot, same
        )

    def check_rights(self, plans: Iterable[RepoPlan]) -> None:
        """Check that this login may write to all repositories, as far as that can be known."""
        for plan in plans:
            if plan.published is None:
                plan.repository.check_rights(plan.state is not None)

    def put(self, plan: RepoPlan) -> RepoPlan:
        """Do what was planned for a repository; return the plan with its commit."""
        if plan.published is not None:
            return plan
        repository, version = plan.repository, plan.version
        logger.info("%s: sending %d files", repository.repo_id, len(plan.difference.sent))
        state = plan.state or repository.create(self._private)
        commit = repository.commit(plan.files, state.head, f"Version {version}")
        if plan.lerobot is not None:
            repository.tag(plan.lerobot, commit, move=True)
        repository.tag(version.tag, commit)
        logger.info("%s: version %s is %s", repository.repo_id, version, commit)
        return replace(plan, published=commit)


def _without_card[F](files: Mapping[str, F]) -> dict[str, F]:
    return {path: file for path, file in files.items() if not is_card(path)}


def _parts_at(repo_id: str, commit: str) -> dict[str, str]:
    """Return the digests of the parts that a published version holds."""
    try:
        return read_json(HubFiles(repo_id, commit).path(PARTS_PATH))
    except (FormatError, MissingFileError):
        return {"what cannot be read": ""}


def _check_ours(
    content: RepoContent, repository: HubRepository, existing: Mapping[str, object]
) -> None:
    """Check that a repository without versions holds nothing, or what an upload left behind."""
    others = [path for path in existing if not is_unmanaged(path) and path != README]
    if others and content.marker_file not in existing:
        raise PublishError(
            f"{repository.repo_id} holds something else, such as {others[0]}",
            f"Give another repository; the files of this one: {repository.page}/tree/main",
        )
