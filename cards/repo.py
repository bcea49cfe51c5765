"""The files of a repository: in a folder, or on the Hub in one commit and a tag."""

import hashlib
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from robomme_interference_data.constants import (
    DEMONSTRATIONS,
    INDEX_DIR,
    OPTIONAL_DATASETS,
    PARTS_PATH,
    QUESTIONS_PATH,
)
from robomme_interference_data.errors import HubError, PublishError
from robomme_interference_data.storage.files import all_files, sha256_file
from robomme_interference_data.storage.hub import HubCall
from robomme_interference_data.storage.staging import replace_folder, staging_dir

if TYPE_CHECKING:
    from huggingface_hub.hf_api import RepoFile as RemoteFile

_ROOTS = ("data", "videos", INDEX_DIR, DEMONSTRATIONS, QUESTIONS_PATH, *OPTIONAL_DATASETS)
"""What one version has at its root and another may not have, beside the files that all have."""


@dataclass(frozen=True)
class LocalFile:
    """What a file of a repository is to hold: bytes, or a file on this machine that holds them."""

    source: bytes | Path

    @cached_property
    def size(self) -> int:
        """Number of bytes."""
        return len(self.source) if isinstance(self.source, bytes) else self.source.stat().st_size

    @cached_property
    def sha256(self) -> str:
        """SHA-256 of the bytes: by it the Hub knows large files."""
        if isinstance(self.source, bytes):
            return hashlib.sha256(self.source).hexdigest()
        return sha256_file(self.source)

    @cached_property
    def git_sha1(self) -> str:
        """SHA-1 of the bytes as git computes it: by it the Hub knows small files."""
        from huggingface_hub.utils.sha import git_hash

        return str(git_hash(self.read()))

    def read(self) -> bytes:
        """Return the bytes."""
        return self.source if isinstance(self.source, bytes) else self.source.read_bytes()

    def equals(self, remote: "RemoteFile") -> bool:
        """Tell whether a file on the Hub holds the same."""
        if self.size != remote.size:
            return False
        if remote.lfs is None:
            return bool(self.git_sha1 == remote.blob_id)
        return bool(self.sha256 == remote.lfs.sha256)


RepoFiles = dict[str, LocalFile]
"""What a repository is to hold, by path."""


@dataclass(frozen=True)
class Difference:
    """How what a repository is to hold differs from what it holds: sorted paths."""

    added: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()
    removed: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.added or self.changed or self.removed)

    @property
    def sent(self) -> tuple[str, ...]:
        """Paths that have to be sent."""
        return (*self.added, *self.changed)

    def __str__(self) -> str:
        named = {what: paths for what, paths in vars(self).items() if paths}
        parts = (f"{len(paths):,} {what} (such as {paths[0]})" for what, paths in named.items())
        return ", ".join(parts) or "no difference"


def compare(files: Mapping[str, LocalFile], existing: "Mapping[str, RemoteFile]") -> Difference:
    """Return how files differ from those of a repository; unmanaged ones are left alone."""
    both = sorted(files.keys() & existing.keys())
    gone = existing.keys() - files.keys()
    return Difference(
        added=tuple(sorted(files.keys() - existing.keys())),
        changed=tuple(path for path in both if not files[path].equals(existing[path])),
        removed=tuple(sorted(path for path in gone if not is_unmanaged(path))),
    )


def is_unmanaged(path: str) -> bool:
    """Tell whether a file is the Hub's or its owner's: hidden files, and a license."""
    name = PurePosixPath(path).parts[0]
    return name.startswith(".") or (name.startswith("LICENSE") and name == path)


def total_size(files: Mapping[str, LocalFile], paths: Iterable[str] | None = None) -> int:
    """Return the bytes of all files, or of those at some paths."""
    return sum(files[path].size for path in (files if paths is None else paths))


# --- in a folder ---------------------------------------------------------------------------------


def write_folder(files: RepoFiles, out: Path) -> bool:
    """Write files into a folder, all of them or none; an earlier version there is replaced.

    Returns:
        Whether it was written: False if all of it was there.
    """
    existing = all_files(out) if out.is_dir() else []
    known = {*_ROOTS, *(path.split("/")[0] for path in files)}
    others = [path for path in existing if path.split("/")[0] not in known]
    if others or (existing and PARTS_PATH not in existing) or (out.exists() and not out.is_dir()):
        found = f", but {others[0]}" if others else ""
        message = f"{out} exists, and is nothing that was exported{found}"
        raise PublishError(message, "Give another folder.")
    if existing == sorted(files) and all(
        LocalFile(out / path).sha256 == files[path].sha256 for path in existing
    ):
        return False
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


@dataclass(frozen=True)
class RepoState:
    """What a repository holds: the commit of its main branch, and that of each tag."""

    head: str
    tags: dict[str, str]


class HubRepository:
    """A dataset repository on the Hub.

    Every method raises a `HubError` where this login may not do it or the Hub cannot be reached.

    Args:
        repo_id: `namespace/name`.
    """

    def __init__(self, repo_id: str):
        from huggingface_hub import HfApi

        self.repo_id = repo_id
        self._api = HfApi()
        self._of: dict[str, Any] = {"repo_id": repo_id, "repo_type": "dataset"}

    @property
    def page(self) -> str:
        """Address of its page."""
        return HubCall(self.repo_id).page

    def state(self) -> RepoState | None:
        """Return what it holds; None if there is none of this name that this login may see."""
        from huggingface_hub.errors import RepositoryNotFoundError

        try:
            info = self._call(self._api.repo_info, **self._of)
            refs = self._call(self._api.list_repo_refs, **self._of)
        except HubError as error:
            if isinstance(error.__cause__, RepositoryNotFoundError):
                return None
            raise
        if info.id != self.repo_id:
            raise HubError(
                f"{self.repo_id} is now called {info.id}", "Give that name: the old one may go."
            )
        return RepoState(str(info.sha), {tag.name: tag.target_commit for tag in refs.tags})

    def files(self, revision: str) -> "dict[str, RemoteFile]":
        """Return its files at a revision, by path."""
        from huggingface_hub.hf_api import RepoFile

        listed = self._call(
            lambda: list(
                self._api.list_repo_tree(**self._of, revision=revision, recursive=True)  # in pages
            )
        )
        return {one.path: one for one in listed if isinstance(one, RepoFile)}

    def check_rights(self, exists: bool) -> None:
        """Check that somebody is logged in who may write to it, as far as that can be known."""
        if exists:
            self._call(self._api.auth_check, **self._of, write=True)
        else:
            self._call(self._api.whoami)

    def create(self, private: bool) -> RepoState:
        """Create it, private or as its owner's are; return what it holds then."""
        self._call(self._api.create_repo, **self._of, private=private or None, exist_ok=True)
        state = self.state()
        if state is None:
            raise HubError(
                f"{self.repo_id} was created, and is not there", "Run the same command again."
            )
        return state

    def commit(self, files: RepoFiles, head: str, message: str) -> str:
        """Make the main branch hold exactly these files, in one commit at most; return its hash.

        What is there already is not sent again, be it in a commit or left by one that failed.

        Args:
            files: All files that it is to hold.
            head: The commit that this one follows: another one by now is an error.
            message: Title of the commit.
        """
        from huggingface_hub import CommitOperationAdd, CommitOperationDelete

        difference = compare(files, self.files(head))
        if not difference:
            return head
        operations: list[Any] = [CommitOperationDelete(path) for path in difference.removed]
        operations += [CommitOperationAdd(path, files[path].source) for path in difference.sent]
        options = {"commit_message": message, "parent_commit": head, **self._of}
        made = self._call(self._api.create_commit, operations=operations, **options)
        if left := compare(files, self.files(made.oid)):
            raise HubError(
                f"{self.repo_id} does not hold what was sent: {left}",
                "What was sent is kept: run the same command again.",
            )
        return str(made.oid)

    def tag(self, name: str, commit: str, *, move: bool = False) -> None:
        """Make a tag stand for a commit; `move` takes it away from another one."""
        state = self.state()
        existing = state.tags.get(name) if state else None
        if existing not in (None, commit):
            if not move:
                raise HubError(
                    f"the tag {name} of {self.repo_id} stands for another commit, {existing}",
                    f"Somebody else made it. Look at {self.page}/tree/{name}, and publish another "
                    "version.",
                )
            self._call(self._api.delete_tag, **self._of, tag=name)
        if existing != commit:
            self._call(self._api.create_tag, **self._of, tag=name, revision=commit)

    def _call(self, call: Callable[..., Any], **options: Any) -> Any:
        return HubCall(self.repo_id).run(call, **options)
