"""Errors of the Hub's client as errors of this package, with what to do next."""

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from robomme_interference_data.errors import HubError, InvalidOptionError, MissingFileError

from .files import with_filename

_COMMIT = re.compile(r"[0-9a-f]{40}")
_BUSY = (429, 503)
_PUBLIC = "https://huggingface.co"
_ENDPOINT = re.compile(r"https?://([\w.-]+|\[[\da-fA-F:.]+\])(:[1-9]\d{0,4})?(/\S*)?")

_LOGIN = (
    "the Hub at {endpoint} does not know this login",
    "Make a token that may {may}, and type: hf auth login (HF_TOKEN, if set, takes precedence)",
)
_UNKNOWN = (
    "there is no {repository} that this login may see",
    "Check the name. {folder}For a private repository, type: hf auth login",
)
_ANSWERS = {
    "GatedRepoError": (
        "the {repository} is gated, and this login has not been given access",
        "Ask for access at {page}, then type: hf auth login",
    ),
    "RevisionNotFoundError": (
        "the {repository} has no revision {revision!r}",
        "Its branches and tags are listed at {page}/tree/main",
    ),
    "RepositoryNotFoundError": _UNKNOWN,
    "HFValidationError": _UNKNOWN,
    "RemoteEntryNotFoundError": (
        "{path} is missing in {repo_id}@{revision}",
        "The repository is not complete; its files: {page}/tree/{revision}",
    ),
    "LocalTokenNotFoundError": _LOGIN,
    401: _LOGIN,
    403: (
        "this login may not {may} {repo_id}",
        "Use a token that may: hf auth login --force",
    ),
    412: (
        "somebody else wrote to {repo_id} at the same time",
        "Look at {page}/commits/main. If that is as it should be: {again}",
    ),
}
"""Message and hint by the client's error class or the status of the Hub's answer; the first that
fits counts."""


def check_endpoint() -> None:
    """Check that `HF_ENDPOINT` is an address: some others break the client's import."""
    given = os.environ.get("HF_ENDPOINT", _PUBLIC)
    if not _ENDPOINT.fullmatch(given):
        expected, hint = f"an address such as {_PUBLIC}", "For that one, type: unset HF_ENDPOINT"
        raise InvalidOptionError.expected("HF_ENDPOINT", given, expected, hint)


@dataclass(frozen=True)
class HubCall:
    """A call of the Hub's client about one repository: its errors get this package's words.

    Attributes:
        repo_id: The repository, `namespace/name`.
        repo_type: `dataset` or `model`.
        revision: Branch, tag or commit that is read; None if nothing is downloaded.
        path: The file that is read; None for none in particular.
        sends: Whether files are sent.
    """

    repo_id: str
    repo_type: str = "dataset"
    revision: str | None = None
    path: str | None = None
    sends: bool = False

    @property
    def page(self) -> str:
        """Address of the repository's page."""
        from huggingface_hub import constants

        kind = "datasets/" if self.repo_type == "dataset" else ""
        return f"{constants.ENDPOINT}/{kind}{self.repo_id}"

    @property
    def again(self) -> str:
        """What to do after an error that may pass, without a full stop."""
        kept = "arrived" if self.revision else "was sent" if self.sends else None
        again = "run the same command again"
        return f"what {kept} is kept: {again}" if kept else again

    def run(self, call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Call a function of the client, and nothing but the client."""
        import httpx
        from huggingface_hub import constants, errors

        try:
            return call(*arguments, **options)
        except (
            OSError,
            ValueError,
            RuntimeError,
            errors.EntryNotFoundError,
            errors.RevisionResolutionError,
            httpx.TransportError,
            httpx.InvalidURL,
        ) as error:
            cause = _cause(error)
            if isinstance(cause, OSError) and cause.errno is not None:
                with with_filename(constants.HF_HUB_CACHE if self.revision else self.repo_id):
                    raise cause from None
            raise self._explained(cause) from cause

    def _explained(self, error: BaseException) -> HubError | MissingFileError:
        from huggingface_hub import constants

        repository = f"{self.repo_type} repository {self.repo_id!r} on {constants.ENDPOINT}"
        keys = [*(one.__name__ for one in type(error).__mro__), _status(error)]
        key = next((key for key in _ANSWERS if key in keys), None)
        if key is not None:
            words = vars(self) | {
                "repository": repository,
                "page": self.page,
                "endpoint": constants.ENDPOINT,
                "may": "read" if self.revision else "write to",
                "folder": self._folder,
                "again": f"{self.again}.",
            }
            message, hint = (text.format(**words) for text in _ANSWERS[key])
            missing = key == "RemoteEntryNotFoundError"
            return MissingFileError(message, hint) if missing else HubError(message, hint)
        what = f"{self.path} of the {repository}" if self.path else f"the {repository}"
        if self.revision:
            what += " is not in the cache, and"
        seconds, hint = _seconds(error), f"{self.again[0].upper()}{self.again[1:]}"
        if constants.HF_HUB_OFFLINE:
            why = "cannot be reached: HF_HUB_OFFLINE is set"
            file = f"{self.repo_id} --revision {self.revision} {self.path or ''}".rstrip()
            hint = "With a network, unset HF_HUB_OFFLINE"
            if self.revision:
                hint += f", or: HF_HUB_OFFLINE=0 hf download --repo-type {self.repo_type} {file}"
        elif seconds is not None:
            why = f"cannot be had: the Hub is busy ({_status(error)})"
            hint += f" in {max(seconds / 60, 1):.0f} minutes or more."
        else:
            why, hint = f"cannot be had: {' '.join(str(error).split())}", f"{hint}."
        return HubError(f"{what} {why}", self._folder + hint)

    @property
    def _folder(self) -> str:
        """What to say as long as the name may be that of a folder, mistyped."""
        if self.revision is None or _COMMIT.fullmatch(self.revision):
            return ""
        return f"If a folder on this machine was meant: there is none called {self.repo_id}. "


def busy_for(error: HubError) -> float | None:
    """Return for how many seconds a busy Hub wants to be left alone; None if it is not busy."""
    return None if error.__cause__ is None else _seconds(error.__cause__)


def _status(error: BaseException) -> int | None:
    """Return the HTTP status of the answer that an error is about."""
    code: int | None = getattr(getattr(error, "response", None), "status_code", None)
    return code


def _seconds(error: BaseException) -> float | None:
    from huggingface_hub.utils import parse_ratelimit_headers

    if _status(error) not in _BUSY:
        return None
    headers: Any = error.response.headers  # type: ignore[attr-defined]
    limit = parse_ratelimit_headers(headers)
    if limit is not None and limit.remaining == 0:
        return float(limit.reset_in_seconds)
    after = headers.get("Retry-After", "")
    return float(after) if after.isdigit() else 10.0  # a date is no measure: clocks may be wrong


def _cause(error: BaseException) -> BaseException:
    """Return what was behind an error that tells only which file or revision it was about."""
    from huggingface_hub import errors

    veiled = (RuntimeError, errors.LocalEntryNotFoundError, errors.RevisionResolutionError)
    while isinstance(error, veiled) and error.__cause__ is not None:
        error = error.__cause__
    return error
