"""Reach repositories on the Hugging Face Hub, pinned to one commit: datasets, policies, encoders.

The stock client does the work, so its own settings hold (`HF_ENDPOINT`, `HF_HUB_OFFLINE`,
`HF_HOME`, `HF_HUB_CACHE`, `HF_TOKEN`), and its cache is the only one.
"""

import os
import re
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Self

from robomme_interference_data.errors import HashMismatchError, InvalidOptionError, MissingFileError

from .files import Files, LocalFiles, all_files, check_relative, sha256_file
from .hub_call import HubCall

_NAME = r"[A-Za-z0-9][\w.-]*"
_LOCATION = re.compile(rf"({_NAME}/{_NAME})((?:/{_NAME})*)(?:@(.+))?")
_VERSION = re.compile(r"data-\d+\.\d+\.\d+")
_ENDPOINT = re.compile(r"https?://([\w.-]+|\[[\da-fA-F:.]+\])(:[1-9]\d{0,4})?(/\S*)?")
_PUBLIC = "https://huggingface.co"
# As many as the client's own `snapshot_download` has.
_PARALLEL_DOWNLOADS = 8


def locate(
    location: str | os.PathLike[str], repo_type: str = "dataset", revision: str | None = None
) -> "LocalFiles | HubFiles":
    """Return the files at a location: a folder, `namespace/name` or `namespace/name@revision`.

    A folder of a repository follows its name: `namespace/name/folder@revision`. The revision may
    also be given separately. An existing folder takes precedence over a repository; a `Path` is
    always a folder.
    """
    folder = Path(location).expanduser()
    if not isinstance(location, str) and not folder.is_dir():
        raise MissingFileError(
            f"there is no folder {folder}",
            "Give an existing folder, or a repository on the Hub as text: 'namespace/name'.",
        )
    if folder.is_dir():
        if revision is not None:
            raise InvalidOptionError(
                f"revision {revision!r} of the folder {folder}; only a repository has revisions",
                "Omit the revision, or give namespace/name instead of the folder.",
            )
        return LocalFiles(folder)
    if folder.is_file():
        raise MissingFileError(f"{folder} is a file", "Give the folder that it is in.")
    return HubFiles.parse(str(location), repo_type, revision)


def check_endpoint() -> None:
    """Check that `HF_ENDPOINT` is an address: some other values break the client's import."""
    endpoint = os.environ.get("HF_ENDPOINT", _PUBLIC)
    if not _ENDPOINT.fullmatch(endpoint):
        expected, hint = f"an address such as {_PUBLIC}", "To use that one: unset HF_ENDPOINT"
        raise InvalidOptionError.expected("HF_ENDPOINT", endpoint, expected, hint)


class HubFiles(Files):
    """Files of a `dataset` or `model` repository at one commit, downloaded on use.

    The revision (a branch, tag or commit hash) is resolved once, at the first use; pickled copies
    keep the commit. Offline, it is the commit that the revision last resolved to. The same holds
    for the tag of a version, such as `data-1.0.0`: a published version never changes.
    """

    def __init__(
        self,
        repo_id: str,
        revision: str | None = None,
        repo_type: str = "dataset",
        folder: str = "",
    ):
        check_endpoint()
        self.repo_id = repo_id
        self.revision = revision or "main"
        self.repo_type = repo_type
        self.folder = f"{folder}/" if folder else ""

    @classmethod
    def parse(cls, location: str, repo_type: str = "dataset", revision: str | None = None) -> Self:
        """Return the files at `namespace/name[/folder][@revision]`."""
        match = _LOCATION.fullmatch(location)
        if match is None:
            raise InvalidOptionError(
                f"{location!r} is neither a folder nor a {repo_type} repository on the Hub",
                "Give an existing folder, namespace/name, or namespace/name@revision.",
            )
        repo_id, folder, at = match.groups()
        if at and revision not in (None, at):
            raise InvalidOptionError(
                f"{location!r} and revision {revision!r}", "Give the revision once."
            )
        return cls(repo_id, at or revision, repo_type, folder[1:])

    def inside(self, folder: str) -> "HubFiles":
        """Return the files of a folder of the repository, at the same commit."""
        return HubFiles(self.repo_id, self.commit, self.repo_type, f"{self.folder}{folder}")

    @cached_property
    def commit(self) -> str:
        """Commit hash of the revision."""
        from huggingface_hub import HfApi
        from huggingface_hub.errors import RevisionResolutionError

        options = {"repo_type": self.repo_type, "revision": self.revision}
        resolve = partial(HfApi().resolve_revision, self.repo_id, **options)
        if _VERSION.fullmatch(self.revision):
            with suppress(RevisionResolutionError):
                return str(resolve(local_files_only=True).resolved)
        return str(self._call().run(resolve).resolved)

    @property
    def location(self) -> str:
        """`namespace/name[/folder]@commit`: the argument of `locate` for the same files."""
        return f"{self.name}@{self.commit}"

    @property
    def name(self) -> str:
        """`namespace/name`, and the folder of the repository if it is one."""
        return f"{self.repo_id}/{self.folder}".removesuffix("/")

    def path(self, relative: str) -> Path:
        """Return the file's path in the cache, downloading it if necessary.

        A downloaded file is compared with the digest that the Hub has of it.
        """
        from huggingface_hub import hf_hub_download
        from huggingface_hub.utils import tqdm

        check_relative(relative, self.describe())
        new, name = self.missing([relative]), self.folder + relative
        quiet = partial(tqdm, disable=True)  # files are small, and counted by `fetch`
        download = partial(hf_hub_download, tqdm_class=quiet, **self._options)
        path = Path(self._call(name).run(download, self.repo_id, name))
        self._check(dict.fromkeys(new, path))
        return path

    def fetch(self, paths: Iterable[str]) -> None:
        """Download files that are not in the cache, several at a time, with a progress bar.

        `snapshot_download` would first list the whole repository: for one buffer of a large
        dataset, more bytes and requests than the buffer's metadata.
        """
        from huggingface_hub.utils import are_progress_bars_disabled

        from robomme_interference_data.progress import WorkProgress

        missing = self.missing(paths)
        if not missing:
            return
        with (
            WorkProgress(unit="files", quiet=are_progress_bars_disabled()) as progress,
            ThreadPoolExecutor(_PARALLEL_DOWNLOADS) as pool,
        ):
            progress.start(f"Fetching from {self.repo_id}", len(missing))
            for _ in pool.map(self.path, missing):  # an error cancels the downloads in the queue
                progress.advance(1)

    def missing(self, paths: Iterable[str]) -> list[str]:
        """Return the files that are not in the cache, each once."""
        from huggingface_hub import try_to_load_from_cache

        cached = partial(try_to_load_from_cache, self.repo_id, **self._options)
        unique = dict.fromkeys(paths)
        return [path for path in unique if not isinstance(cached(self.folder + path), str)]

    def sizes(self) -> dict[str, int]:
        """Return the size of every file of the repository, in bytes by path."""
        from huggingface_hub import HfApi

        list_tree = partial(HfApi().list_repo_tree, recursive=True, **self._options)
        tree = self._call().run(lambda: list(list_tree(self.repo_id)))  # requests come in pages
        return {
            entry.path.removeprefix(self.folder): entry.size
            for entry in tree
            if hasattr(entry, "size") and entry.path.startswith(self.folder)
        }

    def snapshot(self, *patterns: str) -> Path:
        """Download the files that match a pattern, such as `meta/*`; return the folder of all."""
        from huggingface_hub import constants, snapshot_download
        from huggingface_hub.file_download import repo_folder_name

        cache = repo_folder_name(repo_id=self.repo_id, repo_type=self.repo_type)
        root = Path(constants.HF_HUB_CACHE, cache, "snapshots", self.commit, self.folder)
        before = {*all_files(root)}
        allowed = [self.folder + pattern for pattern in patterns]
        download = partial(snapshot_download, allow_patterns=allowed, **self._options)
        self._call().run(download, self.repo_id)
        self._check({path: root / path for path in all_files(root) if path not in before})
        return root

    def list(self, folder: str, suffix: str = "") -> list[str]:
        """Return the sorted paths of the files under a folder, which are downloaded."""
        return LocalFiles(self.snapshot(f"{folder}/*{suffix}")).list(folder, suffix)

    def describe(self) -> str:
        """Return `namespace/name[/folder]@revision`; the commit once it is known."""
        return f"{self.name}@{self._known_revision}"

    def _check(self, downloaded: dict[str, Path]) -> None:
        """Remove downloaded files whose digest differs from the Hub's, and raise.

        The client checks only their length.
        """
        damaged = []
        for relative, path in downloaded.items():
            if not _has_digest(path, self._digest(relative, path)):
                # A link leads to a blob of the repository, which may lead to one that all share.
                for linked in (path.resolve(), *_links(path)):
                    linked.unlink(missing_ok=True)
                damaged.append(relative)
        if damaged:
            raise HashMismatchError(
                f"{', '.join(damaged)} of {self.describe()} came damaged: the digest differs",
                "The damaged files were deleted. Run the same command again.",
            )

    def _digest(self, relative: str, path: Path) -> str:
        """Return the Hub's digest of a downloaded file, its entity tag."""
        if path.is_symlink():  # to a blob, whose name is the digest
            return path.readlink().name
        # Without links, as on Windows, the cache does not hold the digest.
        from huggingface_hub import get_hf_file_metadata, hf_hub_url

        name = self.folder + relative
        url = hf_hub_url(self.repo_id, name, **self._options)
        return str(self._call(name).run(get_hf_file_metadata, url).etag)

    @property
    def _options(self) -> dict[str, Any]:
        return {"repo_type": self.repo_type, "revision": self.commit}

    def _call(self, path: str | None = None) -> HubCall:
        return HubCall(self.repo_id, self.repo_type, self._known_revision, path)

    @property
    def _known_revision(self) -> str:
        revision: str = self.__dict__.get("commit", self.revision)
        return revision


def _links(path: Path) -> Iterator[Path]:
    """Yield a path and those that its links lead to, as far as they are links."""
    while path.is_symlink():
        following = path.parent / path.readlink()
        yield path
        path = following


def _has_digest(path: Path, digest: str) -> bool:
    """Return whether a file has a digest of the Hub: Git's of small ones, SHA-256 of large ones."""
    from huggingface_hub.utils.sha import git_hash

    if re.fullmatch(r"[0-9a-f]{64}", digest):
        return sha256_file(path) == digest
    if re.fullmatch(r"[0-9a-f]{40}", digest):
        return bool(git_hash(path.read_bytes()) == digest)
    return True  # of a server with other tags
