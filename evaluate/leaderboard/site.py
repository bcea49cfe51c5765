"""A leaderboard: its submissions checked, its boards scored, and the site that shows them."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from robomme_interference_data.constants import FORMAT_VERSION, OFFICIAL
from robomme_interference_data.errors import FormatError, InterferenceError
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.score.rows.values import Row
from robomme_interference_data.storage.files import all_files, write_json, write_text
from robomme_interference_data.viz.tables import Columns, Table

from .entries import Board, BoardStanding, Entries
from .page import write_page
from .published import Grid, open_case
from .rules import RULES, BrokenRule, check
from .standings import BoardRows, BoardSystem, Standings, settings_of

DATA = "leaderboard.json"
PAGE = "index.html"


@dataclass(frozen=True)
class Leaderboard:
    """All boards that have rows, and what was not accepted."""

    boards: tuple[Standings, ...]
    problems: tuple[BrokenRule, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return everything as plain values, for JSON."""
        return _rounded(
            {
                "format_version": FORMAT_VERSION,
                "boards": [board.to_dict() for board in self.boards],
                "refused": [
                    {
                        "system": problem.system,
                        "rule": problem.rule.number,
                        "about": problem.rule.name,
                        "what": problem.what,
                        "fix": problem.rule.fix,
                    }
                    for problem in self.problems
                ],
                "rules": {str(rule.number): rule.name for rule in RULES},
            }
        )


def _rounded(value: Any) -> Any:
    """Return plain values with six decimals: the last ones depend on the machine."""
    if isinstance(value, float):
        return round(value, 6) + 0.0
    if isinstance(value, dict):
        return {name: _rounded(inner) for name, inner in value.items()}
    return [_rounded(inner) for inner in value] if isinstance(value, list) else value


def check_all(entries: Entries) -> list[BrokenRule]:
    """Return what does not hold of any submission."""
    return [problem for board in entries.boards for problem in _gather(entries, board).problems]


def make_leaderboard(entries: Entries, released: Sequence[Path] = ()) -> Leaderboard:
    """Check and score everything.

    Args:
        entries: The file of the leaderboard.
        released: Files with rows of the paper's systems, for the board of the official simulator.
    """
    boards, problems = list[Standings](), list[BrokenRule]()
    papers = [board.name for board in entries.boards if board.simulator == OFFICIAL]
    if released and not papers:
        raise FormatError(
            f"no board has the simulator {OFFICIAL}, which the paper's rows are of",
            f"Add one, with simulator: {OFFICIAL}.",
        )
    for board in entries.boards:
        paper = tuple(released) if board.name in papers[:1] else ()
        gathered = _gather(entries, board, paper)
        problems += gathered.problems
        if gathered.rows:
            boards.append(Standings(board, gathered.grid, gathered.rows, gathered.shown))
    return Leaderboard(tuple(boards), tuple(problems))


def write_site(made: Leaderboard, out: Path) -> dict[str, Any]:
    """Write the page, its data as JSON, and the rows of each board as CSV; return the data."""
    out.mkdir(parents=True, exist_ok=True)
    data = made.to_dict()
    with TemporaryDirectory(dir=out, prefix=".", suffix=".partial") as name:
        folder = Path(name)
        for board in made.boards:
            write_text(folder / "rows" / f"{board.board.name}.csv", _rows_table(board).csv())
        write_json(folder / DATA, data)
        write_page(data, folder / PAGE, out)
        written = all_files(folder)
        for path in written:
            (out / path).parent.mkdir(exist_ok=True)
            (folder / path).replace(out / path)
    for table in (out / "rows").glob("*.csv"):
        if f"rows/{table.name}" not in written and _is_rows_table(table):  # of a board that is gone
            table.unlink()
    return data


# --- one board -----------------------------------------------------------------------------------


@dataclass
class _Gathered:
    """What is on a board, and why submissions are not."""

    grid: Grid | None
    rows: list[BoardRows] = field(default_factory=list)
    shown: dict[str, BoardSystem] = field(default_factory=dict)
    problems: list[BrokenRule] = field(default_factory=list)


def _gather(entries: Entries, board: Board, released: tuple[Path, ...] = ()) -> _Gathered:
    """Check everything that is listed for a board."""
    gathered = _Gathered(Grid.of(entries, board))
    for reference in [each for each in entries.references if each.board == board.name]:
        paths = tuple(entries.folder / path for path in reference.rows)
        rows = BoardRows(paths, reference.system)
        _add(gathered, board, rows, BoardStanding(reference.standing), reference.trained_on)
    if released:
        _add(gathered, board, BoardRows(released), BoardStanding.PAPER, None)
    for submission in [each for each in entries.submissions if each.board == board.name]:
        system = submission.system
        case = open_case(entries, submission, gathered.grid, frozenset(gathered.shown))
        if problems := check(case):
            gathered.problems += problems
            continue
        rows = BoardRows(tuple(each.folder for each in case.results))
        if contradiction := _contradiction([*gathered.rows, rows]):
            gathered.problems.append(BrokenRule(system, RULES[-1], contradiction))
            continue
        gathered.rows.append(rows)
        shown = BoardSystem(system, BoardStanding.SUBMISSION, submission.trained_on, case)
        gathered.shown[system] = shown
    return gathered


def _contradiction(rows: Sequence[BoardRows]) -> str:
    """Return why the rows of a board cannot be scored together; empty if they can."""
    settings = settings_of(rows)
    try:
        read_rows(settings.rows, settings.system)
    except InterferenceError as error:
        return " ".join(error.message.splitlines())  # the first line only counts the bad rows
    return ""


def _add(
    gathered: _Gathered, board: Board, rows: BoardRows, standing: BoardStanding, trained: str | None
) -> None:
    """Add rows that are not ranked, whose simulator and buffer set are those of the board."""
    read = read_rows(rows.paths, [] if rows.system is None else [rows.system])
    expected = None if gathered.grid is None else gathered.grid.revision
    for simulator in read.names("simulator"):
        revision = read.revisions.get(simulator)
        # Rows without a revision, such as the paper's, are compared unpaired.
        other = None not in (expected, revision) and expected != revision
        if simulator != board.simulator or other:
            paths = ", ".join(map(str, rows.paths))
            raise FormatError(
                f"{paths}: rows of the simulator {simulator} and the buffer set {revision}; the "
                f"board {board.name} has {board.simulator} and {expected or 'none'}",
                "Name them on a board of their own.",
            )
    gathered.rows.append(rows)
    for system in read.names("system"):
        gathered.shown.setdefault(system, BoardSystem(system, standing, trained))


_COLUMNS: Columns = {
    "system": "text",
    "condition": "text",
    "family": "text",
    "split": "text",
    "episode": "count",
    "training_seed": "count",
    "model_seed": "count",
    "status": "text",
    "success": "flag",
    "steps": "count",
}


def _rows_table(board: Standings) -> Table:
    rows = [row for row in board.scored.rows if row.simulator == board.board.simulator]
    rows.sort(key=_order)
    values = [tuple(getattr(row, name) for name in _COLUMNS) for row in rows]
    return Table("rows", board.board.name, _COLUMNS, values)


def _is_rows_table(path: Path) -> bool:
    """Return whether a file has the columns of `rows/`: others are not of a leaderboard."""
    with path.open(encoding="utf-8", errors="replace") as file:
        return file.readline().rstrip("\n") == ",".join(_COLUMNS)


def _order(row: Row) -> tuple[Any, ...]:
    training_seed = -1 if row.training_seed is None else row.training_seed
    episode = (row.family, row.split, row.episode)
    return (row.system, row.condition, *episode, training_seed, row.model_seed)
