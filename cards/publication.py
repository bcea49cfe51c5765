"""What a version of a repository is: its name, its number, its license, and the settings for it."""

import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

from robomme_interference_data.errors import InvalidOptionError, nearest
from robomme_interference_data.schema.settings import setting

OTHER = "other"
"""License of data whose publisher chooses none: the license of the recordings applies."""

_LICENSE_IDS = """
afl-3.0 agpl-3.0 apache-2.0 apple-amlr apple-ascl artistic-2.0 bigcode-openrail-m
bigscience-bloom-rail-1.0 bigscience-openrail-m bsd bsd-2-clause bsd-3-clause bsd-3-clause-clear
bsl-1.0 c-uda cc cc-by-2.0 cc-by-2.5 cc-by-3.0 cc-by-4.0 cc-by-nc-2.0 cc-by-nc-3.0 cc-by-nc-4.0
cc-by-nc-nd-3.0 cc-by-nc-nd-4.0 cc-by-nc-sa-2.0 cc-by-nc-sa-3.0 cc-by-nc-sa-4.0 cc-by-nd-4.0
cc-by-sa-3.0 cc-by-sa-4.0 cc0-1.0 cdla-permissive-1.0 cdla-permissive-2.0 cdla-sharing-1.0
creativeml-openrail-m deepfloyd-if-license ecl-2.0 epl-1.0 epl-2.0 etalab-2.0 eupl-1.1 eupl-1.2
fair-noncommercial-research-license gemma gfdl gpl gpl-2.0 gpl-3.0 grok2-community h-research
intel-research isc lgpl lgpl-2.1 lgpl-3.0 lgpl-lr llama2 llama3 llama3.1 llama3.2 llama3.3 llama4
lppl-1.3c mit mpl-2.0 ms-pl ncsa odbl odc-by ofl-1.1 openmdw-1.0 openmdw-1.1 openrail openrail++
osl-3.0 other pddl postgresql unknown unlicense wtfpl zlib
"""
LICENSES = frozenset(_LICENSE_IDS.split())
"""Identifiers of licenses that the Hub documents, as of August 2026."""

_VERSION = re.compile(r"(0|[1-9]\d{0,8})\.(0|[1-9]\d{0,8})\.(0|[1-9]\d{0,8})")
_GROUP = "Publishing"


class Version(NamedTuple):
    """A version, such as 1.2.0; versions are ordered."""

    major: int
    minor: int
    patch: int

    @classmethod
    def parse(cls, text: str) -> "Version | None":
        """Read a text such as `1.2.0`; None if it is no version."""
        match = _VERSION.fullmatch(text)
        return cls(*map(int, match.groups())) if match else None

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}.{self.patch}"

    @property
    def tag(self) -> str:
        """The tag of the version in a repository."""
        return f"data-{self}"


def versions_of(tags: Mapping[str, str]) -> dict[Version, str]:
    """Return the versions among tags, in order, with the commit of each."""
    parsed = {tag: Version.parse(tag.removeprefix("data-")) for tag in tags if tag[:5] == "data-"}
    return dict(sorted((version, tags[tag]) for tag, version in parsed.items() if version))


def is_commit(text: object) -> bool:
    """Return whether a value is the hash of a commit: 40 hexadecimal digits."""
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
            hint = "The namespace is your user name or an organization: hf auth whoami"
    expected = (
        "namespace/name of a repository on the Hub, of letters, digits, '-', '_' and '.', at most "
        "96 in the name"
    )
    raise InvalidOptionError.expected(name, repo_id, expected, hint)


@dataclass(frozen=True)
class Publication:
    """A version of a repository, as cards state it; also the settings of `publish-results`.

    Attributes:
        repo_id: The repository, `namespace/name`.
        version: Such as `1.2.0`; None for the published version, or the first. A card needs one.
        license: Identifier of the license on the Hub; `other` for that of the recordings.
        base: What the data was made for, `namespace/name@<40-digit commit>`: the demonstrations
            of a buffer set, the buffer set of results; None if that is not published.
        command: The command that made the data, or None.
    """

    repo_id: str = setting(help="Repository, namespace/name.", group=_GROUP)
    version: str | None = setting(
        None, help="Version, such as 1.0.0.", shown="the published one, or the first", group=_GROUP
    )
    license: str = setting(
        OTHER,
        help="License on the Hub, such as cc-by-4.0; other: the license of the recordings.",
        group=_GROUP,
    )
    base: str | None = None
    command: str | None = None

    def __post_init__(self) -> None:
        check_repo_id(self.repo_id)
        if self.version is not None and Version.parse(self.version) is None:
            expected = "three numbers, such as 1.2.0"
            raise InvalidOptionError.expected("version", self.version, expected)
        if self.license not in LICENSES:
            hint = "All identifiers: https://huggingface.co/docs/hub/repositories-licenses"
            hint = f"{nearest(self.license, LICENSES, more='')}\n{hint}".lstrip()
            expected = f"a license of the Hub, such as cc-by-4.0, or {OTHER}"
            raise InvalidOptionError.expected("license", self.license, expected, hint)
        if self.base is not None:
            repo_id, _, commit = self.base.partition("@")
            if not is_commit(commit):
                expected = "namespace/name@ and the 40 digits of a commit"
                raise InvalidOptionError.expected("base", self.base, expected)
            check_repo_id(repo_id, "base")

    def made_for(self, location: object) -> "Publication":
        """Return the same with `location` as its base, if it has none and that is on the Hub."""
        with suppress(InvalidOptionError):
            if self.base is None and isinstance(location, str):
                return replace(self, base=location)
        return self

    @property
    def requested(self) -> Version | None:
        """The version, or None."""
        return None if self.version is None else Version.parse(self.version)

    @property
    def tag(self) -> str:
        """Tag of the version in the repository."""
        return f"data-{self.version}"

    @property
    def name(self) -> str:
        """Name of the repository in its namespace."""
        return self.repo_id.split("/")[1]


@dataclass(frozen=True)
class PublishConfig(Publication):
    """The settings of `publish`."""

    demonstrations_id: str | None = setting(
        None,
        help="Repository of the demonstrations, unless the manifests name a published one.",
        shown="REPO_ID-demonstrations",
        group=_GROUP,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_repo_id(self.demonstrations, "demonstrations_id")
        if self.repo_id == self.demonstrations_id:
            raise InvalidOptionError(
                f"repo_id and demonstrations_id are both {self.repo_id!r}; expected two "
                "repositories",
                "Choose another demonstrations_id.",
            )

    @property
    def demonstrations(self) -> str:
        """Repository of the demonstrations."""
        return self.demonstrations_id or f"{self.repo_id}-demonstrations"
