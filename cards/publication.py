"""What is published, as whom and as which version."""

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.schema.settings import setting

HUB = "https://huggingface.co"
"""What cards link to, whatever server they are published on: the same data gives the same card."""

OTHER = "other"
"""The license of data whose publisher names none: that of the recordings applies."""

_VERSION = re.compile(r"(0|[1-9]\d{0,8})\.(0|[1-9]\d{0,8})\.(0|[1-9]\d{0,8})")
_LICENSE = re.compile(r"[a-z0-9][a-z0-9.+-]{0,63}")


class Version(NamedTuple):
    """A version, such as 1.2.0; versions are ordered."""

    major: int
    minor: int
    patch: int

    @classmethod
    def parse(cls, text: str) -> "Version | None":
        """Return the version that a text such as `1.2.0` names; None if it names none."""
        match = _VERSION.fullmatch(text)
        return cls(*map(int, match.groups())) if match else None

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}.{self.patch}"

    @property
    def tag(self) -> str:
        """The tag that names it in a repository."""
        return f"data-{self}"

    def following(self, before: Mapping[str, str], now: Mapping[str, str]) -> "Version":
        """Return the version that comes next, given the digest of each part before and now."""
        if any(now.get(name) != digest for name, digest in before.items()):
            return Version(self.major + 1, 0, 0)
        if now.keys() - before.keys():
            return Version(self.major, self.minor + 1, 0)
        return Version(self.major, self.minor, self.patch + 1)


def versions_of(tags: Mapping[str, str]) -> dict[Version, str]:
    """Return the versions among tags, in order, with the commit of each."""
    named = {tag: Version.parse(tag.removeprefix("data-")) for tag in tags if tag[:5] == "data-"}
    return dict(sorted((version, tags[tag]) for tag, version in named.items() if version))


def is_commit(text: object) -> bool:
    """Tell whether a value is the hash of a commit: 40 digits."""
    return isinstance(text, str) and re.fullmatch(r"[0-9a-f]{40}", text) is not None


def check_repo_id(repo_id: object, name: str = "repo_id") -> str:
    """Return the name of a repository on the Hub, or raise an `InvalidOptionError`."""
    from huggingface_hub.errors import HFValidationError
    from huggingface_hub.utils import validate_repo_id

    hint = None
    with suppress(HFValidationError):
        if isinstance(repo_id, str):
            validate_repo_id(repo_id)
            if "/" in repo_id:
                return repo_id
            hint = "The namespace is your name there, or an organization's: hf auth whoami"
    expected = (
        "namespace/name of a repository on the Hub, of letters, digits, '-', '_' and '.', at most "
        "96 in the name"
    )
    raise InvalidOptionError.expected(name, repo_id, expected, hint)


@dataclass(frozen=True)
class Publication:
    """A version of something that is published.

    Attributes:
        repo_id: Its repository, `namespace/name`.
        version: Such as `1.2.0`: buffers changed, added, or only card and index did.
        license: Identifier of its license, as the Hub knows them; `other` for that of the
            recordings.
        base: What it was made for, `namespace/name@<40-digit commit>`: of a buffer set its
            demonstrations, of results their buffer set; None if that is not published.
        command: The command that made it, or None.
    """

    repo_id: str
    version: str = "1.0.0"
    license: str = OTHER
    base: str | None = None
    command: str | None = None

    def __post_init__(self) -> None:
        check_repo_id(self.repo_id)
        if Version.parse(self.version) is None:
            expected = "three numbers, such as 1.2.0"
            raise InvalidOptionError.expected("version", self.version, expected)
        if not _LICENSE.fullmatch(self.license):
            raise InvalidOptionError.expected(
                "license",
                self.license,
                f"an identifier such as cc-by-4.0, or {OTHER}",
                f"All of them: {HUB}/docs/hub/repositories-licenses",
            )
        if self.base is not None:
            repo_id, _, commit = self.base.partition("@")
            if not is_commit(commit):
                expected = "namespace/name@ and the 40 digits of a commit"
                raise InvalidOptionError.expected("base", self.base, expected)
            check_repo_id(repo_id, "base")

    def made_for(self, location: object) -> "Publication":
        """Return the same with a base, if it has none and `location` names one on the Hub."""
        with suppress(InvalidOptionError):
            if self.base is None and isinstance(location, str):
                return replace(self, base=location)
        return self

    @property
    def tag(self) -> str:
        """Tag of the version in its repository."""
        return f"data-{self.version}"

    @property
    def namespace(self) -> str:
        """Who publishes."""
        return self.repo_id.split("/")[0]

    @property
    def name(self) -> str:
        """Name of the repository in its namespace."""
        return self.repo_id.split("/")[1]

    @property
    def url(self) -> str:
        """Page of the repository."""
        return f"{HUB}/datasets/{self.repo_id}"

    @property
    def base_repo(self) -> str | None:
        """Repository of `base`, or None."""
        return self.base and self.base.split("@")[0]

    @property
    def base_commit(self) -> str | None:
        """Commit of `base`, or None."""
        return self.base and self.base.split("@")[1]


@dataclass(frozen=True)
class VersionConfig:
    """The settings of `publish-results`, and those that `publish` shares with it."""

    repo_id: str = setting(help="Repository, namespace/name.")
    version: str | None = setting(
        None, help="Version, such as 1.0.0.", shown="the published one, or the first"
    )
    license: str = setting(OTHER, help="Its license, such as cc-by-4.0; other: the recordings'.")

    def __post_init__(self) -> None:
        Publication(self.repo_id, "1.0.0" if self.version is None else self.version, self.license)

    @property
    def wanted(self) -> Version | None:
        """The version that is asked for, or None."""
        return None if self.version is None else Version.parse(self.version)


@dataclass(frozen=True)
class PublishConfig(VersionConfig):
    """The settings of `publish`."""

    demonstrations_id: str | None = setting(
        None,
        help="Repository of its demonstrations, unless the manifests name a published one.",
        shown="REPO_ID-demonstrations",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_repo_id(self.demonstrations, "demonstrations_id")
        if self.repo_id == self.demonstrations_id:
            raise InvalidOptionError(
                f"repo_id and demonstrations_id are both {self.repo_id!r}",
                "Give each a repository of its own.",
            )

    @property
    def demonstrations(self) -> str:
        """Repository of the demonstrations."""
        return self.demonstrations_id or f"{self.repo_id}-demonstrations"
