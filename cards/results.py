"""The results of a run: the facts of their card, and the files of their repository."""

import re
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from robomme_interference_data.constants import (
    PROTOCOL_VERSION,
    RECORDINGS,
    RUN_HEADER,
    RUN_RECORD,
    RUN_TABLES,
)
from robomme_interference_data.errors import InvalidOptionError, PublishError
from robomme_interference_data.evaluate.run.record import RunHeader
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.config import Expected, Settings
from robomme_interference_data.evaluate.score.outcomes import STATUSES
from robomme_interference_data.evaluate.score.plots.data import Data
from robomme_interference_data.evaluate.score.plots.figures import draw_error_figure, draw_figure
from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.scoring import Score, score
from robomme_interference_data.evaluate.score.tables.cells import Coverage
from robomme_interference_data.evaluate.score.writing import write_score
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.rollouts import Status
from robomme_interference_data.storage.files import sha256_file
from robomme_interference_data.viz.figure import open_figure, save_figure
from robomme_interference_data.viz.tables import Columns, Table

from .facts import CardTable, Facts, ProvenanceRows, origin_limit
from .markdown import Raw, code, escape
from .publication import Publication, Version
from .render import card_files
from .repo import LocalFile, RepoFiles
from .repo_plan import RepoContent

_ERROR_PICTURE = f"README-{RECORDINGS}.png"

_EXPECTED = {
    Expected.BENCHMARK: "those of the benchmark, nine families with test episodes 0 to 49 each",
    Expected.OBSERVED: "all episodes in the rows",
}


# --- the card ------------------------------------------------------------------------------------


def results_facts(results: Score | Path) -> Facts:
    """Return what the card of results states.

    Args:
        results: The folder of a run, a file of rows, or the score of either.
    """
    scored = results if isinstance(results, Score) else score(Settings(rows=(results,)))
    if len(scored.rows.sources) != 1:
        raise InvalidOptionError(
            f"the score is of {len(scored.rows.sources)} files of rows; expected one run",
            "Merge the shards of a run.",
            "merge RUN RUN --out RUN",
        )
    [(source, run)] = scored.rows.sources.items()
    exported = source.parent / RUN_TABLES[0]
    file = exported if run is not None and exported.is_file() else source
    splits = {*scored.rows.names("split")}
    rows = CardTable(
        name="rollouts",
        record=Rollout,
        path=file.name,
        split=splits.pop() if len(splits) == 1 else "mixed",
    )
    all_outcomes = scored.all_outcomes
    systems = dict.fromkeys(name for outcomes in all_outcomes for name in outcomes.systems)
    names = list(map(display_name, systems))
    offline = not scored.outcomes
    figures = {
        f"README-{re.sub('[^A-Za-z0-9._-]', '-', simulator)}.png": simulator
        for simulator in scored.outcomes
        if Data(scored, simulator).cells
    }
    captions = {file: f"Success by condition, {name}" for file, name in figures.items()}
    if any(cell.n for cell in scored.error_cells):
        captions[_ERROR_PICTURE] = "Action error by condition, offline"
    differences = [
        scored.tables[name] for name in ("effects", "action_error_effects") if name in scored.tables
    ]
    statuses = Counter(row.status for row in scored.rows)
    what = "Action errors of" if offline else "Rollouts of"
    invocations = run.invocations if run is not None else ()
    return Facts(
        kind="results",
        title="RoboMME-Interference results",
        examples=len(scored.rows),
        tables=[rows],
        simulators=tuple(outcomes.simulator for outcomes in all_outcomes),
        simulated=not offline,
        limits=_limits(scored),
        provenance=_provenance(scored, run, file),
        pictures=lambda: _pictures(scored, figures),
        values={
            "systems": names,
            "what": what,
            "unit": "recording" if offline else "rollout",
            "error_counts": "does not count"
            if offline
            else "counts neither as success nor as failure",
            # A sentence each, because a card shortens long texts.
            "headlines": [headline(scored, each.simulator) for each in all_outcomes],
            "figures": captions,
            "grids": [
                {"title": table.title, "table": table, "note": Raw(table.note)}
                for table in scored.grids
            ],
            "differences": [{"table": table, "note": Raw(table.note)} for table in differences],
            "completeness": _completeness(scored, run),
            "grid": "all recordings in the rows and in the plan of the run"
            if offline
            else _EXPECTED[scored.settings.expected],
            "cells": _cells(scored),
            "rows": len(scored.rows),
            "rows_file": rows.path,
            "statuses": ", ".join(
                f"{statuses[status]:,} {status}"
                for status in STATUSES
                if statuses[status] or (status is Status.MEASURED) is offline
            ),
            "bad_rows": scored.rows.bad_count,
        },
        base_kind="buffer set",
        base=invocations[-1].settings.get("buffer_set") if invocations else None,
        details=_details(run),
        tags=("evaluation-results",),
    )


def _limits(scored: Score) -> list[str]:
    limits = [origin_limit([outcomes.simulator for outcomes in scored.all_outcomes]), *scored.notes]
    what = "success rates" if scored.outcomes else "action errors"
    if not all(cell.complete for cell in _whole(scored)):
        limits.append(
            f"Not every cell is complete: {what} of incomplete and complete cells are not "
            "comparable."
        )
    if scored.outcomes:
        limits.append(
            "Repeating an episode on a GPU may give another outcome: judge small differences by "
            "the paired tests, or repeat the run with other model seeds."
        )
    if scored.error_cells:
        limits.append(
            "A small action error does not imply success: the policy never sees the consequences "
            "of its own actions."
        )
    return limits


def _whole(scored: Score) -> list[Coverage]:
    """Return the cells over all episodes."""
    return [cell for cell in (*scored.cells, *scored.error_cells) if not cell.part]


def _completeness(scored: Score, run: RunHeader | None) -> str:
    """Return how complete the run is, in a sentence."""
    cells = _whole(scored)
    cell_text = f"{sum(cell.complete for cell in cells)} of {len(cells)} cells are complete."
    if run is None:
        return cell_text
    counted = sum(run.counts.values())
    run_text = f"The run is {run.status}: {counted:,} of {run.planned:,} planned rollouts have a"
    return f"{run_text} row. {cell_text}"


def _pictures(scored: Score, figures: dict[str, str]) -> dict[str, bytes]:
    """Draw success by condition, one picture per simulator, and the action error offline."""
    with TemporaryDirectory() as folder:
        for file, simulator in figures.items():
            with open_figure() as figure:
                draw_figure("success", figure, Data(scored, simulator))
                save_figure(figure, Path(folder) / file)
        if any(cell.n for cell in scored.error_cells):
            with open_figure() as figure:
                draw_error_figure(figure, scored)
                save_figure(figure, Path(folder) / _ERROR_PICTURE)
        return {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}


def _provenance(scored: Score, run: RunHeader | None, table: Path) -> ProvenanceRows:
    """Return the provenance of results: buffer set, revision, rows and policy."""
    rows: ProvenanceRows = (
        [("buffer set of the run", code(run.buffer_set))] if run is not None else []
    )
    for simulator, revision in sorted(scored.rows.revisions.items()):
        rows.append((f"revision of the buffer set, {escape(simulator)}", code(revision)))
    if scored.rows.without_revision:
        rows.append(("revision of the buffer set", "not in the rows"))
    rows.append((f"SHA-256 of `{table.name}`", code(sha256_file(table))))
    if run is not None:
        renderers = run.identity.get("renderers")
        for images, renderer in renderers.items() if isinstance(renderers, dict) else ():
            if renderer is not None:
                rows.append((f"renderer of the {escape(images)}", code(renderer)))
        policy = run.identity.get("policy")
        rows.append(("policy", code(policy) if policy else "not recorded"))
        if run.probed is not None:
            rows.append(("leak probe", escape(run.probed)))
        for invocation in run.invocations[-1:]:
            rows += [("git", code(invocation.git))] if invocation.git else []
            versions = (
                f"{name} {version}" for name, version in sorted(invocation.versions.items())
            )
            rows.append(("versions of the last invocation", escape(", ".join(versions))))
    return [*rows, ("version of the protocol", code(PROTOCOL_VERSION))]


def _details(run: RunHeader | None) -> dict[str, Any]:
    """Return the identity of the run and its commands."""
    if run is None:
        return {}
    details: dict[str, Any] = {"Identity of the run": run.identity}
    if commands := dict.fromkeys(
        line for invocation in run.invocations for line in invocation.command
    ):
        details["Commands"] = [*commands]
    return details


def _cells(scored: Score) -> Table:
    """Return the main table without the columns that the grid shows."""
    rows = [
        (
            cell.simulator,
            display_name(cell.system),
            cell.condition,
            cell.n,
            cell.expected,
            len(cell.missing),
            cell.errors,
            cell.complete,
        )
        for cell in _whole(scored)
    ]
    columns: Columns = {
        "simulator": "text",
        "system": "text",
        "condition": "text",
        "n": "count",
        "expected": "count",
        "missing": "count",
        "errors": "count",
        "complete": "flag",
    }
    return Table("cells", "Cells", columns, rows)


# --- the repository ------------------------------------------------------------------------------


def score_run(run: Path, expected: Expected = Expected.BENCHMARK) -> Score:
    """Score the run to publish, which has to be finished."""
    needed = (RUN_HEADER, RUN_RECORD, *RUN_TABLES)
    if missing := [name for name in needed if not (run / name).is_file()]:
        raise PublishError(
            f"{run} holds no finished run: {missing[0]} is missing",
            "Finish it with the same evaluate command, or give the folder of another run.",
        )
    return score(Settings(rows=(run,), expected=expected))


def results_content(scored: Score, run: Path, config: Publication) -> RepoContent:
    """Return the repository of a run's results, without videos of rollouts."""
    command = f"robomme-interference publish-results RUN --repo-id {config.repo_id}"
    files: RepoFiles = {
        name: LocalFile(run / name) for name in (RUN_HEADER, RUN_RECORD, *RUN_TABLES)
    }
    with TemporaryDirectory() as name:
        folder = Path(name)
        write_score(scored, folder, command=command)
        for path in sorted(path for path in folder.rglob("*") if path.is_file()):
            files[f"score/{path.relative_to(folder).as_posix()}"] = LocalFile(path.read_bytes())
    facts = results_facts(scored)

    def card(version: Version) -> dict[str, bytes]:
        return card_files(
            facts, Publication(config.repo_id, str(version), config.license, None, command)
        )

    return RepoContent(config.repo_id, Version(1, 0, 0), files, card, RUN_HEADER)
