"""The report: one self-contained page that needs no network and no other file."""

import json
import platform
import re
from collections.abc import Mapping
from html import escape
from importlib import metadata
from pathlib import Path

from robomme_interference_data.evaluate.run.record import RunHeader
from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.plots.data import FEW
from robomme_interference_data.evaluate.score.plots.figures import FIGURES
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.contrast import LESSON_ONLY
from robomme_interference_data.evaluate.score.tables.correction import NULL_FINDINGS
from robomme_interference_data.evaluate.systems import SYSTEMS
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.conditions import in_order
from robomme_interference_data.storage.files import sha256_file, write_text
from robomme_interference_data.viz.tables import Table
from robomme_interference_data.viz.templates import fill

from .episodes import episodes_json, names_of
from .primary import screens

_LIBRARIES = ("robomme-interference-data", "numpy", "pyarrow", "matplotlib")
"""Libraries that numbers and figures depend on."""

EXPLORATORY = (
    "Everything below is exploratory: it is corrected within a table or a part of one, not over "
    f"all tables. Without any effect, {NULL_FINDINGS} hold a finding in some table. Take one as a "
    "question for the next run."
)
"""What to make of findings outside the primary analysis."""

_GRIDS = {
    Expected.BENCHMARK: "the benchmark's: nine families, test episodes 0 to 49 each",
    Expected.OBSERVED: "those that occur in any row",
}


def write_report(
    score: Score,
    figures: Mapping[str, Path],
    out: Path,
    command: str | None = None,
    opened_in: Path | None = None,
) -> None:
    """Write the page: the same bytes for the same rows, options and command.

    It names videos relative to the folder that it is `opened_in`, by default that of `out`.
    """
    names = {name for outcomes in score.all_outcomes for name in outcomes.conditions}
    conditions = [condition.name for condition in in_order(names)] if names else []
    shown = screens(score)
    values = {
        "screens": shown,
        "exploratory": EXPLORATORY,
        "primary_figures": {name for screen in shown for name in screen.figures},
        "tables": score.tables.values(),
        "systems": names_of(score),
        "known": {name: system.display for name, system in SYSTEMS.items()},
        "leader": _leader(score),
        "figures": _inline(figures),
        "figure_kinds": FIGURES,
        "number": _number,
        "numbers": _numbers,
        "conditions": conditions,
        "episodes": episodes_json(score, conditions, opened_in or out.parent),
        "sources": {str(path): _source(path, run) for path, run in score.rows.sources.items()},
        "facts": _facts(score, command),
    }
    html = fill(__package__, "report.html.j2", values, what="the report", autoescape=True)
    write_text(out, html)


def _number(text: str) -> str:
    """Return the sort key of a cell of a grid; empty without a rate."""
    match = re.match(r"\**([0-9.]+)", text)
    return match[1] if match else ""


def _numbers(table: Table) -> list[str]:
    """Return the columns of numbers, which are aligned to the right."""
    return [name for name, shape in table.columns.items() if shape not in ("text", "flag")]


def _leader(score: Score) -> str:
    """Return the system that figures highlight initially; none if there are few."""
    best = [
        cell.system
        for cell in score.cells
        if cell.rank == 1 and not cell.part and cell.condition == LESSON_ONLY
    ]
    most = max((len(outcomes.systems) for outcomes in score.outcomes.values()), default=0)
    return best[0] if best and most > FEW else ""


def _inline(figures: Mapping[str, Path]) -> dict[str, str]:
    """Return SVGs for one page: ids are unique, and drawn elements carry their system."""
    inlined = {}
    for number, (name, path) in enumerate(figures.items()):
        figure, _, simulator = name.partition("-")
        text = path.read_text(encoding="utf-8")
        text = text[text.index("<svg") :]
        text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
        text = re.sub(r'id="system:([^":]*):[0-9]+"', r'data-system="\1"', text)
        text = re.sub(r' id="image[0-9a-f]+"', "", text)  # equal images share one
        text = re.sub(r'( id="|href="#|url\(#)', rf"\g<1>f{number}-", text)
        label = escape(f"{FIGURES[figure].title}, {simulator}")
        inlined[name] = text.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
    return inlined


# --- how it was made ---------------------------------------------------------------------------


def _source(path: Path, run: RunHeader | None) -> dict[str, list[str]]:
    """Return the facts about a file: its checksum, commands, and `run.json`."""
    facts = {"SHA-256": [sha256_file(path)]}
    if run is not None:
        lines = [line for invocation in run.invocations for line in invocation.command]
        facts |= {"command": [*dict.fromkeys(lines)]} if lines else {}
        facts |= {"leak probe": [run.probed]} if run.probed else {}
        facts["run.json"] = [json.dumps(to_dict(run), indent=2, sort_keys=True, ensure_ascii=False)]
    return facts


def versions() -> str:
    """Return the versions of Python and of the libraries."""
    libraries = [f"{name} {metadata.version(name)}" for name in _LIBRARIES]
    return ", ".join([f"Python {platform.python_version()}", *libraries])


def _facts(score: Score, command: str | None) -> dict[str, list[str]]:
    rows, settings = score.rows, score.settings
    call = {"command": command} if command else {"call": f"score({settings}, draws={score.draws})"}
    seeds = rows.names("model_seed")
    facts = {**call, "scored with": versions(), "rows": f"{len(rows):,}"}
    if score.outcomes:
        facts["episodes of a complete cell"] = _GRIDS[settings.expected]
    if score.recordings is not None:
        facts["recordings of a complete cell"] = "those in any row or in the plan of a run"
    facts["bootstrap"] = f"{score.draws:,} draws, seeded by the simulator, clustered by episode"
    if len(seeds) > 1:
        facts["model seeds"] = ", ".join(map(str, seeds[:20]))
    for name, revision in sorted(rows.revisions.items()):
        facts[f"revision of the buffer set, {name}"] = revision
    if score.notes:
        facts["note"] = " ".join(score.notes)
    if rows.bad_count:
        facts["bad rows left out"] = f"{rows.bad_count:,}: {'; '.join(rows.bad_reasons)}"
    return {name: [text] for name, text in facts.items()}
