"""Publish a split: its demonstrations and itself, each in one commit that a version's tag names.

The tag comes last. What has no tag is no version, whatever an upload that failed has left behind.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from robomme_interference_data.cards import render
from robomme_interference_data.cards.contents import (
    dataset_tree,
    parts_of_buffers,
    parts_of_dataset,
    split_tree,
)
from robomme_interference_data.cards.publish_config import PublishConfig
from robomme_interference_data.cards.step import Step
from robomme_interference_data.cards.tree import Content, Difference, Entry, Tree, beside, compare
from robomme_interference_data.cards.upload import HubRepository, State
from robomme_interference_data.cards.versions import Change, Version, change_between
from robomme_interference_data.constants import DEMONSTRATIONS, DISTRACTORS, IDENTITY_PATH
from robomme_interference_data.dataset import Dataset
from robomme_interference_data.errors import (
    FormatError,
    MissingFileError,
    PublishError,
)
from robomme_interference_data.hub import HubFiles
from robomme_interference_data.loading import load_split
from robomme_interference_data.split import Split

_CARD = (render.README, render.STRIP, render.CROISSANT)
_UNKNOWN = "0" * 40
"""Stands for the commit of demonstrations that are not published yet."""


@dataclass(frozen=True)
class Goods:
    """What is published in one repository.

    Attributes:
        repo_id: The repository.
        dataset: The dataset at its root.
        files: Its files without the card.
        card: Makes the card of a version.
        parts: What each part of it holds, of this or of an earlier version in the repository.
    """

    repo_id: str
    dataset: Dataset
    files: Tree
    card: Callable[[Version], Mapping[str, bytes]]
    parts: Callable[[HubFiles | None], dict[str, str]]

    def tree(self, version: Version) -> Tree:
        """Return all files of a version."""
        return self.files | {path: Content(data) for path, data in self.card(version).items()}

    @property
    def own_version(self) -> Version:
        """The version that the dataset carries."""
        return Version.parse(self.dataset.identity.version) or Version(1, 0, 0)


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
    if Dataset(HubFiles(*place.split("@"))).revision != recorded.revision:
        raise PublishError(
            f"{place} holds other demonstrations than those that {split.location} is for",
            f"Plan the buffers again: robomme-interference build manifests {split.location}",
        )
    return place


def demonstrations_of(split: Split, config: PublishConfig) -> Goods:
    """Return what the repository of the demonstrations holds."""
    dataset, repo_id = split.datasets[DEMONSTRATIONS], config.demonstrations

    def card(version: Version) -> dict[str, bytes]:
        return render.demonstrations_files(dataset, config.about(repo_id, str(version)))

    def parts(earlier: HubFiles | None) -> dict[str, str]:
        return parts_of_dataset(Dataset(earlier) if earlier else dataset)

    return Goods(repo_id, dataset, dataset_tree(dataset), card, parts)


def units_of(split: Split, config: PublishConfig, base: str | None) -> Goods:
    """Return what the split's own repository holds: units and manifests."""
    dataset, repo_id = split.datasets[DISTRACTORS], config.repo_id

    def card(version: Version) -> dict[str, bytes]:
        return render.split_files(split, config.about(repo_id, str(version), base))

    def parts(earlier: HubFiles | None) -> dict[str, str]:
        there = load_split(earlier.describe()) if earlier else split
        units = Dataset(earlier) if earlier else dataset
        return parts_of_dataset(units) | parts_of_buffers(there.manifests())

    return Goods(repo_id, dataset, split_tree(split, base), card, parts)


class Publisher:
    """Publishes a split whose checks have passed.

    Args:
        split: The split.
        config: As what.
        private: Whether repositories that have to be made are private.
        tell: Is told what happens, in a line.
        wait: Waits for so many seconds, while the Hub is busy.
    """

    def __init__(
        self,
        split: Split,
        config: PublishConfig,
        *,
        private: bool = False,
        tell: Callable[[str], object] = lambda _: None,
        wait: Callable[[float], object] = time.sleep,
    ):
        self.split = split
        self.config = config
        self._private = private
        self._tell = tell
        self._wait = wait

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
        first = self._step(demonstrations_of(self.split, self.config), follows=True)
        return [first, self._split_step(_place(first))]

    def check_rights(self, steps: Iterable[Step]) -> None:
        """Check that this login may write to all repositories, as far as that can be known.

        Raises:
            HubError: It may not.
        """
        for step in steps:
            if step.published is None:
                step.repository.check_rights(step.state is not None)

    def run(self, steps: Iterable[Step]) -> list[Step]:
        """Do what was planned; return the steps with their commits.

        Raises:
            HubError: The Hub refuses something. The same command goes on where this one stopped.
        """
        *first, last = steps
        done = [self._put(step) for step in first]
        if done != first:
            last = self._split_step(_place(done[0]))  # which names the commit of what it is for
        return [*done, self._put(last)]

    def _put(self, step: Step) -> Step:
        if step.published is not None:
            return step
        repository, version = step.repository, step.version
        self._tell(f"{repository.repo_id}: sending {len(step.difference.sent):,} files")
        state = step.state or repository.create(self._private)
        commit = repository.commit(step.tree, state.head, f"Version {version}")
        repository.tag(step.lerobot, commit, move=True)
        repository.tag(version.tag, commit)
        self._tell(f"{repository.repo_id}: version {version} is {commit}")
        return replace(step, published=commit)

    def _split_step(self, base: str) -> Step:
        return self._step(units_of(self.split, self.config, base))

    def _step(self, goods: Goods, *, follows: bool = False) -> Step:
        """Return what is to become of a repository.

        Args:
            goods: What it is to hold.
            follows: Its versions count on their own: where its data are as they were, whatever the
                card says, it stays as it is, and otherwise takes the next version that fits.
        """
        repository = HubRepository(goods.repo_id, self._tell, self._wait)
        wanted = self.config.wanted
        state = repository.state()
        there = repository.tree(state.head) if state else {}

        def step(version: Version) -> Step:
            tree, lerobot = goods.tree(version), str(goods.dataset.lerobot.version)
            difference = compare(tree, there)
            return Step(repository, version, tree, state, difference, None, lerobot)

        if state is None or not state.versions:
            _check_ours(repository, there)
            return step(wanted or goods.own_version)
        newest = max(state.versions)
        version = newest if follows or wanted is None else wanted
        found, commit, differs = step(version), state.versions.get(version), None
        if commit is not None:
            held = repository.tree(commit)
            differs = compare(found.tree, held)
            if not differs or (follows and not compare(goods.files, _without_card(held))):
                return replace(found, published=commit, difference=Difference())
        fits = newest.after(self._change(goods, state, newest))
        if follows:
            return step(max(wanted or fits, fits))
        if commit is None and version >= fits:
            return found
        raise PublishError(
            f"{goods.repo_id} has the version {version} already, and it is another one: {differs}"
            if differs
            else f"version {version} of {goods.repo_id} does not say how much has changed since "
            f"{newest}",
            f"The next version that fits: --version {fits}",
        )

    def _change(self, goods: Goods, state: State, version: Version) -> Change:
        try:
            before = goods.parts(HubFiles(goods.repo_id, state.versions[version]))
        except (FormatError, MissingFileError):
            before = {"what cannot be read": ""}
        return change_between(before, goods.parts(None))


def _place(step: Step) -> str:
    return f"{step.repository.repo_id}@{step.published or _UNKNOWN}"


def _without_card(there: Mapping[str, Entry]) -> dict[str, Entry]:
    return {path: entry for path, entry in there.items() if path not in _CARD}


def _check_ours(repository: HubRepository, there: Mapping[str, Entry]) -> None:
    """Check that a repository without versions holds nothing, or what an upload left behind.

    Raises:
        PublishError: It holds something else.
    """
    others = [path for path in there if not beside(path) and path != render.README]
    if others and IDENTITY_PATH not in there:
        raise PublishError(
            f"{repository.repo_id} holds something else, such as {others[0]}",
            f"Give another repository; the files of this one: {repository.page}/tree/main",
        )
