"""What the Hub's client raises, in this package's words, with what to do next."""

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from robomme_interference_data.errors import (
    HubError,
    InterferenceError,
    InvalidOptionError,
    MissingFileError,
)

from .files import naming

_COMMIT = re.compile(r"[0-9a-f]{40}")
_BUSY = (429, 503)
_PUBLIC = "https://huggingface.co"


def check_endpoint() -> None:
    """Check that `HF_ENDPOINT` is an address: of some that are none, the client cannot be imported.

    Raises:
        InvalidOptionError: It is none.
    """
    given = os.environ.get("HF_ENDPOINT", _PUBLIC)
    try:
        told = urlsplit(given)
        known = told.scheme in ("http", "https") and told.hostname and told.port != 0
    except ValueError:
        known = False
    if not known or any(map(str.isspace, given)):
        expected, hint = f"an address such as {_PUBLIC}", "For that one, type: unset HF_ENDPOINT"
        raise InvalidOptionError.expected("HF_ENDPOINT", given, expected, hint)


@dataclass(frozen=True)
class Asked:
    """What the Hub is asked for: a repository, to read it or to write to it.

    Attributes:
        repo_id: The repository, `namespace/name`.
        repo_type: `dataset` or `model`.
        revision: Branch, tag or commit that is read; None where it is written to.
        path: The file that is read; None for none in particular.
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

    @property
    def again(self) -> str:
        """What to do after an error that may pass, without a full stop."""
        kept = "was sent" if self.revision is None else "came whole"
        return f"What {kept} is kept: type the same command again"

    def ask(self, call: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
        """Call a function of the client.

        Raises:
            HubError: The Hub refuses, does not know the repository, or cannot be reached.
            MissingFileError: The repository has no such file.
            OSError: The system's word on a file, such as that the disk is full.
        """
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
                with naming(constants.HF_HUB_CACHE if self.revision else self.repo_id):
                    raise cause from None
            raise self._explained(cause) from cause

    def _explained(self, error: BaseException) -> InterferenceError:
        import httpx
        from huggingface_hub import constants, errors

        reads, code, seconds = self.revision is not None, _status(error), _seconds(error)
        repository = f"{self.repo_type} repository {self.repo_id!r} on {constants.ENDPOINT}"
        what = f"the {repository}" if self.path is None else f"{self.path} of the {repository}"
        lacking = " is not in the cache, and" if reads else ""
        if isinstance(error, errors.GatedRepoError):
            what = f"the {repository} is gated, and this login has not been given access"
            hint = f"Ask for access at {self.page}, then type: hf auth login"
        elif isinstance(error, errors.RevisionNotFoundError):
            what = f"the {repository} has no revision {self.revision!r}"
            hint = f"Its branches and tags are listed at {self.page}/tree/main"
        elif isinstance(error, errors.RepositoryNotFoundError | errors.HFValidationError):
            what = f"there is no {repository} that this login may see"
            login = "For a private repository, type: hf auth login"
            hint = f"Check the name. {self._no_folder}{login}"
        elif isinstance(error, errors.RemoteEntryNotFoundError):
            what = f"{self.path} is missing in {self.repo_id}@{self.revision}"
            hint = f"The repository is not complete; its files: {self.page}/tree/{self.revision}"
            return MissingFileError(what, hint)
        elif isinstance(error, errors.LocalTokenNotFoundError) or code == 401:
            what = f"the Hub at {constants.ENDPOINT} does not know this login"
            may = f"Make a token that may {'read' if reads else 'write'}"
            hint = f"{may}, and type: hf auth login (HF_TOKEN, where it is set, goes before that)"
        elif code == 403:
            what = f"this login may not {'read' if reads else 'write to'} {self.repo_id}"
            own = "" if reads else "a repository of your own, or "
            hint = f"Give {own}a token that may: hf auth login --force"
        elif code == 412:
            what = f"somebody else wrote to {self.repo_id} at the same time"
            hint = f"Look at {self.page}/commits/main. {self.again}, if that is as it should be."
        elif constants.HF_HUB_OFFLINE:
            what = f"{what}{lacking} cannot be reached: HF_HUB_OFFLINE is set"
            hint = f"{self._no_folder}Where there is a network, type: {self._command}"
        elif seconds is not None:
            what = f"{what}{lacking} cannot be had: the Hub is busy ({code})"
            hint = f"{self._no_folder}{self.again} in {max(seconds / 60, 1):.0f} minutes or more."
        else:
            away = isinstance(error, httpx.TransportError) or (code or 0) >= 500
            state = f"{lacking} cannot be reached" if away else ""
            what = f"{what}{state}: {' '.join(str(error).split())}"
            hint = f"{self._no_folder}{self.again}."
        return HubError(what, hint)

    @property
    def _command(self) -> str:
        """The command that does what could not be done, with a network."""
        if self.revision is None:
            return "the same command again, with HF_HUB_OFFLINE=0 in front."
        option = "" if self.repo_type == "model" else f" --repo-type {self.repo_type}"
        what = f"{self.repo_id} --revision {self.revision} {self.path or ''}".rstrip()
        return f"HF_HUB_OFFLINE=0 hf download{option} {what}"

    @property
    def _no_folder(self) -> str:
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
    headers: Mapping[str, str] = error.response.headers  # type: ignore[attr-defined]
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
