"""Call the Hugging Face Hub's client: its errors become this package's errors."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from robomme_interference_data.errors import HubError, MissingFileError
from robomme_interference_data.retry import retry

from .files import with_filename

_FAULTS = (500, 502, 503, 504)
"""Status of a server that may answer the next request: a download is repeated once."""

_PAUSE_S = 1.0
"""Seconds before that; the client itself repeats some requests after 429, and no others."""

_LOGIN = (
    "{endpoint} rejects your login",
    "Create a token with the permission, and log in: hf auth login (HF_TOKEN takes precedence)",
)
_UNKNOWN = (
    "{repo} does not exist, or your login has no access",
    "Check the name; no local folder of this name exists either. For a private repository, log in: "
    "hf auth login",
)
_ERRORS = {
    "GatedRepoError": (
        "{repo} is gated, and your login has no access",
        "Request access at {page}, then log in: hf auth login",
    ),
    "RevisionNotFoundError": (
        "{repo} has no revision {revision!r}",
        "Its branches and tags are listed at {page}/tree/main",
    ),
    "RepositoryNotFoundError": _UNKNOWN,
    "HFValidationError": _UNKNOWN,
    "RemoteEntryNotFoundError": (
        "{path} is missing in {repo_id}@{revision}",
        "The repository is incomplete; its files are listed at {page}/tree/{revision}",
    ),
    "LocalTokenNotFoundError": _LOGIN,
    401: _LOGIN,
    403: ("your login lacks the permission for {repo}", "Use another token: hf auth login --force"),
    412: (
        "somebody else wrote to {repo_id} at the same time",
        "Check {page}/commits/main, then run the same command again.",
    ),
}
"""Message and hint by the client's error class or the HTTP status; the first match counts."""


@dataclass(frozen=True)
class HubCall:
    """A call of the Hub's client about one repository, with this package's errors.

    `revision` is set for downloads only, and `path` if they are of one file.
    """

    repo_id: str
    repo_type: str = "dataset"
    revision: str | None = None
    path: str | None = None

    @property
    def page(self) -> str:
        """Address of the repository's page."""
        from huggingface_hub import constants

        kind = "datasets/" if self.repo_type == "dataset" else ""
        return f"{constants.ENDPOINT}/{kind}{self.repo_id}"

    def run(self, call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Call a function of the client; again, once, if a download meets a fault of the Hub."""
        return retry(
            partial(self._once, call, *arguments, **options),
            lambda error: self.revision is not None and _status(error.__cause__) in _FAULTS,
            [_PAUSE_S],
        )

    def _once(self, call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        from huggingface_hub import constants, errors
        from huggingface_hub.utils import httpx  # the client's HTTP library: httpx, or httpx2

        try:
            return call(*arguments, **options)
        except (
            OSError,
            ValueError,
            RuntimeError,
            errors.EntryNotFoundError,
            errors.RevisionResolutionError,
            httpx.HTTPError,
            httpx.InvalidURL,
        ) as error:
            cause: BaseException = error
            vague = (RuntimeError, errors.LocalEntryNotFoundError, errors.RevisionResolutionError)
            # These only say that a call failed; what they were raised from says why.
            while isinstance(cause, vague) and cause.__cause__ is not None:
                cause = cause.__cause__
            # An error of this machine, such as a full disk, not of the Hub.
            if isinstance(cause, OSError) and cause.errno is not None:
                with with_filename(constants.HF_HUB_CACHE if self.revision else self.repo_id):
                    raise cause from None
            raise self._explained(cause) from cause

    def _explained(self, error: BaseException) -> HubError | MissingFileError:
        from huggingface_hub import constants

        repo = f"the {self.repo_type} repository {self.repo_id!r} on {constants.ENDPOINT}"
        status = _status(error)
        keys = [*(kind.__name__ for kind in type(error).__mro__), status]
        key = next((key for key in _ERRORS if key in keys), None)
        if key is not None:
            values = vars(self) | {"repo": repo, "page": self.page, "endpoint": constants.ENDPOINT}
            message, hint = (text.format(**values) for text in _ERRORS[key])
            missing = key == "RemoteEntryNotFoundError"
            return MissingFileError(message, hint) if missing else HubError(message, hint)
        what = f"{self.path} of {repo}" if self.path else repo
        reason = " ".join(str(error).split())
        if self.revision:
            hint = "Run the same command again to resume."
        else:  # publishing, which can also be tried without the Hub
            hint = (
                "Check the network, then run the same command again. To write the files into a "
                "folder instead: --to FOLDER"
            )
        if constants.HF_HUB_OFFLINE:
            reason, hint = "HF_HUB_OFFLINE is set", "With a network: unset HF_HUB_OFFLINE"
        elif status in (429, 503):
            reason = f"the Hub is busy ({status})"
            hint = "Wait some minutes, then run the same command again to resume."
        missing_locally = "is not in the cache, and " if self.revision else ""
        return HubError(f"{what} {missing_locally}cannot be reached: {reason}", hint)


def _status(error: BaseException | None) -> int | None:
    """Return the HTTP status of an error of the client, if it has one."""
    status: int | None = getattr(getattr(error, "response", None), "status_code", None)
    return status
