"""What is to become of a repository that is published to, and how that is told."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.viz.tables import Table

from .tree import Difference, Tree, total_size
from .upload import HubRepository, State
from .versions import Version


@dataclass(frozen=True)
class Step:
    """What is to become of one repository.

    Attributes:
        repository: The repository.
        version: Version that it is to have.
        tree: All files of that version.
        state: What is there; None if the repository is to be made.
        difference: What has to be sent and removed.
        published: Commit of the version; None as long as it is not there.
        lerobot: Tag by which LeRobot finds a dataset of its format, such as `v3.0`; or None.
        same: Commit of the first version that holds the same but for the card, of a repository
            whose versions count on their own; None if none does.
    """

    repository: HubRepository
    version: Version
    tree: Tree
    state: State | None
    difference: Difference
    published: str | None
    lerobot: str | None
    same: str | None

    def as_dict(self) -> dict[str, Any]:
        """Return it as plain values, for JSON."""
        sent = self.difference.sent
        return {
            "repo_id": self.repository.repo_id,
            "version": str(self.version),
            "commit": self.published,
            "new_repository": self.state is None,
            "files": len(self.tree),
            "bytes": total_size(self.tree),
            "sent_files": len(sent),
            "sent_bytes": total_size(self.tree, sent),
            "removed_files": list(self.difference.removed),
        }

    @property
    def state_told(self) -> str:
        """What is there, in words."""
        if self.published is not None:
            return f"published, {self.published[:12]}"
        if self.state is None:
            return "new repository"
        removed = len(self.difference.removed)
        return f"there, {removed} files go" if removed else "there"


def step_table(steps: Iterable[Step]) -> Table:
    """Return steps as a table, a row a repository."""
    columns = "repository version files:count bytes:count sent:count sent_bytes:count state"
    names = ("repo_id", "version", "files", "bytes", "sent_files", "sent_bytes")
    rows = [(*map(step.as_dict().get, names), step.state_told) for step in steps]
    return Table.make("publish", "What is published", columns, rows)
