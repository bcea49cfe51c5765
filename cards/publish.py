"""Publish a split: its demonstrations, and itself."""

from collections.abc import Iterable
from functools import cached_property
from typing import Any

from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, IDENTITY_PATH
from robomme_interference_data.data.buffer_set import Split
from robomme_interference_data.data.dataset import Dataset
from robomme_interference_data.data.loading import load_split
from robomme_interference_data.errors import PublishError
from robomme_interference_data.storage.hub import HubFiles

from . import render
from .contents import (
    dataset_tree,
    parts_of_buffers,
    parts_of_dataset,
    parts_of_questions,
    split_tree,
)
from .publish_config import PublishConfig
from .publishing import Card, Goods, Parts, Publishing
from .step import Step
from .tree import Tree
from .versions import Version

_UNKNOWN = "0" * 40
"""Stands for the commit of demonstrations that are not published yet."""


def published_base(split: Split, config: PublishConfig) -> str | None:
    """Return the published demonstrations that a split is for, `namespace/name@commit`, or None.

    Raises:
        HubError: They are not there.
        PublishError: They are others.
    """
    recorded = split.header.datasets[DEMONSTRATIONS]
    place, wanted = recorded.place or "", config.demonstrations_id
    if "@" not in place or wanted not in (None, place.split("@")[0]):
        return None
    if Dataset(HubFiles.parse(place)).revision != recorded.revision:
        raise PublishError(
            f"{place} holds other demonstrations than those that {split.location} is for",
            split.mend,
        )
    return place


def demonstrations_of(split: Split, config: PublishConfig) -> Goods:
    """Return what the repository of the demonstrations holds."""
    dataset, repo_id = split.datasets[DEMONSTRATIONS], config.demonstrations

    def card(version: Version) -> dict[str, bytes]:
        return render.demonstrations_files(dataset, config.about(repo_id, str(version)))

    def parts(earlier: HubFiles | None) -> dict[str, str]:
        return parts_of_dataset(Dataset(earlier) if earlier else dataset)

    return _goods(repo_id, dataset, dataset_tree(dataset), card, parts)


def units_of(split: Split, config: PublishConfig, base: str | None) -> Goods:
    """Return what the split's own repository holds: units and manifests."""
    dataset, repo_id = split.datasets[DISTRACTORS], config.repo_id

    def card(version: Version) -> dict[str, bytes]:
        return render.split_files(split, config.about(repo_id, str(version), base))

    def parts(earlier: HubFiles | None) -> dict[str, str]:
        there = load_split(earlier.location) if earlier else split
        found = parts_of_buffers(there.manifests()) | parts_of_questions(there)
        for name, one in there.datasets.items():
            found |= parts_of_dataset(one) if name != DEMONSTRATIONS else {}
        return found

    return _goods(repo_id, dataset, split_tree(split, base), card, parts)


def _goods(repo_id: str, dataset: Dataset, files: Tree, card: Card, parts: Parts) -> Goods:
    first = Version.parse(dataset.identity.version) or Version(1, 0, 0)
    lerobot = str(dataset.lerobot.version)
    return Goods(repo_id, first, files, card, parts, IDENTITY_PATH, lerobot)


class Publisher(Publishing):
    """Publishes a split whose checks have passed; see `Publishing` for the other arguments.

    Args:
        split: The split.
        config: As what.
    """

    def __init__(self, split: Split, config: PublishConfig, **options: Any):
        super().__init__(config, **options)
        self.split = split
        self.config: PublishConfig = config

    @cached_property
    def base(self) -> str | None:
        """See `published_base`."""
        return published_base(self.split, self.config)

    def plan(self) -> list[Step]:
        """Look at what is there; return what is to be done: the demonstrations, then the split.

        Raises:
            PublishError: The version is there already, and is another one; or it does not say how
                much has changed; or a repository holds something else.
            HubError: A repository cannot be reached.
            InterferenceError: The split cannot be read.
        """
        if self.base is not None:
            return [self._split_step(self.base)]
        first = self.step(demonstrations_of(self.split, self.config), follows=True)
        return [first, self._split_step(_place(first))]

    def run(self, steps: Iterable[Step]) -> list[Step]:
        """Do what was planned; return the steps with their commits.

        Raises:
            HubError: The Hub refuses something. The same command goes on where this one stopped.
        """
        *first, last = steps
        done = [self.put(step) for step in first]
        if [*map(_place, done)] != [*map(_place, first)]:
            last = self._split_step(_place(done[0]))
        return [*done, self.put(last)]

    def _split_step(self, base: str) -> Step:
        return self.step(units_of(self.split, self.config, base))


def _place(step: Step) -> str:
    """Return what a split names of its demonstrations: it stays, whatever becomes of their card."""
    return f"{step.repository.repo_id}@{step.same or step.published or _UNKNOWN}"
