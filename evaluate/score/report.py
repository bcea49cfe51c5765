"""One self-contained page about a score. It needs no network and no other file."""

import base64
import json
import math
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata, resources
from itertools import islice
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import MissingExtraError
from robomme_interference_data.evaluate.rows import condition_rank
from robomme_interference_data.evaluate.score.cells import MainGrid, main_grids, main_note
from robomme_interference_data.evaluate.score.episodes import episode_rows
from robomme_interference_data.evaluate.score.figures import FIGURES
from robomme_interference_data.evaluate.score.grid import Grid
from robomme_interference_data.evaluate.score.headline import headline
from robomme_interference_data.evaluate.score.read import Source
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.files import atomic_path, sha256_file
from robomme_interference_data.tables import Table

__all__ = ["load_jinja2", "write_report"]

MOST_EPISODES = 20_000
"""So many rows of single episodes a page holds at most."""

_LIBRARIES = ("robomme-interference-data", "numpy", "pyarrow", "matplotlib")
"""What the numbers and pictures depend on."""

_RUN_FIELDS = (
    *("status", "command", "identity", "split", "revision", "simulator", "system", "policy"),
    *("versions", "git", "machine", "planned", "counts"),
)
"""What is shown of a run's `run.json`, as far as it is there."""
_GRIDS = {
    Grid.BENCHMARK: "the benchmark's: nine families, test episodes 0 to 49 each",
    Grid.GIVEN: "those that any of the given rows is of",
}


def write_report(
    score: Score, figures: Mapping[str, Path], out: Path, command: str | None = None
) -> None:
    """Write the page: the same bytes for the same rows, options and command.

    Args:
        score: What it shows.
        figures: Names and SVG files, as `draw_figures` returns them.
        out: The HTML file.
        command: The command line that made the score; None shows the call of `score`.

    Raises:
        MissingExtraError: jinja2 is not installed.
    """
    jinja2 = load_jinja2()
    template = resources.files(__package__).joinpath("templates", "report.html.j2")
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    html = environment.from_string(template.read_text(encoding="utf-8")).render(
        simulators=[{"name": s, "headline": headline(score, s)} for s in score.expected],
        grids=[_grid(grid) for grid in main_grids(score.cells)],
        note=main_note(score.cells),
        tables=[_table(table) for table in score.tables.values()],
        figures=[_figure(name, path) for name, path in figures.items()],
        conditions=_conditions(score),
        episodes=_episodes(score, out.parent),
        most=MOST_EPISODES,
        sources=[_source(source) for source in score.rollouts.sources],
        facts=_facts(score, command),
    )
    with atomic_path(out) as partial:
        partial.write_text(html, encoding="utf-8", newline="\n")


def load_jinja2() -> Any:
    """Return the library that fills in the page.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import jinja2
    except ImportError as error:
        raise MissingExtraError(
            "the report needs jinja2",
            'Install it: pip install "robomme-interference-data[score]"',
        ) from error
    return jinja2


def _grid(grid: MainGrid) -> dict[str, Any]:
    """Return the main table of a simulator: of each cell its text, and whether it is the best."""
    rows = [
        (system, [(text.replace("**", ""), text.startswith("**")) for text in shown])
        for system, shown in grid.rows
    ]
    return {"simulator": grid.simulator, "conditions": grid.conditions, "rows": rows}


def _table(table: Table) -> dict[str, Any]:
    """Return what the page needs of a table: shown cells, and values to sort by."""
    rows = []
    for row in table.rows:
        shown = table.cells(row)
        for place, column in enumerate(table.columns):
            if column.name.endswith("system") or column.name == "no_history_of":
                shown[place] = display_name(row[place])
            elif column.name == "complete" and not row[place]:
                shown[place] += "†"
        cells = [(text, _sortable(value)) for text, value in zip(shown, row, strict=True)]
        rows.append({"cells": cells, "incomplete": any(text == "no†" for text in shown)})
    return {
        "name": table.name,
        "title": table.title,
        "note": table.note,
        "columns": [
            {"name": c.name.replace("_", " "), "number": c.kind not in ("text", "flag")}
            for c in table.columns
        ],
        "rows": rows,
    }


def _sortable(value: Any) -> str | None:
    """Return a number to sort by; None where the text itself is what sorts."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None if value is not None else ""
    return "" if math.isnan(value) else repr(value)


def _figure(name: str, path: Path) -> dict[str, str]:
    kind, _, simulator = name.partition("-")
    data = base64.b64encode(path.read_bytes()).decode()
    return {
        "name": name,
        "title": f"{FIGURES[kind]}, {simulator}",
        "note": "†: the cell is not complete." if kind == "heatmap" else "",
        "source": f"data:image/svg+xml;base64,{data}",
    }


def _conditions(score: Score) -> list[str]:
    return sorted({c for one in score.outcomes for c in one.conditions}, key=condition_rank)


def _episodes(score: Score, folder: Path) -> dict[str, Any]:
    """Return the rows of single episodes as JSON that is safe inside a script element."""
    rows = islice(episode_rows(score.outcomes, score.rollouts, folder), MOST_EPISODES)
    conditions = _conditions(score)
    data = [
        [
            *(row.simulator, display_name(row.system), *row.episode.split("/", 1), row.difficulty),
            [row.outcomes.get(condition, "") for condition in conditions],
            row.flips,
            [row.videos.get(condition, "") for condition in conditions],
        ]
        for row in rows
    ]
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")
    return {"json": text, "total": sum(len(one.episodes) for one in score.outcomes)}


@dataclass(frozen=True)
class _Fact:
    """Something about how a score or a run was made; code may be copied, a line each."""

    name: str
    lines: Sequence[str]
    code: bool = False


def _source(source: Source) -> dict[str, Any]:
    facts = [_Fact("SHA-256", [sha256_file(source.path)])]
    for name in _RUN_FIELDS:
        value = source.record.get(name)
        if name == "command" and value:  # a list of command lines: a joined run has several
            facts.append(_Fact(name, value, code=True))
        elif value not in (None, "", {}, []):
            facts.append(_Fact(name, [_told(value)]))
    return {"path": str(source.path), "facts": facts}


def _told(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {_told(part)}" for name, part in sorted(value.items()))
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def _facts(score: Score, command: str | None) -> list[_Fact]:
    rollouts = score.rollouts
    versions = [f"{name} {metadata.version(name)}" for name in _LIBRARIES]
    told = {
        "scored with": ", ".join([f"Python {platform.python_version()}", *versions]),
        "rows": f"{len(rollouts.packed):,}",
        "episodes of a complete cell": _GRIDS[score.grid],
        "bootstrap": f"{score.draws:,} draws, seeded by the simulator, clustered by episode",
    }
    if len(rollouts.model_seeds) > 1:
        told["model seeds"] = ", ".join(map(str, rollouts.model_seeds[:20]))
    for simulator, revision in rollouts.revisions.items():
        told[f"revision of the split, {simulator}"] = revision
    if score.notes:
        told["note"] = "; ".join(score.notes)
    if rollouts.refused:
        named = "; ".join(map(str, rollouts.refusals))
        told["bad rows left out"] = f"{rollouts.refused:,}: {named}"
    made = _Fact("command" if command else "call", [command or score.call], code=True)
    return [made, *(_Fact(name, [text]) for name, text in told.items())]
