"""What is published, as whom and as which version."""

import re
from contextlib import suppress
from dataclasses import dataclass, replace

from robomme_interference_data.errors import InvalidOptionError

HUB = "https://huggingface.co"
"""What cards link to, whatever server they are published on: the same data gives the same card."""

OTHER = "other"
"""The licence of data whose publisher names none: that of the recordings applies."""

_VERSION = re.compile(r"(?:0|[1-9]\d{0,8})(?:\.(?:0|[1-9]\d{0,8})){2}")
_LICENSE = re.compile(r"[a-z0-9][a-z0-9.+-]{0,63}")


def is_commit(text: object) -> bool:
    """Tell whether a value is the hash of a commit: 40 digits."""
    return isinstance(text, str) and re.fullmatch(r"[0-9a-f]{40}", text) is not None


def check_repo_id(repo_id: object, option: str = "--repo-id") -> str:
    """Return the name of a repository on the Hub.

    Raises:
        InvalidOptionError: It is none, or lacks its namespace.
    """
    from huggingface_hub.errors import HFValidationError
    from huggingface_hub.utils import validate_repo_id

    expected = (
        "namespace/name of a repository on the Hub, of letters, digits, '-', '_' and '.', at most "
        "96 in the name"
    )
    if not isinstance(repo_id, str):
        raise InvalidOptionError.expected(option, repo_id, expected)
    try:
        validate_repo_id(repo_id)
    except HFValidationError:
        raise InvalidOptionError.expected(option, repo_id, expected) from None
    if "/" not in repo_id:
        hint = "The namespace is your name there, or an organization's: hf auth whoami"
        raise InvalidOptionError.expected(option, repo_id, expected, hint)
    return repo_id


@dataclass(frozen=True)
class Publication:
    """A version of something that is published.

    Attributes:
        repo_id: Its repository, `namespace/name`.
        version: Such as `1.2.0`: buffers changed, added, or only card and index did.
        license: Identifier of its licence, as the Hub knows them; `other` for that of the
            recordings, whatever it is.
        base: What it was made for, `namespace/name@<40-digit commit>`: of a split its
            demonstrations, of results their split; None if that is not published.
        command: The command that made it, or None.

    Raises:
        InvalidOptionError: One of them is not as described.
    """

    repo_id: str
    version: str = "1.0.0"
    license: str = OTHER
    base: str | None = None
    command: str | None = None

    def __post_init__(self) -> None:
        check_repo_id(self.repo_id)
        if not _VERSION.fullmatch(self.version):
            raise InvalidOptionError.expected(
                "--version", self.version, "three numbers, such as 1.2.0"
            )
        if not _LICENSE.fullmatch(self.license):
            raise InvalidOptionError.expected(
                "--license",
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

    def made_for(self, place: object) -> "Publication":
        """Return the same with a base, if it has none and `place` names one on the Hub."""
        with suppress(InvalidOptionError):
            if self.base is None and isinstance(place, str):
                return replace(self, base=place)
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
