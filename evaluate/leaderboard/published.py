"""What a submission consists of: the files of its repositories, and the board's buffer set."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from robomme_interference_data.constants import RUN_HEADER, RUN_RECORD, RUN_TABLES
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.data.loading import load_buffer_set
from robomme_interference_data.errors import (
    FormatError,
    InterferenceError,
    MissingFileError,
    first_line,
)
from robomme_interference_data.evaluate.run.record import RunHeader, rows_that_count, whole_lines
from robomme_interference_data.evaluate.run.row import Rollout, row_of
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, parse_condition
from robomme_interference_data.schema.manifest import BufferManifest
from robomme_interference_data.storage.files import all_files
from robomme_interference_data.storage.hub import HubFiles, locate
from robomme_interference_data.storage.hub_call import HubCall
from robomme_interference_data.storage.text import read_header

from .entries import Board, Entries, PublishedRun, Submission

CARD = "README.md"
RATES = "score/tables/main.csv"
REPORT = "score/report.html"
NEEDED = (RUN_HEADER, RUN_RECORD, *RUN_TABLES, CARD, RATES)
"""Files of `publish-results` that rules read."""

_BURIED = "k7"
_RANKED_KINDS = ("k", "day")

_PINNED = re.compile(r"[^@\s]+/[^@\s]+@[0-9a-f]{40}")


class Grid:
    """What the buffer set of a board expects of every system.

    Attributes:
        buffer_set: The buffer set.
        revision: Its identity, which rows have.
        conditions: The paper's conditions that it has, in order; without these, all of them.
        last: The condition that systems are ranked by.
        manifests: Every buffer by episode and condition.
    """

    def __init__(self, buffer_set: BufferSet):
        self.buffer_set = buffer_set
        self.revision = buffer_set.revision
        self.manifests: dict[tuple[EpisodeId, str], BufferManifest] = {
            (manifest.episode_id, manifest.condition): manifest
            for manifest in buffer_set.planned_manifests()
        }
        paper = tuple(name for name in DEFAULT_CONDITIONS if name in buffer_set.conditions)
        self.conditions = paper or buffer_set.conditions
        self.last = ranked_by(self.conditions)

    @classmethod
    def of(cls, entries: Entries, board: Board) -> "Grid | None":
        """Return that of a board; None if the board names no buffer set.

        Raises:
            FormatError: The board names a repository without its commit: it could change.
        """
        if board.buffer_set is None:
            return None
        location = entries.locate(board.buffer_set)
        if isinstance(location, str) and not _PINNED.fullmatch(location):
            raise FormatError(
                f"the buffer_set of the board {board.name} is {location}; expected "
                "namespace/name@ and the 40 digits of a commit"
            )
        return cls(load_buffer_set(location))

    def episodes(self, condition: str) -> list[EpisodeId]:
        """Return the query episodes of a condition."""
        return [episode for episode, name in self.manifests if name == condition]


def ranked_by(conditions: Sequence[str]) -> str:
    """Return the condition that systems are ranked by.

    It is k7, or else, of k<n> and of whole days, the one with the most sessions.
    """
    parsed = map(parse_condition, conditions)
    ranked = [each for each in parsed if each.kind.name in _RANKED_KINDS]
    most = max(ranked, key=lambda each: (each.name == _BURIED, each.k), default=None)
    return conditions[-1] if most is None else most.name


class Results:
    """A run that `publish-results` put somewhere, and that a submission names.

    Attributes:
        run: Its entry.
        fault: Why its files cannot be read; empty if they can.
        on_hub: Whether it is a repository on the Hub.
        paths: Its files.
        folder: Where they are on this machine.
        header: Its `run.json`.
        rows: The rows that count, in the order of the record.
    """

    def __init__(self, run: PublishedRun, entries: Entries):
        self.run = run
        self.fault = ""
        self.paths: frozenset[str] = frozenset()
        try:
            self._open(entries.locate(run.results))
        except (InterferenceError, OSError) as error:
            self.fault = first_line(error)

    def _open(self, location: str | Path) -> None:
        files = locate(location)
        self.on_hub = isinstance(files, HubFiles)
        if isinstance(files, HubFiles):
            if not _PINNED.fullmatch(str(location)):
                raise MissingFileError(
                    f"{location} is not namespace/name@ and the 40 digits of a commit"
                )
            self.paths = frozenset(files.sizes())
            page = HubCall(files.repo_id).page
            self._files_at = f"{page}/blob/{files.commit}"
            self._folders_at = f"{page}/tree/{files.commit}"
        else:
            self.paths = frozenset(all_files(files.root))
            self._files_at = self._folders_at = files.location
        if missing := [name for name in NEEDED if name not in self.paths]:
            raise MissingFileError(f"{location} lacks {', '.join(missing)}")
        self.folder = files.snapshot(*NEEDED)
        self.header = read_header(self.folder / RUN_HEADER, RunHeader)
        self.rows = _rows(self.folder / RUN_RECORD)

    @cached_property
    def links(self) -> Mapping[str, str]:
        """What readers open, by name, as addresses or paths."""
        files = {"rows": RUN_TABLES[0], "card": CARD, "report": REPORT}
        links = {
            name: f"{self._files_at}/{path}" for name, path in files.items() if path in self.paths
        }
        if videos := sorted({row.video for row in self.rows if row.video} & self.paths):
            links["videos"] = f"{self._folders_at}/{videos[0].partition('/')[0]}"
        return links


def _rows(path: Path) -> list[Rollout]:
    rows = []
    for number, line in enumerate(whole_lines(path).splitlines(), 1):
        try:
            row = row_of(line)
            _ = row.episode_id  # raises, if it is none
            rows.append(row)
        except ValueError as error:
            reason = first_line(error)
            raise FormatError(f"{path.name}, line {number} is no row: {reason}") from None
    kept = rows_that_count([row.key for row in rows], [row.status for row in rows])
    return [rows[place] for place in kept]


@dataclass(frozen=True)
class Case:
    """A submission with all that rules look at.

    Attributes:
        submission: The entry.
        board: Its board.
        grid: What the buffer set of the board expects; None if the board has none.
        results: Its runs.
        taken: Labels of systems that are on the board already.
    """

    submission: Submission
    board: Board
    grid: Grid | None
    results: tuple[Results, ...]
    taken: frozenset[str]

    @property
    def readable(self) -> bool:
        """Whether the rows of all runs could be read."""
        return not any(each.fault for each in self.results)

    @cached_property
    def rows(self) -> list[Rollout]:
        """The rows of all runs."""
        return [row for each in self.results for row in each.rows]


def open_case(
    entries: Entries, submission: Submission, grid: Grid | None, taken: frozenset[str]
) -> Case:
    """Fetch what a submission names."""
    results = tuple(Results(run, entries) for run in submission.runs)
    return Case(submission, entries.board(submission.board), grid, results, taken)
