"""Make a version of a repository: one commit, compared when it has arrived, and its tag last.

What has no tag is no version, whatever an upload that failed has left behind.
"""

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

from robomme_interference_data.cards.goods import CARD, Goods
from robomme_interference_data.cards.step import Step
from robomme_interference_data.cards.tree import Difference, Entry, beside, compare
from robomme_interference_data.cards.upload import HubRepository, State
from robomme_interference_data.cards.versions import Change, Version, change_between
from robomme_interference_data.errors import FormatError, MissingFileError, PublishError
from robomme_interference_data.hub import HubFiles


class Publisher:
    """Looks at what is there, and makes versions.

    Args:
        wanted: Version that is asked for; None for the published one, or the first.
        private: Whether repositories that have to be made are private.
        tell: Is told what happens, in a line.
        wait: Waits for so many seconds, while the Hub is busy.
    """

    def __init__(
        self,
        wanted: Version | None = None,
        *,
        private: bool = False,
        tell: Callable[[str], object] = lambda _: None,
        wait: Callable[[float], object] = time.sleep,
    ):
        self._wanted = wanted
        self._private = private
        self._tell = tell
        self._wait = wait

    def step(self, goods: Goods, *, follows: bool = False) -> Step:
        """Return what is to become of a repository; nothing is written.

        Args:
            goods: What it is to hold.
            follows: Its versions count on their own: where its data are as they were, whatever the
                card says, it stays as it is, and otherwise takes the next version that fits.

        Raises:
            PublishError: The version is there already, and is another one; or it does not say how
                much has changed; or the repository holds something else.
            HubError: The repository cannot be reached.
            InterferenceError: The card cannot be made.
        """
        repository, wanted = HubRepository(goods.repo_id, self._tell, self._wait), self._wanted
        state = repository.state()
        there = repository.tree(state.head) if state else {}

        def step(version: Version) -> Step:
            tree = goods.tree(version)
            difference = compare(tree, there)
            return Step(repository, version, tree, state, difference, None, goods.lerobot)

        if state is None or not state.versions:
            _check_ours(repository, there, goods.marker)
            return step(wanted or goods.first)
        newest = max(state.versions)
        version = newest if follows or wanted is None else wanted
        found, commit, differs = step(version), state.versions.get(version), None
        if commit is not None:
            held = repository.tree(commit)
            differs = compare(found.tree, held)
            if not differs or (follows and not compare(goods.files, _without_card(held))):
                return replace(found, published=commit, difference=Difference())
        fits = newest.after(_change(goods, state, newest))
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

    def check_rights(self, steps: Iterable[Step]) -> None:
        """Check that this login may write to all repositories, as far as that can be known.

        Raises:
            HubError: It may not.
        """
        for step in steps:
            if step.published is None:
                step.repository.check_rights(step.state is not None)

    def put(self, step: Step) -> Step:
        """Make a version, if it is not there; return the step with its commit.

        Raises:
            HubError: The Hub refuses something. The same goes on where this stopped.
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


def _change(goods: Goods, state: State, version: Version) -> Change:
    """Return how much goods differ from an earlier version of them."""
    try:
        before = goods.parts(HubFiles(goods.repo_id, state.versions[version]))
    except (FormatError, MissingFileError):
        before = {"what cannot be read": ""}
    return change_between(before, goods.parts(None))


def _without_card(there: Mapping[str, Entry]) -> dict[str, Entry]:
    return {path: entry for path, entry in there.items() if path not in CARD}


def _check_ours(repository: HubRepository, there: Mapping[str, Entry], marker: str) -> None:
    """Check that a repository without versions holds nothing, or what an upload left behind.

    Raises:
        PublishError: It holds something else.
    """
    others = [path for path in there if not beside(path) and path not in CARD]
    if others and marker not in there:
        raise PublishError(
            f"{repository.repo_id} holds something else, such as {others[0]}",
            f"Give another repository; the files of this one: {repository.page}/tree/main",
        )
