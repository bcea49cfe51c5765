"""The files of a repository: written to a folder, or to the Hub in one commit."""

import hashlib
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from robomme_interference_data.errors import HubError, PublishError
from robomme_interference_data.storage.files import all_files, sha256_file
from robomme_interference_data.storage.hub_call import HubCall
from robomme_interference_data.storage.staging import replace_folder, staging_dir

if TYPE_CHECKING:
    from huggingface_hub.hf_api import RepoFile as RemoteFile


@dataclass(frozen=True)
class LocalFile:
    """Content for a file of a repository: bytes, or a file on this machine."""

    source: bytes | Path

    @cached_property
    def size(self) -> int:
        """Number of bytes."""
        return len(self.source) if isinstance(self.source, bytes) else self.source.stat().st_size

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the bytes: the Hub identifies large files by it."""
        if isinstance(self.source, bytes):
            return hashlib.sha256(self.source).hexdigest()
        return sha256_file(self.source)

    @cached_property
    def git_sha1(self) -> str:
        """SHA-1 of the bytes as git computes it: the Hub identifies small files by it."""
        from huggingface_hub.utils.sha import git_hash

        return str(git_hash(self.read()))

    def read(self) -> bytes:
        """Return the bytes."""
        return self.source if isinstance(self.source, bytes) else self.source.read_bytes()

    def equals(self, remote: "RemoteFile") -> bool:
        """Return whether a file on the Hub has the same content."""
        if self.size != remote.size:
            return False
        if remote.lfs is None:
            return bool(self.git_sha1 == remote.blob_id)
        return bool(self.sha256 == remote.lfs.sha256)


RepoFiles = dict[str, LocalFile]
"""Files for a repository, by path."""


@dataclass(frozen=True)
class Difference:
    """Sorted paths of files to send to a repository, and of files to remove from it."""

    sent: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.sent or self.removed)

    @property
    def paths(self) -> tuple[str, ...]:
        """All of them."""
        return (*self.sent, *self.removed)

    def __str__(self) -> str:
        lists = {"differ": self.sent, "are no longer part of it": self.removed}
        texts = [
            f"{len(paths):,} files {what} (such as {paths[0]})"
            for what, paths in lists.items()
            if paths
        ]
        return ", ".join(texts)


def compare(files: Mapping[str, LocalFile], existing: "Mapping[str, RemoteFile]") -> Difference:
    """Return how a repository has to change to hold `files`; unmanaged files stay."""
    sent = (p for p in files if p not in existing or not files[p].equals(existing[p]))
    removed = (p for p in existing if p not in files and not is_unmanaged(p))
    return Difference(tuple(sorted(sent)), tuple(sorted(removed)))


def is_unmanaged(path: str) -> bool:
    """Return whether a file is left alone: hidden files and the license at the root."""
    name = PurePosixPath(path).parts[0]
    return name.startswith(".") or (name.startswith("LICENSE") and name == path)


def total_size(files: Mapping[str, LocalFile], paths: Iterable[str] | None = None) -> int:
    """Return the total size of all files, or of those at some paths, in bytes."""
    return sum(files[path].size for path in (files if paths is None else paths))


# --- in a folder ---------------------------------------------------------------------------------


def write_folder(files: RepoFiles, out: Path) -> bool:
    """Write files into a new or empty folder, all or none.

    Returns False if the folder already holds exactly these files.
    """
    existing = all_files(out) if out.is_dir() else []
    if existing == sorted(files) and all(
        LocalFile(out / path).sha256 == files[path].sha256 for path in existing
    ):
        return False
    if existing or (out.exists() and not out.is_dir()):
        example = f", such as {existing[0]}" if existing else ""
        message = f"{out} exists and holds something else{example}"
        raise PublishError(message, "Remove it, or choose another folder.")
    out = out.resolve()
    with staging_dir(out) as staging:
        made = staging / "made"
        try:
            shutil.rmtree(made, ignore_errors=True)
            for path, file in files.items():
                (made / path).parent.mkdir(parents=True, exist_ok=True)
                if isinstance(file.source, Path):
                    shutil.copyfile(file.source, made / path)
                else:
                    (made / path).write_bytes(file.source)
            replace_folder(made, out)
        finally:
            shutil.rmtree(made, ignore_errors=True)
    return True


# --- on the Hub ----------------------------------------------------------------------------------


class HubRepository:
    """A dataset repository on the Hub.

    Methods raise a `HubError` if this login lacks the rights or the Hub cannot be reached.
    """

    def __init__(self, repo_id: str):
        from huggingface_hub import HfApi

        self.repo_id = repo_id
        self._api = HfApi()
        self._repo: dict[str, Any] = {"repo_id": repo_id, "repo_type": "dataset"}

    @property
    def page(self) -> str:
        """Address of its page."""
        return HubCall(self.repo_id).page

    def revisions(self) -> dict[str, str] | None:
        """Return the commits of its tags and of `main`; None if this login sees no such name."""
        from huggingface_hub.errors import RepositoryNotFoundError

        try:
            info = self._call(self._api.repo_info, **self._repo)
            refs = self._call(self._api.list_repo_refs, **self._repo)
        except HubError as error:
            if isinstance(error.__cause__, RepositoryNotFoundError):
                return None
            raise
        if info.id != self.repo_id:
            raise HubError(
                f"{self.repo_id} is now called {info.id}", "Use the new name: the old one may go."
            )
        return {tag.name: tag.target_commit for tag in refs.tags} | {"main": str(info.sha)}

    def files(self, revision: str) -> "dict[str, RemoteFile]":
        """Return its files at a revision, by path."""
        from huggingface_hub.hf_api import RepoFile

        # The client reads the list in pages.
        tree = partial(self._api.list_repo_tree, **self._repo, revision=revision, recursive=True)
        entries = self._call(lambda: list(tree()))
        return {entry.path: entry for entry in entries if isinstance(entry, RepoFile)}

    def check_rights(self, exists: bool) -> None:
        """Check as far as possible that this login may write to it."""
        if exists:
            self._call(self._api.auth_check, **self._repo, write=True)
        else:
            self._call(self._api.whoami)

    def create(self, private: bool) -> str:
        """Create it, private or with the default of its owner; return the commit of `main`."""
        self._call(self._api.create_repo, **self._repo, private=private or None, exist_ok=True)
        revisions = self.revisions()
        if revisions is None:
            raise HubError(
                f"{self.repo_id} was created but cannot be found", "Run the same command again."
            )
        return revisions["main"]

    def commit(self, files: RepoFiles, head: str, message: str) -> str:
        """Make the main branch hold exactly these files, in at most one commit; return its hash.

        Large files that an earlier commit or an interrupted one sent are not sent again. It is an
        error if the main branch is no longer at `head`.
        """
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        difference = compare(files, self.files(head))
        if not difference:
            return head
        operations: list[Any] = [CommitOperationDelete(path) for path in difference.removed]
        operations += [CommitOperationAdd(path, files[path].source) for path in difference.sent]
        # With its parent, a commit fails if somebody else's came between the plan and this one.
        options = {"commit_message": message, "parent_commit": head, **self._repo}
        made = self._call(self._api.create_commit, operations=operations, **options)
        if left := compare(files, self.files(made.oid)):
            raise HubError(
                f"{self.repo_id} does not hold what was sent: {left}",
                "Run the same command again: what was sent is kept.",
            )
        return str(made.oid)

    def tag(self, name: str, commit: str, *, move: bool = False) -> None:
        """Tag a commit; `move` takes the tag away from another commit."""
        existing = (self.revisions() or {}).get(name)
        if existing == commit:
            return
        if existing is not None:
            if not move:
                raise HubError(
                    f"the tag {name} of {self.repo_id} already names another commit, {existing}",
                    f"Look at {self.page}/tree/{name}, and publish another version.",
                )
            self._call(self._api.delete_tag, **self._repo, tag=name)
        self._call(self._api.create_tag, **self._repo, tag=name, revision=commit)

    def _call(self, call: Callable[..., Any], **options: Any) -> Any:
        return HubCall(self.repo_id).run(call, **options)
