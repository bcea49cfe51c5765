"""Publish the golden buffer set, or one like it, without the checks and with cards of a line."""

from pathlib import Path
from typing import Any

import pytest
from support.hub_server import HubServer

from robomme_interference_data import load_buffer_set
from robomme_interference_data.cards import buffer_set_content
from robomme_interference_data.cards.buffer_set_content import (
    BufferSetContent,
    plan_buffer_set,
    publish_buffer_set,
)
from robomme_interference_data.cards.facts import Facts
from robomme_interference_data.cards.publication import Publication, PublishConfig
from robomme_interference_data.cards.repo_plan import RepoPlan, check_rights

UNITS, LESSONS = "someone/tiny", "someone/tiny-demonstrations"


def plain_cards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace cards by ones that state only as what something is published: pictures are slow."""

    def card(_: Facts, about: Publication) -> dict[str, bytes]:
        text = f"---\nlicense: {about.license}\n---\n{about}\n"
        return {"README.md": text.encode(), "README-strip.png": about.repo_id.encode()}

    monkeypatch.setattr(buffer_set_content, "card_files", card)


def content_of(root: Path, repo_id: str = UNITS, **options: Any) -> BufferSetContent:
    """Return what the repositories of a buffer set are to hold."""
    return BufferSetContent(load_buffer_set(root), PublishConfig(repo_id, **options))


def plan(
    root: Path, repo_id: str = UNITS, **options: Any
) -> tuple[BufferSetContent, list[RepoPlan]]:
    """Plan to publish a buffer set."""
    content = content_of(root, repo_id, **options)
    return content, plan_buffer_set(content)


def publish(
    root: Path, repo_id: str = UNITS, private: bool = False, **options: Any
) -> list[RepoPlan]:
    """Publish a buffer set; return what became of its repositories."""
    content, plans = plan(root, repo_id, **options)
    check_rights(plans)
    return publish_buffer_set(content, plans, private=private)


def tags(hub: HubServer, repo_id: str) -> dict[str, str]:
    """Return the tags of a repository; none if it does not exist."""
    repository = hub.repositories.get(f"datasets/{repo_id}")
    return dict(repository.tags) if repository else {}


def files(hub: HubServer, repo_id: str, revision: str = "main") -> dict[str, bytes]:
    """Return the files of a repository but the Hub's own."""
    found = hub.repositories[f"datasets/{repo_id}"].find(revision).files
    return {path: one.data for path, one in sorted(found.items()) if path != ".gitattributes"}


def writes(hub: HubServer) -> list[str]:
    """Return the requests that change the Hub."""
    return [one for one in hub.requests if not one.startswith(("GET", "HEAD"))]
