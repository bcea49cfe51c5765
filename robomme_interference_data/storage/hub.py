"""Reach repositories on the Hugging Face Hub, pinned to one commit: datasets, policies, encoders.

The stock client does the work, so its own settings hold (`HF_ENDPOINT`, `HF_HUB_OFFLINE`,
`HF_HOME`, `HF_HUB_CACHE`, `HF_TOKEN`), and its cache is the only one. `hub_errors` turns what it
raises into this package's errors.
"""

import os
import re
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cached_property, partial
from hashlib import sha1
from pathlib import Path
from typing import Self

from robomme_interference_data.errors import HashMismatchError, InvalidOptionError

from .files import LocalFiles, all_files, check_relative, sha256_file
from .hub_errors import HubCall, check_endpoint

_LOCATION = re.compile(r"([A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*)(?:@(.+))?")
_VERSION = re.compile(r"data-\d+\.\d+\.\d+")
_AT_ONCE = 8


def locate(
    location: str | os.PathLike[str], repo_type: str = "dataset", revision: str | None = None
) -> "LocalFiles | HubFiles":
    """Return the files at a location.

    Args:
        location: A folder, or a repository on the Hub: `namespace/name`, or with a branch, tag or
            commit `namespace/name@revision`. An existing folder takes precedence over a repository;
            a `Path` is always a folder.
        repo_type: `dataset` or `model`.
        revision: The branch, tag or commit, if not in `location`.
    """
    folder = Path(location).expanduser()
    if folder.is_dir():
        if revision is not None:
            raise InvalidOptionError(
                f"revision {revision!r} of the folder {folder}; only a repository has revisions",
                "Leave it out, or give namespace/name instead of the folder.",
            )
        return LocalFiles(folder)
    return HubFiles.parse(str(location), repo_type, revision)


class HubFiles:
    """Files of a repository at one commit, downloaded into the Hub's cache when asked for.

    The revision is resolved once, at the first use; copies made after that (worker processes get
    one each) keep the commit. Offline, it is what the revision last stood for; and so it always is
    for a version's tag, `data-1.0.0`: a published version never changes.

    Args:
        repo_id: Repository, `namespace/name`.
        revision: Branch, tag or commit hash; None for the main branch.
        repo_type: `dataset` or `model`.
    """

    folder = ""

    def __init__(self, repo_id: str, revision: str | None = None, repo_type: str = "dataset"):
        check_endpoint()
        self.repo_id = repo_id
        self.revision = revision or "main"
        self.repo_type = repo_type

    @classmethod
    def parse(cls, location: str, repo_type: str = "dataset", revision: str | None = None) -> Self:
        """Return the files at `namespace/name` or `namespace/name@revision`."""
        match = _LOCATION.fullmatch(location)
        if match is None:
            raise InvalidOptionError(
                f"{location!r} is neither a folder nor a {repo_type} repository on the Hub",
                "Give an existing folder, namespace/name, or namespace/name@revision.",
            )
        repo_id, at = match.groups()
        if at and revision not in (None, at):
            raise InvalidOptionError(
                f"{location!r} and revision {revision!r}", "Give the revision once."
            )
        return cls(repo_id, at or revision, repo_type)

    def inside(self, folder: str) -> "HubFiles":
        """Return the files of a folder of the repository, at the same commit."""
        found = HubFiles(self.repo_id, self.commit, self.repo_type)
        found.folder = f"{folder}/"
        return found

    @cached_property
    def commit(self) -> str:
        """Commit hash that the revision stands for."""
        from huggingface_hub import HfApi
        from huggingface_hub.errors import RevisionResolutionError

        resolve, wanted = HfApi().resolve_revision, {"revision": self.revision}
        wanted["repo_type"] = self.repo_type
        if _VERSION.fullmatch(self.revision):
            with suppress(RevisionResolutionError):
                return str(resolve(self.repo_id, local_files_only=True, **wanted).resolved)
        return str(self._call().run(resolve, self.repo_id, **wanted).resolved)

    @property
    def location(self) -> str:
        """`namespace/name@commit`; see `Files.location`."""
        return f"{self.repo_id}@{self.commit}"

    def path(self, relative: str) -> Path:
        """Return the file's path in the cache, downloading it first if need be; see `Files.path`.

        What arrives is compared with the digest that the Hub has of it.
        """
        from huggingface_hub import hf_hub_download
        from huggingface_hub.utils import tqdm

        check_relative(relative, self.describe())
        new, name = self.missing([relative]), self.folder + relative
        path = Path(
            self._call(name).run(
                hf_hub_download,
                self.repo_id,
                name,
                repo_type=self.repo_type,
                revision=self.commit,
                tqdm_class=partial(tqdm, disable=True),  # files are small, and counted by `fetch`
            )
        )
        self._check({one: path for one in new})
        return path

    def fetch(self, paths: Iterable[str]) -> None:
        """Download files that are not in the cache, with a progress bar; see `Files.fetch`.

        Not by `snapshot_download`, which lists the whole repository first: for one buffer of a
        large dataset that is more bytes, and more requests, than the buffer's metadata.
        """
        from huggingface_hub.utils import tqdm

        missing = self.missing(paths)
        if not missing:
            return
        with (
            tqdm(total=len(missing), desc=f"Fetching from {self.repo_id}", unit=" files") as bar,
            ThreadPoolExecutor(_AT_ONCE) as pool,
        ):
            for _ in pool.map(self.path, missing):  # an error cancels those that wait
                bar.update()

    def missing(self, paths: Iterable[str]) -> list[str]:
        """Return the files that are not in the cache, each once."""
        from huggingface_hub import try_to_load_from_cache

        def cached(path: str) -> object:
            of = {"repo_type": self.repo_type, "revision": self.commit}
            return try_to_load_from_cache(self.repo_id, self.folder + path, **of)

        return [path for path in dict.fromkeys(paths) if not isinstance(cached(path), str)]

    def sizes(self) -> dict[str, int]:
        """Ask how large every file of the repository is; return bytes by path."""
        from huggingface_hub import HfApi

        of = {"repo_type": self.repo_type, "revision": self.commit}
        tree = self._call().run(
            lambda: list(HfApi().list_repo_tree(self.repo_id, recursive=True, **of))  # in pages
        )
        return {
            one.path.removeprefix(self.folder): one.size
            for one in tree
            if hasattr(one, "size") and one.path.startswith(self.folder)
        }

    def snapshot(self, *patterns: str) -> Path:
        """Download the files that match a pattern, such as `meta/*`; return the folder of all."""
        from huggingface_hub import constants, snapshot_download
        from huggingface_hub.file_download import repo_folder_name

        cache = repo_folder_name(repo_id=self.repo_id, repo_type=self.repo_type)
        root = Path(constants.HF_HUB_CACHE, cache, "snapshots", self.commit, self.folder)
        before = {*all_files(root)}
        self._call().run(
            snapshot_download,
            self.repo_id,
            repo_type=self.repo_type,
            revision=self.commit,
            allow_patterns=[self.folder + pattern for pattern in patterns],
        )
        self._check({path: root / path for path in all_files(root) if path not in before})
        return root

    def list(self, folder: str, suffix: str = "") -> list[str]:
        """Return the sorted paths of the files under a folder, which are downloaded."""
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
                "What is damaged was thrown away. Run the same command again.",
            )

    def _call(self, path: str | None = None) -> HubCall:
        return HubCall(self.repo_id, self.repo_type, self._at, path)

    @property
    def _at(self) -> str:
        """The commit once it is known, and before that the revision."""
        at: str = self.__dict__.get("commit", self.revision)
        return at


def _git_sha1(path: Path) -> str:
    data = path.read_bytes()
    return sha1(b"blob %d\0" % len(data) + data).hexdigest()
