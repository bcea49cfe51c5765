"""What a card of results tells, computed from the rows of a run."""

import re
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from robomme_interference_data.constants import PROTOCOL_VERSION, RUN_TABLES
from robomme_interference_data.errors import InvalidOptionError
from robomme_interference_data.evaluate.run.log import RunHeader
from robomme_interference_data.evaluate.score.config import Grid, Settings
from robomme_interference_data.evaluate.score.plots.curves import Data
from robomme_interference_data.evaluate.score.plots.figures import draw_figure
from robomme_interference_data.evaluate.score.report.headline import headline
from robomme_interference_data.evaluate.score.scoring import Score, score
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.rollouts import FINAL, Rollout
from robomme_interference_data.storage.files import sha256_file
from robomme_interference_data.viz.figure import open_figure, save_figure
from robomme_interference_data.viz.tables import Table

from .columns import Column, columns_of
from .facts import one_split
from .limits import simulated
from .markdown import Raw, code, escape
from .metadata import ROLLOUTS, config
from .publication import Publication

_GRIDS = {
    Grid.BENCHMARK: "the benchmark's: nine families, test episodes 0 to 49 each",
    Grid.GIVEN: "the episodes that any of the rows is of",
}


@dataclass(frozen=True)
class ResultsFacts:
    """What there is to say of results.

    Attributes:
        score: What came of the rollouts.
        source: The file of rows that was scored.
        run: What `run.json` beside it says, or None.
    """

    score: Score
    source: Path
    run: RunHeader | None

    @classmethod
    def of(cls, results: Score | Path) -> "ResultsFacts":
        """Return the facts of a score, or of a run's folder or file of rows.

        Raises:
            InvalidOptionError: The score is of several files.
            MissingFileError, FormatError: See `scoring.score`.
        """
        found = results if isinstance(results, Score) else score(Settings(rows=(results,)))
        if len(found.rows.sources) != 1:
            raise InvalidOptionError(
                f"the score is of {len(found.rows.sources)} files; expected those of one run",
                "Shards of a run become one with: robomme-interference merge",
            )
        [(source, run)] = found.rows.sources.items()
        return cls(found, source, run)

    @property
    def base(self) -> object:
        """What the run says of where its split lies: `namespace/name@commit` on the Hub."""
        starts = self.run.starts if self.run is not None else ()
        return starts[-1].settings.get("split") if starts else None

    @cached_property
    def rows_file(self) -> Path:
        """The file of rows that tables are loaded from: the exported one if it is there."""
        exported = self.source.parent / RUN_TABLES[0]
        return exported if self.run is not None and exported.is_file() else self.source

    @property
    def split_name(self) -> str:
        """`test` if all rows are of that split, and so on; `mixed` if they differ."""
        return one_split(self.score.rows.names("episode_split"))

    @property
    def config(self) -> dict[str, Any]:
        """The table of rows as `load_dataset` finds it."""
        return config(ROLLOUTS, self.split_name, self.rows_file.name, default=True)

    @property
    def columns(self) -> tuple[Column, ...]:
        """The columns of a row."""
        return columns_of(Rollout)

    @property
    def systems(self) -> list[str]:
        """The systems, as tables name them."""
        names = (name for cube in self.score.outcomes.values() for name in cube.systems)
        return list(map(display_name, dict.fromkeys(names)))

    @property
    def limits(self) -> list[str]:
        """What the results do not tell, as plain text, a sentence or two each."""
        found = [simulated(tuple(self.score.outcomes)), *self.score.notes]
        if not all(cell.complete for cell in self.score.cells if not cell.part):
            found.append(
                "Not every cell is complete: rates over parts of the grid cannot be compared with "
                "rates over all of it."
            )
        found.append(
            "The same episode, repeated on a GPU, may come out otherwise: small differences need "
            "the paired tests, or repeats with other model seeds."
        )
        return found

    @property
    def standing(self) -> str:
        """How the run stands, in a sentence."""
        cells = [cell for cell in self.score.cells if not cell.part]
        done = sum(cell.complete for cell in cells)
        told = f"{done} of {len(cells)} cells are complete."
        if self.run is None:
            return told
        counted = sum(self.run.counts.values())
        run = f"The run is {self.run.status}: {counted:,} of {self.run.planned:,} planned rollouts"
        return f"{run} have a row. {told}"

    @cached_property
    def figures(self) -> dict[str, str]:
        """The simulators of which there is a figure, by the file of its picture."""
        return {
            f"README-{re.sub('[^A-Za-z0-9._-]', '-', simulator)}.png": simulator
            for simulator in self.score.outcomes
            if Data(self.score, simulator).cells
        }

    def pictures(self) -> dict[str, bytes]:
        """Draw the figures: success by condition.

        Raises:
            MissingExtraError: matplotlib is not installed.
        """
        with TemporaryDirectory() as folder:
            for file, simulator in self.figures.items():
                with open_figure() as figure:
                    draw_figure("success", figure, Data(self.score, simulator))
                    save_figure(figure, Path(folder) / file)
            return {file: (Path(folder) / file).read_bytes() for file in self.figures}

    def provenance(self, about: Publication) -> list[tuple[str, Any]]:
        """Return where the results come from: split, revision, rows and policy."""
        rows: list[tuple[str, Any]] = []
        if self.run is not None:
            rows.append(("split", code(self.run.split)))
        if about.base:
            rows.append(("published split", code(about.base)))
        for simulator, revision in sorted(self.score.rows.revisions.items()):
            rows.append((f"revision of the split, {escape(simulator)}", code(revision)))
        if self.score.rows.unpinned:
            rows.append(("revision of the split", "the rows name none"))
        rows.append((f"SHA-256 of `{self.rows_file.name}`", code(sha256_file(self.rows_file))))
        if self.run is not None:
            policy = self.run.identity.get("policy")
            rows.append(("policy", code(policy) if policy else "not told"))
            for start in self.run.starts[-1:]:
                rows += [("git", code(start.git))] if start.git else []
                told = (f"{name} {version}" for name, version in sorted(start.versions.items()))
                rows.append(("versions of the last start", escape(", ".join(told))))
        return [*rows, ("version of the protocol", code(PROTOCOL_VERSION))]

    @property
    def details(self) -> dict[str, Any]:
        """What makes the run the one that it is, and how it was started, as plain values."""
        if self.run is None:
            return {}
        commands = dict.fromkeys(line for start in self.run.starts for line in start.command)
        found: dict[str, Any] = {"What makes the run the one that it is": self.run.identity}
        if commands:
            found["Its commands"] = [*commands]
        return found


def results_values(facts: ResultsFacts) -> dict[str, Any]:
    """Return what the template of results names, but for publication and provenance."""
    found = facts.score
    effects = found.tables["effects"]
    statuses = Counter(row.status for row in found.rows)
    return {
        "systems": facts.systems,
        "headlines": {name: headline(found, name) for name in found.outcomes},
        "figures": {
            file: f"Success by condition, {simulator}" for file, simulator in facts.figures.items()
        },
        "grids": [{"title": one.title, "table": one, "note": Raw(one.note)} for one in found.grids],
        "effects": {"table": effects, "note": Raw(effects.note)} if effects.rows else None,
        "standing": facts.standing,
        "grid": _GRIDS[found.settings.grid],
        "cells": _cells(found),
        "rows": len(found.rows),
        "rows_file": facts.rows_file.name,
        "statuses": ", ".join(f"{statuses[one]:,} {one}" for one in FINAL),
        "refused": found.rows.refused,
        "split_name": facts.split_name,
        "limits": facts.limits,
    }


def _cells(found: Score) -> Table:
    """Return the main table without what the grid shows already."""
    rows = [
        (
            *(cell.simulator, display_name(cell.system), cell.condition, cell.n, cell.expected),
            *(len(cell.missing), cell.errors, cell.complete),
        )
        for cell in found.cells
        if not cell.part
    ]
    columns = "simulator system condition n:count expected:count missing:count errors:count"
    return Table.make("cells", "Cells", f"{columns} complete:flag", rows)
