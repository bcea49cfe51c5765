"""The file of a leaderboard: its boards, the submissions, and the references beside them.

A submission is a few lines of this file, which name a repository of `publish-results` and what its
rows do not state. Paths are relative to the file's folder.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import yaml

from robomme_interference_data.errors import FormatError, InvalidOptionError, MissingFileError
from robomme_interference_data.schema.codec import from_dict, to_dict
from robomme_interference_data.storage.files import write_text
from robomme_interference_data.storage.text import read_text

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")

_MAX_BYTES = 1 << 20
"""Some thousand submissions."""


class TrainedOn(StrEnum):
    """What a system was trained on."""

    NOTHING = "nothing"
    OTHER = "other"
    INTERFERENCE = "interference"


class MemoryKind(StrEnum):
    """What a system remembers."""

    NONE = "none"
    FRAMES = "frames"
    TOKENS = "tokens"
    STATE = "state"
    TEXT = "text"


class BoardStanding(StrEnum):
    """Why rows are on a board, best supported first; only a submission is ranked."""

    SUBMISSION = "submission"
    CONTROL = "control"
    PAPER = "paper"
    EXAMPLE = "example"
    UNVERIFIED = "unverified"


_UNRANKED = [
    each for each in BoardStanding if each not in (BoardStanding.SUBMISSION, BoardStanding.PAPER)
]


@dataclass(frozen=True)
class Board:
    """Systems that are compared with each other: on one buffer set, in one simulator."""

    name: Annotated[str, "Name of the board, of letters, digits, `-`, `_` and `.`."]
    simulator: Annotated[str, "The simulator in its rows; boards of two simulators never mix."]
    buffer_set: Annotated[
        str | None,
        "Folder, or `namespace/name@COMMIT`. None: the board has references only, because nothing "
        "can be checked against the buffer set.",
    ] = None
    note: Annotated[str | None, "What readers must know, in a sentence or two."] = None

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):  # it is part of a file's name
            expected = "up to 64 letters, digits, '-', '_' and '.'"
            raise InvalidOptionError.expected("name", self.name, expected)


@dataclass(frozen=True)
class Reference:
    """Rows that are shown beside submissions and never ranked."""

    board: Annotated[str, "Name of the board."]
    rows: Annotated[tuple[str, ...], "Folders of runs, or files that `score` reads."]
    standing: Annotated[str, "`control`, `example`, or `unverified` for results of other programs."]
    system: Annotated[str | None, "Name of the system in files that state none."] = None
    trained_on: Annotated[str | None, "As in a submission, or None if unknown."] = None

    def __post_init__(self) -> None:
        _check_not_empty("rows", self.rows)
        _check("standing", self.standing, _UNRANKED)
        if self.trained_on is not None:
            _check("trained_on", self.trained_on, TrainedOn)


@dataclass(frozen=True)
class PublishedRun:
    """A run of a submission: one for each training run of the system."""

    results: Annotated[
        str, "Where `publish-results` put it: `namespace/name@COMMIT`, or a folder (its --to)."
    ]
    checkpoint: Annotated[str, "Where the weights are, such as `namespace/name@v1`."]
    checkpoint_sha256: Annotated[
        str, "SHA-256 of the file of weights, or of the code of a policy without weights."
    ]


@dataclass(frozen=True)
class Submission:
    """A system that is to be ranked, and what its rows do not state."""

    system: Annotated[str, "Label of the system, as in its rows."]
    board: Annotated[str, "Name of the board."]
    memory: Annotated[str, "What it remembers: `none`, `frames`, `tokens`, `state` or `text`."]
    trained_on: Annotated[
        str,
        "`interference`: histories with distractor sessions; `other`: anything else; `nothing`.",
    ]
    runs: Annotated[tuple[PublishedRun, ...], "Its runs, one for each training run."]
    parameters: Annotated[int | None, "Number of weights."] = None
    contact: Annotated[str | None, "An address for questions."] = None

    def __post_init__(self) -> None:
        _check("memory", self.memory, MemoryKind)
        _check("trained_on", self.trained_on, TrainedOn)
        _check_not_empty("runs", self.runs)
        if self.parameters is not None and self.parameters < 0:
            raise InvalidOptionError.expected("parameters", self.parameters, "a number from 0")


@dataclass(frozen=True)
class Entries:
    """The content of the file; `folder` is where it lies."""

    boards: tuple[Board, ...]
    references: tuple[Reference, ...] = ()
    submissions: tuple[Submission, ...] = ()
    folder: Path = field(default=Path(), kw_only=True)

    def board(self, name: str) -> Board:
        """Return the board with a name."""
        return next(board for board in self.boards if board.name == name)

    def locate(self, location: str) -> str | Path:
        """Return a location as it is opened.

        It is a folder, relative to that of the file, or a repository at its commit,
        `namespace/name@COMMIT`.

        Raises:
            MissingFileError: There is no such folder.
        """
        folder = self.folder / location
        if folder.is_dir():
            return folder
        if "@" in location:
            return location
        raise MissingFileError(
            f"there is no folder {folder}",
            f"Give a folder relative to {self.folder}, or namespace/name@COMMIT.",
        )


def _check(name: str, value: str, known: Any) -> None:
    if value not in [*known]:
        raise InvalidOptionError.one_of(name, value, [*known])


def _check_not_empty(name: str, values: tuple[Any, ...]) -> None:
    if not values:
        raise FormatError(f"{name} is empty; expected one or more")


def read_entries(path: Path) -> Entries:
    """Read the file of a leaderboard.

    Raises:
        FormatError: It is no YAML, a field is missing, unknown, wrong or given twice, or a board
            is unknown.
    """
    text = read_text(path, _MAX_BYTES)
    try:
        return _parse(text, path)
    except FormatError as error:  # people write this file
        hint = "Correct it: docs/how-to/leaderboard.md shows such a file."
        raise FormatError(error.message, hint) from None


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Refuses names that are given twice: YAML keeps the last, and drops what the first listed."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = set[str]()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in names:
                line = key.start_mark.line + 1
                raise yaml.YAMLError(f"{key.value!r} is given twice, again in line {line}")
            names.add(key.value)
        return super().construct_mapping(node, deep)


def _parse(text: str, path: Path) -> Entries:
    try:
        content = yaml.load(text, _Loader)
    # Beside its own errors: a date that does not exist or is too early, and deep nesting.
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as error:
        raise FormatError.damaged(path, f"no valid YAML: {error}") from None
    if not isinstance(content, Mapping):
        raise FormatError.damaged(path, "expected boards, references and submissions")
    content = dict(content)
    parts: dict[str, Any] = {}
    for name, record in _LISTS.items():
        listed = content.pop(name, None) or []
        if not isinstance(listed, list):
            raise FormatError.damaged(path, f"{name}: expected a list")
        parts[name] = tuple(
            from_dict(record, each, f"{path}, {name}, number {number}", strict=True)
            for number, each in enumerate(listed, 1)
        )
    if content:
        raise FormatError.damaged(path, f"unknown {', '.join(map(str, content))}")
    if not parts["boards"]:
        raise FormatError.damaged(path, "boards: expected one or more")
    entries = Entries(**parts, folder=path.parent)
    names = [board.name for board in entries.boards]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise FormatError.damaged(path, f"two boards are called {twice!r}")
    listed_on: tuple[Reference | Submission, ...] = (*entries.references, *entries.submissions)
    for entry in listed_on:
        if entry.board not in names:
            known = ", ".join(names)
            raise FormatError.damaged(path, f"board {entry.board!r}; the boards are: {known}")
    return entries


_LISTS: dict[str, type] = {"boards": Board, "references": Reference, "submissions": Submission}


def add_submission(path: Path, submission: Submission) -> None:
    """Add a submission at the end of the file, whose other lines stay as they are.

    Raises:
        InvalidOptionError: The file does not end with its submissions.
    """
    text = read_text(path, _MAX_BYTES)
    before = _parse(text, path)
    values = {name: value for name, value in to_dict(submission).items() if value is not None}
    block = yaml.safe_dump([values], sort_keys=False, allow_unicode=True, width=1000)
    head = text.rstrip()
    if not before.submissions:
        head = head.removesuffix("[]").rstrip()
        if "submissions" not in yaml.safe_load(text):
            head += "\nsubmissions:"
    longer = f"{head}\n{block}"
    expected = replace(before, submissions=(*before.submissions, submission))
    try:
        holds = _parse(longer, path) == expected
    except FormatError:
        holds = False
    if not holds:
        raise InvalidOptionError(
            f"{path} does not end with its list of submissions",
            "Move submissions to the end of the file, with its lines unindented.",
        )
    write_text(path, longer)
