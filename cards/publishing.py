"""What every publication is: a repository gets a version in one commit, and a tag that names it.

The tag comes last. What has no tag is no version, whatever an upload that failed has left behind.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache

from robomme_interference_data.errors import FormatError, MissingFileError, PublishError
from robomme_interference_data.storage.hub import HubFiles

from . import render
from .publish_config import VersionConfig
from .step import Step
from .tree import Content, Difference, Entry, Tree, beside, compare
from .upload import HubRepository
from .versions import Change, Version, change_between

Card = Callable[[Version], Mapping[str, bytes]]
"""Makes the card of a version: bytes by path."""

Parts = Callable[[HubFiles | None], dict[str, str]]
"""What each part of a repository holds, of this version or of an earlier one there."""


@dataclass(frozen=True)
class Goods:
    """What is published in one repository.

    Attributes:
        repo_id: The repository.
        first: The version that it has if it has none yet and none is asked for.
        files: Its files without the card.
        card: Makes the card of a version.
        parts: What each part of it holds, of this or of an earlier version in the repository.
        sign: A file that tells such a repository from others.
        lerobot: Tag by which LeRobot finds a dataset of its format, such as `v3.0`; None if it is
            no dataset of LeRobot.
    """

    repo_id: str
    first: Version
    files: Tree
    card: Card
    parts: Parts
    sign: str
    lerobot: str | None = None

    def tree(self, version: Version) -> Tree:
        """Return all files of a version."""
        return self.files | {path: Content(data) for path, data in self.card(version).items()}


class Publishing:
    """Gives repositories their versions.

    Args:
        config: As what something is published.
        private: Whether repositories that have to be made are private.
        tell: Is told what happens, in a line.
        wait: Waits for so many seconds, while the Hub is busy.
    """

    def __init__(
        self,
        config: VersionConfig,
        *,
        private: bool = False,
        tell: Callable[[str], object] = lambda _: None,
        wait: Callable[[float], object] = time.sleep,
    ):
        self.config = config
        self._private = private
        self._tell = tell
        self._wait = wait

    def check_rights(self, steps: Iterable[Step]) -> None:
        """Check that this login may write to all repositories, as far as that can be known.

        Raises:
            HubError: It may not.
        """
        for step in steps:
            if step.published is None:
                step.repository.check_rights(step.state is not None)

    def put(self, step: Step) -> Step:
        """Do what was planned for a repository; return the step with its commit.

        Raises:
            HubError: The Hub refuses something. The same command goes on where this one stopped.
        """
        if step.published is not None:
            return step
        repository, version = step.repository, step.version
        self._tell(f"{repository.repo_id}: sending {len(step.difference.sent):,} files")
        state = step.state or repository.create(self._private)
        commit = repository.commit(step.tree, state.head, f"Version {version}")
        if step.lerobot is not None:
            repository.tag(step.lerobot, commit, move=True)
        repository.tag(version.tag, commit)
        self._tell(f"{repository.repo_id}: version {version} is {commit}")
        return replace(step, published=commit)

    def step(self, goods: Goods, *, follows: bool = False) -> Step:
        """Look at what is there; return what is to become of a repository.

        Args:
            goods: What it is to hold.
            follows: Its versions count on their own: if it has changed it takes the next one that
                fits, whatever version is asked for.

        Raises:
            PublishError: The version is there already, and is another one; or it does not say how
                much has changed; or the repository holds something else.
            HubError: It cannot be reached.
        """
        repository = HubRepository(goods.repo_id, self._tell, self._wait)
        wanted = self.config.wanted
        state = repository.state()
        held = cache(repository.tree)  # what a commit holds never changes
        there = held(state.head) if state else {}
        versions = state.versions if state else {}
        same = None
        for earlier in reversed(versions.values() if follows else ()):
            if compare(goods.files, _without_card(held(earlier))):
                break
            same = earlier

        def step(version: Version) -> Step:
            tree = goods.tree(version)
            differs = compare(tree, there)
            return Step(repository, version, tree, state, differs, None, goods.lerobot, same)

        if not versions:
            _check_ours(goods, repository, there)
            return step(wanted or goods.first)
        newest = max(versions)
        version = newest if follows or wanted is None else wanted
        found, commit, differs = step(version), versions.get(version), None
        if commit is not None:
            differs = compare(found.tree, held(commit))
            if not differs:
                return replace(found, published=commit, difference=Difference())
        fits = newest.after(_change(goods, versions[newest]))
        if follows:
            return step(fits)
        if commit is None and version >= fits:
            return found
        raise PublishError(
            f"{goods.repo_id} has the version {version} already, and it is another one: {differs}"
            if differs
            else f"version {version} of {goods.repo_id} does not say how much has changed since "
            f"{newest}",
            f"The next version that fits: --version {fits}",
        )


def _change(goods: Goods, earlier: str) -> Change:
    """Return how much has changed since a commit."""
    try:
        before = goods.parts(HubFiles(goods.repo_id, earlier))
    except (FormatError, MissingFileError):
        before = {"what cannot be read": ""}
    return change_between(before, goods.parts(None))


def _without_card(there: Mapping[str, Entry]) -> dict[str, Entry]:
    return {
        path: entry
        for path, entry in there.items()
        if path not in (render.README, render.STRIP, render.CROISSANT)
    }


def _check_ours(goods: Goods, repository: HubRepository, there: Mapping[str, Entry]) -> None:
    """Check that a repository without versions holds nothing, or what an upload left behind.

    Raises:
        PublishError: It holds something else.
    """
    others = [path for path in there if not beside(path) and path != render.README]
    if others and goods.sign not in there:
        raise PublishError(
            f"{repository.repo_id} holds something else, such as {others[0]}",
            f"Give another repository; the files of this one: {repository.page}/tree/main",
        )
