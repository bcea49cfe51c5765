"""A repository on the Hub that is written to: one commit at a time, then tags."""

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.errors import HubError
from robomme_interference_data.storage.hub_errors import HubCall, busy_for

from .tree import Difference, Entry, Tree, compare
from .versions import Version, versions_of

_TRIES = 5
_AT_ONCE = 16
"""Files that are sent at a time: most are small, and wait for answers."""
_LONGEST_WAIT = 330
"""Seconds; the Hub counts requests in windows of five minutes."""


@dataclass(frozen=True)
class State:
    """What a repository holds.

    Attributes:
        head: Commit of its main branch.
        tags: What each tag stands for.
    """

    head: str
    tags: dict[str, str]

    @property
    def versions(self) -> dict[Version, str]:
        """The published versions, in order, and their commits."""
        return versions_of(self.tags)


class HubRepository:
    """A dataset repository on the Hub.

    Args:
        repo_id: `namespace/name`.
        tell: Is told, in a line, why something takes long.
        wait: Waits for so many seconds.

    Raises:
        HubError: By every method: this login may not do it, or the Hub cannot be reached.
    """

    def __init__(
        self,
        repo_id: str,
        tell: Callable[[str], object] = lambda _: None,
        wait: Callable[[float], object] = time.sleep,
    ):
        from huggingface_hub import HfApi

        self.repo_id = repo_id
        self._api = HfApi()
        self._tell = tell
        self._wait = wait
        self._of: dict[str, Any] = {"repo_id": repo_id, "repo_type": "dataset"}

    @property
    def page(self) -> str:
        """Address of its page."""
        return HubCall(self.repo_id).page

    def state(self) -> State | None:
        """Return what it holds; None if there is none of this name that this login may see.

        Raises:
            HubError: It has another name now.
        """
        from huggingface_hub.errors import RepositoryNotFoundError

        try:
            info = self._ask(self._api.repo_info, **self._of)
            refs = self._ask(self._api.list_repo_refs, **self._of)
        except HubError as error:
            if isinstance(error.__cause__, RepositoryNotFoundError):
                return None
            raise
        if info.id != self.repo_id:
            raise HubError(
                f"{self.repo_id} is now called {info.id}", "Give that name: the old one may go."
            )
        return State(str(info.sha), {tag.name: tag.target_commit for tag in refs.tags})

    def tree(self, revision: str) -> dict[str, Entry]:
        """Return its files at a revision, by path."""
        listed = self._ask(
            lambda: list(
                self._api.list_repo_tree(**self._of, revision=revision, recursive=True)  # in pages
            )
        )
        return {
            one.path: Entry(one.size, one.blob_id, one.lfs and one.lfs.sha256)
            for one in listed
            if hasattr(one, "blob_id")  # a folder has none
        }

    def check_rights(self, there: bool) -> None:
        """Check that somebody is logged in who may write to it, as far as that can be known."""
        if there:
            self._ask(self._api.auth_check, **self._of, write=True)
        else:
            self._ask(self._api.whoami)

    def create(self, private: bool) -> State:
        """Make it if it is not there, private or as its owner's are; return what it holds then."""
        refused = None
        try:
            self._ask(self._api.create_repo, **self._of, private=private or None, exist_ok=True)
        except HubError as error:
            refused = error
        state = self.state()  # it may be there all the same: the answer may have been lost
        if state is None:
            raise refused or HubError(
                f"{self.repo_id} was made, and is not there", "Run the same command again."
            )
        return state

    def commit(self, tree: Tree, head: str, message: str) -> str:
        """Let the main branch hold exactly a tree, in one commit at most; return its hash.

        What is there already is not sent again, be it in a commit or left by one that failed.

        Args:
            tree: All files that it is to hold.
            head: The commit that this one follows: if there is another one by now, this fails.
            message: Title of the commit.

        Raises:
            HubError: Somebody else wrote to it; or what it holds afterwards is not the tree.
        """
        difference = compare(tree, self.tree(head))
        if not difference:
            return head
        try:
            made = self._commit(tree, difference, head, message)
        except HubError:
            now = self._committed(tree)  # the answer may have been lost
            if now is None:
                raise
            return now
        left = compare(tree, self.tree(made))
        if left:
            raise HubError(
                f"{self.repo_id} does not hold what was sent: {left}",
                "What was sent is kept: run the same command again.",
            )
        return made

    def _commit(self, tree: Tree, difference: Difference, head: str, message: str) -> str:
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        operations: list[Any] = [CommitOperationDelete(path) for path in difference.removed]
        for path in difference.sent:
            added = CommitOperationAdd(path, tree[path].source)
            added.upload_info.sha256 = bytes.fromhex(tree[path].sha256)
            operations.append(added)
        options = {"commit_message": message, "parent_commit": head}
        return str(
            self._ask(
                self._api.create_commit, sends=True, operations=operations, **self._of, **options
            ).oid
        )

    def _committed(self, tree: Tree) -> str | None:
        """Return the commit of the main branch if it holds a tree."""
        with suppress(HubError):
            state = self.state()
            if state is not None and not compare(tree, self.tree(state.head)):
                return state.head
        return None

    def tag(self, name: str, commit: str, *, move: bool = False) -> None:
        """Let a tag stand for a commit.

        Args:
            name: The tag.
            commit: The commit.
            move: Take it away from another commit.

        Raises:
            HubError: It stands for another commit, and is not to be moved.
        """
        found = self._tags().get(name)
        if found is not None and found != commit and move:
            self._ask(self._api.delete_tag, **self._of, tag=name)
            found = None
        if found is None:
            try:
                self._ask(self._api.create_tag, **self._of, tag=name, revision=commit)
                return
            except HubError:
                found = self._tags().get(name)  # the answer was lost, or somebody else came first
                if found is None:
                    raise
        if found != commit:
            raise HubError(
                f"the tag {name} of {self.repo_id} stands for another commit, {found}",
                f"Somebody else made it. Look at {self.page}/tree/{name}, and publish your split "
                "as another version.",
            )

    def _tags(self) -> dict[str, str]:
        state = self.state()
        return state.tags if state else {}

    # --- asking ----------------------------------------------------------------------------------

    def _ask(self, call: Callable[..., Any], *, sends: bool = False, **options: Any) -> Any:
        """Call the client; wait and call again while the Hub is busy."""
        about = HubCall(self.repo_id, sends=sends)
        for _ in range(_TRIES - 1):
            try:
                return about.run(call, **options)
            except HubError as error:
                seconds = busy_for(error)
                if seconds is None or seconds > _LONGEST_WAIT:
                    raise
            self._tell(f"The Hub is busy: trying again in {seconds:.0f} s")
            self._wait(seconds)
        return about.run(call, **options)
