"""Reach repositories on the Hugging Face Hub, pinned to one commit: datasets, policies, encoders.

The stock client does the work, so its own settings hold (`HF_ENDPOINT`, `HF_HUB_OFFLINE`,
`HF_HOME`, `HF_HUB_CACHE`, `HF_TOKEN`), and its cache is the only one.
"""

import os
import re
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, cached_property, partial
from hashlib import sha1
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import (
    HashMismatchError,
    InvalidOptionError,
)

from .files import LocalFiles, all_files, check_relative, sha256_file
from .hub_errors import Asked, check_endpoint

_REPO_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_VERSION = re.compile(r"data-\d+\.\d+\.\d+")
_AT_ONCE = 8


def locate(
    location: str | os.PathLike[str], repo_type: str = "dataset", revision: str | None = None
) -> "LocalFiles | HubFiles":
    """Return the files at a location.

    Args:
        location: A folder, or a repository on the Hub: `namespace/name`, or with a branch, tag or
            commit `namespace/name@revision`. A folder that is there goes before a repository.
        repo_type: `dataset` or `model`.
        revision: The branch, tag or commit, if not in `location`.

    Raises:
        InvalidOptionError: It is neither, or a folder with a revision.
    """
    folder = Path(location).expanduser()
    if folder.is_dir():
        if revision is not None:
            raise InvalidOptionError(
                f"revision {revision!r} of the folder {folder}; only a repository has revisions",
                "Leave it out, or give namespace/name instead of the folder.",
            )
        return LocalFiles(folder)
    repo_id, at, named = str(location).partition("@")
    if at and revision is not None and named != revision:
        raise InvalidOptionError(
            f"{str(location)!r} and revision {revision!r}", "Give the revision once."
        )
    revision = named or revision
    if not _REPO_ID.fullmatch(repo_id) or (at and not named):
        raise InvalidOptionError(
            f"{str(location)!r} is neither a folder nor a {repo_type} repository on the Hub",
            "Give an existing folder, namespace/name, or namespace/name@revision.",
        )
    return HubFiles(repo_id, revision or None, repo_type)


class HubFiles:
    """Files of a repository at one commit, downloaded into the Hub's cache when asked for.

    The revision is resolved once, at the first use; copies made after that (worker processes get
    one each) keep the commit. Offline, it is what the revision last stood for; and so it always is
    for a version's tag, `data-1.0.0`: a published version never changes.

    Args:
        repo_id: Repository, `namespace/name`.
        revision: Branch, tag or commit hash; None for the main branch.
        repo_type: `dataset` or `model`.

    Raises:
        InvalidOptionError: `HF_ENDPOINT` is no address.
    """

    folder = ""

    def __init__(self, repo_id: str, revision: str | None = None, repo_type: str = "dataset"):
        check_endpoint()
        self.repo_id = repo_id
        self.revision = revision or "main"
        self.repo_type = repo_type

    def inside(self, folder: str) -> "HubFiles":
        """Return the files of a folder of the repository, at the same commit."""
        found = HubFiles(self.repo_id, self.commit, self.repo_type)
        found.folder = f"{folder}/"
        return found

    @cached_property
    def commit(self) -> str:
        """Commit hash that the revision stands for.

        Raises:
            HubError: The repository or revision is unknown, needs permission, or cannot be
                reached and is not in the cache.
        """
        from huggingface_hub import HfApi
        from huggingface_hub.errors import RevisionResolutionError

        resolve, wanted = HfApi().resolve_revision, {"revision": self.revision}
        wanted["repo_type"] = self.repo_type
        if _VERSION.fullmatch(self.revision):
            with suppress(RevisionResolutionError):
                return str(resolve(self.repo_id, local_files_only=True, **wanted).resolved)
        return str(self._ask(None, resolve, self.repo_id, **wanted).resolved)

    def path(self, relative: str) -> Path:
        """Return the file's path in the cache, downloading it first if need be; see `Files.path`.

        Raises:
            MissingFileError: The repository has no such file.
            HubError: See `commit`.
            HashMismatchError: What came is not what the Hub has.
        """
        from huggingface_hub import hf_hub_download

        check_relative(relative, self.describe())
        new = self.missing([relative])
        path = Path(
            self._ask(
                relative,
                hf_hub_download,
                self.repo_id,
                self.folder + relative,
                repo_type=self.repo_type,
                revision=self.commit,
                tqdm_class=_silent(),
            )
        )
        self._check({one: path for one in new})
        return path

    def fetch(self, paths: Iterable[str]) -> None:
        """Download files that are not in the cache, with a bar; see `Files.fetch`."""
        from huggingface_hub.utils import tqdm

        missing = self.missing(paths)
        if not missing:
            return
        with (
            tqdm(total=len(missing), desc=f"Fetching from {self.repo_id}", unit=" files") as bar,
            ThreadPoolExecutor(_AT_ONCE) as pool,
        ):
            try:
                for _ in pool.map(self.path, missing):
                    bar.update()
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise

    def missing(self, paths: Iterable[str]) -> list[str]:
        """Return the files that are not in the cache, each once."""
        from huggingface_hub import try_to_load_from_cache

        there = partial(
            try_to_load_from_cache,
            self.repo_id,
            repo_type=self.repo_type,
            revision=self.commit,
        )
        found = {path: there(self.folder + path) for path in dict.fromkeys(paths)}
        return [path for path, place in found.items() if not isinstance(place, str)]

    def sizes(self) -> dict[str, int]:
        """Ask how large every file of the repository is; return bytes by path.

        Raises:
            HubError: See `commit`.
        """
        from huggingface_hub import HfApi

        commit = self.commit  # what it raises is told already

        def listed() -> dict[str, int]:
            tree = HfApi().list_repo_tree(
                self.repo_id, recursive=True, revision=commit, repo_type=self.repo_type
            )
            return {
                one.path.removeprefix(self.folder): one.size
                for one in tree
                if hasattr(one, "size") and one.path.startswith(self.folder)
            }

        found: dict[str, int] = self._ask(None, listed)
        return found

    def snapshot(self, *patterns: str) -> Path:
        """Download the files that match a pattern, such as `meta/*`; return the folder of all.

        Raises:
            HubError: See `commit`.
            HashMismatchError: What came is not what the Hub has.
        """
        from huggingface_hub import constants, snapshot_download
        from huggingface_hub.file_download import repo_folder_name

        cache = repo_folder_name(repo_id=self.repo_id, repo_type=self.repo_type)
        root = Path(constants.HF_HUB_CACHE, cache, "snapshots", self.commit, self.folder)
        there = {*all_files(root)}
        self._ask(
            None,
            snapshot_download,
            self.repo_id,
            repo_type=self.repo_type,
            revision=self.commit,
            allow_patterns=[self.folder + pattern for pattern in patterns],
        )
        self._check({path: root / path for path in all_files(root) if path not in there})
        return root

    def list(self, folder: str, suffix: str = "") -> list[str]:
        """Return the sorted paths of the files under a folder, which are downloaded.

        Raises:
            HubError, HashMismatchError: See `snapshot`.
        """
        return LocalFiles(self.snapshot(f"{folder}/*{suffix}")).list(folder, suffix)

    def describe(self) -> str:
        """Return `namespace/name@revision`, with the commit as revision once it is known."""
        whole = f"{self.repo_id}@{self._at}"
        return f"{whole}, {self.folder}" if self.folder else whole

    def _check(self, came: dict[str, Path]) -> None:
        """Check files that have just come, and remove those that are not what the Hub has.

        The client checks their length only. It keeps files under their digests: Git's of small
        ones, SHA-256 of large ones.
        """
        damaged = []
        for relative, path in came.items():
            blob = path.resolve()
            digest = {40: _git_sha1, 64: sha256_file}.get(len(blob.name))
            if digest is not None and digest(blob) != blob.name:
                path.unlink()
                blob.unlink(missing_ok=True)
                damaged.append(relative)
        if damaged:
            raise HashMismatchError(
                f"{', '.join(damaged)} of {self.describe()} came damaged: the digest is another",
                "What is damaged was thrown away. Type the same command again.",
            )

    def _ask(self, relative: str | None, call: Any, *arguments: Any, **options: Any) -> Any:
        path = None if relative is None else self.folder + relative
        asked = Asked(self.repo_id, self.repo_type, self._at, path)
        return asked.ask(call, *arguments, **options)

    @property
    def _at(self) -> str:
        """The commit once it is known, and before that the revision."""
        at: str = self.__dict__.get("commit", self.revision)
        return at


def _git_sha1(path: Path) -> str:
    data = path.read_bytes()
    return sha1(b"blob %d\0" % len(data) + data).hexdigest()


@cache
def _silent() -> type:
    """Return the client's progress bar without a bar: files are small, and counted elsewhere."""
    from huggingface_hub.utils import tqdm

    class Silent(tqdm):  # type: ignore[misc, valid-type]
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **{**options, "disable": True})

    return Silent
