"""Publish the golden split, or one like it, without the checks and with cards of a line."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest
from support.hub_server import HubServer

from robomme_interference_data import load_split
from robomme_interference_data.build_dataset.manifests import (
    in_folder,
    plan_manifests,
    write_manifests,
)
from robomme_interference_data.cards import render
from robomme_interference_data.cards.publication import Publication
from robomme_interference_data.cards.publish import Publisher
from robomme_interference_data.cards.publish_config import PublishConfig
from robomme_interference_data.cards.step import Step

UNITS, LESSONS = "someone/tiny", "someone/tiny-demonstrations"


def plain_cards(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let cards tell only as what something is published: pictures take a second each."""

    def card(_: Any, about: Publication) -> dict[str, bytes]:
        text = f"---\nlicense: {about.license}\n---\n{about}\n"
        picture, machines = about.repo_id.encode(), b"{}"
        return {
            "README.md": text.encode(),
            "README-strip.png": picture,
            "croissant.json": machines,
        }

    for name in ("demonstrations_files", "split_files"):
        monkeypatch.setattr(render, name, card)


def publisher(
    root: Path, repo_id: str = UNITS, waits: list[float] | None = None, **options: Any
) -> Publisher:
    """Return what publishes a split; it waits by writing down for how long."""
    wait = [] if waits is None else waits
    private = options.pop("private", False)
    config = PublishConfig(repo_id, **options)
    return Publisher(load_split(root), config, private=private, wait=wait.append)


def publish(root: Path, repo_id: str = UNITS, **options: Any) -> list[Step]:
    """Publish a split; return what became of its repositories."""
    own = publisher(root, repo_id, **options)
    steps = own.plan()
    own.check_rights(steps)
    return own.run(steps)


def plan_again(root: Path, conditions: Iterable[str], seed: int = 0) -> None:
    """Plan the buffers of a split anew."""
    for _ in write_manifests(plan_manifests(in_folder(root), tuple(conditions), seed), root):
        pass


def tags(hub: HubServer, repo_id: str) -> dict[str, str]:
    """Return the tags of a repository; none if it is not there."""
    found = hub.repositories.get(f"datasets/{repo_id}")
    return dict(found.tags) if found else {}


def files(hub: HubServer, repo_id: str, revision: str = "main") -> dict[str, bytes]:
    """Return the files of a repository but the Hub's own."""
    found = hub.repositories[f"datasets/{repo_id}"].find(revision).files
    return {path: one.data for path, one in sorted(found.items()) if path != ".gitattributes"}
