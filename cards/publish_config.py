"""The settings of `publish` and `publish-results`."""

from dataclasses import dataclass

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.settings import setting

from .publication import OTHER, Publication, check_repo_id
from .versions import Version


@dataclass(frozen=True)
class VersionConfig:
    """As what something is published."""

    repo_id: str = setting(help="Repository, namespace/name.")
    version: str | None = setting(
        None, help="Version, such as 1.0.0.", shown="the published one, or the first"
    )
    license: str = setting(OTHER, help="Its licence, such as cc-by-4.0; other: the recordings'.")

    def __post_init__(self) -> None:
        Publication(self.repo_id, "1.0.0" if self.version is None else self.version, self.license)

    @property
    def wanted(self) -> Version | None:
        """The version that is asked for, or None."""
        return None if self.version is None else Version.parse(self.version)


@dataclass(frozen=True)
class PublishConfig(VersionConfig):
    """As what a split is published."""

    demonstrations_id: str | None = setting(
        None,
        help="Repository of its demonstrations, unless the manifests name a published one.",
        shown="REPO_ID-demonstrations",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_repo_id(self.demonstrations, "--demonstrations-id")
        if self.repo_id == self.demonstrations_id:
            raise InvalidOptionError(
                f"--repo-id and --demonstrations-id are both {self.repo_id!r}",
                "Give each a repository of its own.",
            )

    @property
    def demonstrations(self) -> str:
        """Repository of the demonstrations."""
        return self.demonstrations_id or f"{self.repo_id}-demonstrations"

    def about(self, repo_id: str, version: str, base: str | None = None) -> Publication:
        """Return what a card is told; no paths of this machine: the same data, the same card."""
        command = f"robomme-interference publish SPLIT --repo-id {self.repo_id}"
        return Publication(repo_id, version, self.license, base, command)
