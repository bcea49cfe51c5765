"""Versions of what is published: which one comes next. Pure."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Self

_TAG = re.compile(r"data-(0|[1-9]\d*)\.(0|[1-9]\d*)\.(0|[1-9]\d*)")


class Change(IntEnum):
    """How much of what was published before has changed."""

    PATCH = 0
    """Only how it is told: card, index."""
    MINOR = 1
    """Something was added; what was there is as it was."""
    MAJOR = 2
    """Something that was there is no more, or is not what it was."""


@dataclass(frozen=True, order=True)
class Version:
    """A version, such as 1.2.0; versions are ordered."""

    major: int
    minor: int
    patch: int

    @classmethod
    def of_tag(cls, tag: str) -> Self | None:
        """Return the version that a tag names; None if it names none."""
        match = _TAG.fullmatch(tag)
        return cls(*map(int, match.groups())) if match else None

    @classmethod
    def parse(cls, text: str) -> Self | None:
        """Return the version that a text such as `1.2.0` names; None if it names none."""
        return cls.of_tag(f"data-{text}")

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}.{self.patch}"

    @property
    def tag(self) -> str:
        """The tag that names it in a repository."""
        return f"data-{self}"

    def after(self, change: Change) -> "Version":
        """Return the version that comes next after such a change."""
        if change is Change.MAJOR:
            return Version(self.major + 1, 0, 0)
        if change is Change.MINOR:
            return Version(self.major, self.minor + 1, 0)
        return Version(self.major, self.minor, self.patch + 1)


def versions_of(tags: Mapping[str, str]) -> dict[Version, str]:
    """Return the versions among tags, in order, with what each tag stands for."""
    found = {Version.of_tag(tag): commit for tag, commit in tags.items()}
    return {version: found[version] for version in sorted(v for v in found if v is not None)}


def change_between(before: Mapping[str, str], now: Mapping[str, str]) -> Change:
    """Return how much has changed, given what each part holds: episodes, buffers."""
    if any(now.get(name) != held for name, held in before.items()):
        return Change.MAJOR
    return Change.MINOR if now.keys() - before.keys() else Change.PATCH
