"""A leaderboard: its submissions checked, its boards scored, and the site that shows them."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from robomme_interference_data.constants import FORMAT_VERSION, OFFICIAL
from robomme_interference_data.errors import FormatError
from robomme_interference_data.evaluate.score.rows.reading import read_rows
from robomme_interference_data.evaluate.score.rows.values import Row
from robomme_interference_data.storage.files import write_json, write_text
from robomme_interference_data.viz.tables import Columns, Table

from .entries import Board, Entries, Reference, Standing
from .page import slug, write_page
from .published import Grid, open_case
from .rules import RULES, Problem, check
from .standings import Rows, Shown, Standings

DATA = "leaderboard.json"
PAGE = "index.html"


@dataclass(frozen=True)
class Leaderboard:
    """All boards that have rows, and what was not accepted."""

    boards: tuple[Standings, ...]
    problems: tuple[Problem, ...]

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


def check_all(entries: Entries) -> list[Problem]:
    """Return what does not hold of any submission."""
    return [problem for board in entries.boards for problem in _gather(entries, board)[1]]


def make_leaderboard(entries: Entries, released: Sequence[Path] = ()) -> Leaderboard:
    """Check and score everything.

    Args:
        entries: The file of the leaderboard.
        released: Files with rows of the paper's systems, for the board of the official simulator.
    """
    boards, problems = list[Standings](), list[Problem]()
    papers = [board.name for board in entries.boards if board.simulator == OFFICIAL]
    if released and not papers:
        raise FormatError(
            f"no board has the simulator {OFFICIAL}, which the paper's rows are of",
            f"Add one, with simulator: {OFFICIAL}.",
        )
    for board in entries.boards:
        paper = tuple(released) if board.name in papers[:1] else ()
        gathered, found = _gather(entries, board, paper)
        problems += found
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
            write_text(folder / "rows" / f"{slug(board.board.name)}.csv", _rows_table(board).csv())
        write_json(folder / DATA, data)
        write_page(data, folder / PAGE, out)
        shutil.rmtree(out / "rows", ignore_errors=True)  # of boards that are gone
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            target = out / path.relative_to(folder)
            target.parent.mkdir(exist_ok=True)
            path.replace(target)
    return data


# --- one board -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Gathered:
    grid: Grid | None
    rows: Sequence[Rows]
    shown: dict[str, Shown]


def _gather(
    entries: Entries, board: Board, released: tuple[Path, ...] = ()
) -> tuple[_Gathered, list[Problem]]:
    """Return what is on a board, and why submissions are not."""
    grid = Grid.of(entries, board)
    rows, shown, problems = list[Rows](), dict[str, Shown](), list[Problem]()
    for reference in [each for each in entries.references if each.board == board.name]:
        rows.append(_rows_of(entries, reference))
        standing = Standing(reference.standing)
        _show(shown, rows[-1], standing, reference.trained_on)
    if released:
        rows.append(Rows(released))
        _show(shown, rows[-1], Standing.PAPER, None)
    for submission in [each for each in entries.submissions if each.board == board.name]:
        case = open_case(entries, submission, grid, frozenset(shown))
        if found := check(case):
            problems += found
            continue
        rows.append(Rows(tuple(each.folder for each in case.results)))
        system = submission.system
        shown[system] = Shown(system, Standing.SUBMISSION, submission.trained_on, case)
    return _Gathered(grid, rows, shown), problems


def _rows_of(entries: Entries, reference: Reference) -> Rows:
    paths = tuple(Path(entries.locate(path)) for path in reference.rows)
    return Rows(paths, reference.system)


def _show(shown: dict[str, Shown], rows: Rows, standing: Standing, trained: str | None) -> None:
    """Add the systems of some rows."""
    stated = [] if rows.system is None else [rows.system]
    for system in read_rows(rows.paths, stated).names("system"):
        shown.setdefault(system, Shown(system, standing, trained))


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


def _order(row: Row) -> tuple[Any, ...]:
    training_seed = -1 if row.training_seed is None else row.training_seed
    episode = (row.family, row.split, row.episode)
    return (row.system, row.condition, *episode, training_seed, row.model_seed)
