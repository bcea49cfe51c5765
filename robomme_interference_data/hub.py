"""Reach the files of a dataset on the Hugging Face Hub, pinned to one commit.

The client library decides where the Hub and the cache are and which token is used, so its own
settings hold: `HF_ENDPOINT`, `HF_HUB_OFFLINE`, `HF_HOME`, `HF_HUB_CACHE`, `HF_TOKEN`.
"""

import re
from functools import cached_property
from pathlib import Path

from robomme_interference_data.errors import HubError, InterferenceError, MissingFileError
from robomme_interference_data.files import atomic_path

__all__ = ["HubFiles", "is_repo_id"]

_REPO_ID = re.compile(r"[A-Za-z0-9][\w.-]*/[A-Za-z0-9][\w.-]*")
_COMMIT = re.compile(r"[0-9a-f]{40}")


def is_repo_id(text: str) -> bool:
    """Tell whether a text reads `namespace/name`, as the id of a dataset on the Hub does."""
    return _REPO_ID.fullmatch(text) is not None


class HubFiles:
    """Files of a dataset repository at one commit, downloaded one by one into the Hub's cache.

    Nothing is fetched before it is asked for. The revision is resolved once, at the first use;
    copies made after that (worker processes get one each) keep the commit.

    Args:
        repo_id: Dataset repository, `namespace/name`.
        revision: Branch, tag or commit hash; None for the main branch.
    """

    def __init__(self, repo_id: str, revision: str | None = None):
        self.repo_id = repo_id
        self.revision = revision or "main"

    @cached_property
    def commit(self) -> str:
        """Commit hash that the revision stands for; offline, the last one that was seen.

        Raises:
            HubError: The repository or revision is unknown, needs permission, or cannot be
                reached and is not in the cache.
        """
        from huggingface_hub import HfApi

        if _COMMIT.fullmatch(self.revision):
            return self.revision
        try:
            info = HfApi().repo_info(self.repo_id, repo_type="dataset", revision=self.revision)
        except _client_errors() as error:
            if _is_unreachable(error) and self._ref.is_file():
                return self._ref.read_text(encoding="utf-8").strip()
            raise self._explain(error) from error
        commit = str(info.sha)
        # Where the client itself notes what a branch stood for; it does so only when it downloads
        # by branch name, and here every download is by commit.
        with atomic_path(self._ref) as partial:
            partial.write_text(commit, encoding="utf-8")
        return commit

    def path(self, relative: str) -> Path:
        """Return the file's path in the cache, downloading it first if need be.

        Raises:
            MissingFileError: The repository has no such file.
            HubError: See `commit`.
        """
        from huggingface_hub import hf_hub_download

        commit = self.commit
        try:
            return Path(
                hf_hub_download(self.repo_id, relative, repo_type="dataset", revision=commit)
            )
        except _client_errors() as error:
            raise self._explain(error, relative) from error

    def list(self, folder: str, suffix: str = "") -> list[str]:
        """Return the sorted relative paths of all files under a folder; empty if none.

        Offline these are the files in the cache, which may not be all that there are.

        Raises:
            HubError: See `commit`.
        """
        from huggingface_hub import HfApi
        from huggingface_hub.errors import EntryNotFoundError
        from huggingface_hub.hf_api import RepoFile

        commit = self.commit
        try:
            tree = HfApi().list_repo_tree(
                self.repo_id, folder, recursive=True, repo_type="dataset", revision=commit
            )
            found = [entry.path for entry in tree if isinstance(entry, RepoFile)]
        except _client_errors() as error:
            root = self._cache / "snapshots" / commit
            if isinstance(error, EntryNotFoundError):
                return []
            if not _is_unreachable(error) or not root.is_dir():
                raise self._explain(error) from error
            paths = (root / folder).rglob("*")
            found = [path.relative_to(root).as_posix() for path in paths if path.is_file()]
        return sorted(path for path in found if path.endswith(suffix))

    def describe(self) -> str:
        """Return `namespace/name@revision`, with the commit as revision once it is known."""
        return f"{self.repo_id}@{self.__dict__.get('commit', self.revision)}"

    @property
    def _cache(self) -> Path:
        from huggingface_hub import constants
        from huggingface_hub.file_download import repo_folder_name

        folder = repo_folder_name(repo_id=self.repo_id, repo_type="dataset")
        return Path(constants.HF_HUB_CACHE) / folder

    @property
    def _ref(self) -> Path:
        return self._cache / "refs" / self.revision

    def _explain(self, error: Exception, relative: str | None = None) -> InterferenceError:
        """Return the client's error in this package's words."""
        from huggingface_hub import constants, errors

        endpoint = constants.ENDPOINT
        page = f"{endpoint}/datasets/{self.repo_id}"
        repository = f"dataset repository {self.repo_id!r} on {endpoint}"
        if isinstance(error, errors.GatedRepoError):
            return HubError(
                f"the {repository} is gated, and this login has not been given access",
                f"Ask for access at {page}, then type: hf auth login",
            )
        if isinstance(error, errors.RevisionNotFoundError):
            return HubError(
                f"the {repository} has no revision {self.revision!r}",
                f"Its branches and tags are listed at {page}/tree/main",
            )
        if isinstance(error, errors.RepositoryNotFoundError | errors.HFValidationError):
            return HubError(
                f"there is no {repository} that this login may see",
                "Check the name; if a folder on this machine was meant, it does not exist. For a "
                "private repository, type: hf auth login",
            )
        if isinstance(error, errors.EntryNotFoundError) and not _is_unreachable(error):
            return MissingFileError(
                f"{relative} is missing in {self.describe()}",
                f"The repository is not a complete dataset; its files: {page}/tree/{self.commit}",
            )
        what = f"the {repository}" if relative is None else f"{relative} of the {repository}"
        revision = f" --revision {self.__dict__.get('commit', self.revision)}"
        command = f"hf download --repo-type dataset {self.repo_id}{revision}" + (
            f" {relative}" if relative else ""
        )
        if constants.HF_HUB_OFFLINE:
            return HubError(
                f"{what} is not in the cache, and HF_HUB_OFFLINE is set",
                f"Where there is a network, type: HF_HUB_OFFLINE=0 {command}",
            )
        return HubError(
            f"{what} is not in the cache, and the Hub cannot be reached: "
            f"{(str(error).splitlines() or [type(error).__name__])[0]}",
            f"Try again when it can be reached, with: {command}",
        )


def _client_errors() -> tuple[type[Exception], ...]:
    """Return what the client raises for a request that failed."""
    import httpx
    from huggingface_hub import errors

    return (
        errors.HfHubHTTPError,
        errors.EntryNotFoundError,
        errors.FileMetadataError,
        errors.HFValidationError,
        errors.OfflineModeIsEnabled,
        httpx.TransportError,
    )


def _is_unreachable(error: Exception) -> bool:
    """Tell whether the Hub gave no answer, as against one that refuses."""
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    if isinstance(error, HfHubHTTPError):
        return error.response.status_code >= 500
    return not isinstance(error, HFValidationError)
