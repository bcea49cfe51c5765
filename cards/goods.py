"""What is published: the files of one repository, its card, and how much it differs from before."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from robomme_interference_data.cards import render
from robomme_interference_data.cards.contents import (
    dataset_tree,
    parts_of_buffers,
    parts_of_dataset,
    split_tree,
)
from robomme_interference_data.cards.publish_config import PublishConfig
from robomme_interference_data.cards.tree import Content, Tree
from robomme_interference_data.cards.versions import Version
from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, IDENTITY_PATH
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.hub import HubFiles
from robomme_interference_data.loading import load_split
from robomme_interference_data.split import Split

CARD = (render.README, render.STRIP, render.CROISSANT)
"""Files of a card."""


@dataclass(frozen=True)
class Goods:
    """What is published in one repository.

    Attributes:
        repo_id: The repository.
        files: Its files without the card.
        card: Makes the card of a version.
        parts: What each part of it holds, such as an episode, by name: of this, or of an earlier
            version that is published.
        first: Version that it has if it is the first one.
        lerobot: Tag by which LeRobot finds a dataset of its format, such as `v3.0`; or None.
        marker: A file by which a repository of such goods is known.
    """

    repo_id: str
    files: Tree
    card: Callable[[Version], Mapping[str, bytes]]
    parts: Callable[[HubFiles | None], dict[str, str]]
    first: Version
    lerobot: str | None
    marker: str

    def tree(self, version: Version) -> Tree:
        """Return all files of a version."""
        return self.files | {path: Content(data) for path, data in self.card(version).items()}


def demonstrations_of(split: Split, config: PublishConfig) -> Goods:
    """Return what the repository of the demonstrations holds.

    Raises:
        InterferenceError: They cannot be read.
    """
    dataset, repo_id = split.datasets[DEMONSTRATIONS], config.demonstrations

    def card(version: Version) -> dict[str, bytes]:
        return render.demonstrations_files(dataset, config.about(repo_id, str(version)))

    def parts(earlier: HubFiles | None) -> dict[str, str]:
        return parts_of_dataset(Dataset(earlier) if earlier else dataset)

    return _of_dataset(repo_id, dataset, dataset_tree(dataset), card, parts)


def units_of(split: Split, config: PublishConfig, base: str | None) -> Goods:
    """Return what the split's own repository holds: units and manifests.

    Args:
        split: The split.
        config: As what it is published.
        base: Where its demonstrations lie, `namespace/name@commit`; None for a folder beside.

    Raises:
        InterferenceError: They cannot be read.
    """
    dataset, repo_id = split.datasets[DISTRACTORS], config.repo_id

    def card(version: Version) -> dict[str, bytes]:
        return render.split_files(split, config.about(repo_id, str(version), base))

    def parts(earlier: HubFiles | None) -> dict[str, str]:
        there = load_split(earlier.describe()) if earlier else split
        units = Dataset(earlier) if earlier else dataset
        return parts_of_dataset(units) | parts_of_buffers(there.manifests())

    return _of_dataset(repo_id, dataset, split_tree(split, base), card, parts)


def _of_dataset(
    repo_id: str,
    dataset: Dataset,
    files: Tree,
    card: Callable[[Version], Mapping[str, bytes]],
    parts: Callable[[HubFiles | None], dict[str, str]],
) -> Goods:
    first = Version.parse(dataset.identity.version) or Version(1, 0, 0)
    lerobot = str(dataset.lerobot.version)
    return Goods(repo_id, files, card, parts, first, lerobot, IDENTITY_PATH)
