"""The data of the figures of a score."""

import math
from collections.abc import Container, Sequence
from copy import copy
from typing import Any, Self

from robomme_interference_data.evaluate.score.partners import base_of
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.cells import SuccessCell
from robomme_interference_data.evaluate.score.tables.contrast import Verdict
from robomme_interference_data.evaluate.score.tables.correction import primary_falls
from robomme_interference_data.evaluate.systems import published_base
from robomme_interference_data.schema.conditions import (
    Condition,
    ConditionKind,
    in_order,
    parse_condition,
)
from robomme_interference_data.viz.figure import INK

from .styles import SeriesStyle, styles_of

PUBLISHED = ", published"
CHANCE = "(chance)"  # used like a system; no system's name contains brackets

FEW = 4
"""The most systems that panels draw intervals for."""


class Data:
    """The data of the figures of one simulator.

    Attributes:
        cells: What is drawn, by system, condition and part; published systems are named
            `<system>, published`.
        families: Families of the episodes, in canonical order.
        systems: Systems with rows.
        bases: System to the one without the retrieval step, or None.
        absent: Published systems without rows that a system with retrieval is compared with.
        beside: Published systems that have rows, drawn as dashes.
        styles: Style of each system and of the chance level.
        conditions: Conditions of the cells, in the order of tables.
        least: The fewest sessions of a condition with counted sessions.
        contrasts: Comparisons of the systems that have rows.
        flips: Share of outcomes that differ between repeats; None without repeats.
        distinguishable: Condition and pair of systems that are shown to differ, in `matrix`.
        by_evidence_kept: The rate of each level of evidence, as rows of `evidence_effects`.
        costs: The cost of each cell over all episodes, as rows of `cost`.
        falls: The primary fall of each system.
        family_falls: Its fall in each family, as rows of `parts`.
        chance: Success of guessing by part of the episodes, if all are questions.
    """

    def __init__(self, score: Score, simulator: str):
        self.simulator = simulator
        outcomes = score.outcomes[simulator]
        self.families = outcomes.families
        own = [cell for cell in score.cells if cell.simulator == simulator and cell.n]
        self.systems = list(dict.fromkeys(cell.system for cell in own))
        self.bases = {system: base_of(outcomes, system) for system in self.systems}
        self.contrasts = [each for each in score.contrasts if each.simulator == simulator]
        repeated, flips = outcomes.repeat_flips
        self.flips = flips / repeated if repeated else None
        self.distinguishable = {
            (record["condition"], frozenset((record["system"], record["against_system"])))
            for record in _records(score, "matrix", simulator)
            if record["verdict"] == Verdict.SHOWN
        }
        # Rows with `against_kept` compare two levels of evidence.
        self.by_evidence_kept = [
            record
            for record in _records(score, "evidence_effects", simulator)
            if not record["against_kept"]
        ]
        self.costs = _records(score, "cost", simulator)
        self.falls = {fall.system: fall for fall in primary_falls(self.contrasts, simulator)}
        self.family_falls = [
            record for record in _records(score, "parts", simulator) if record["fall_n"] is not None
        ]
        asked = sorted((cell for cell in own if cell.chance >= 0), key=lambda cell: cell.n)
        self.chance = {cell.part: cell.chance for cell in asked}
        bases = [base for name in self.systems if (base := published_base(name))]
        bases = [base for base in bases if base not in self.systems]
        self.styles = styles_of([*self.systems, *bases], outcomes.retrieving)
        self.styles[CHANCE] = SeriesStyle("chance", INK, "", ":", 0.9)
        self.cells: dict[tuple[str, str, str], SuccessCell] = {
            (cell.system, cell.condition, cell.part): cell for cell in own
        }
        self.absent, self.beside = list[str](), list[str]()
        self._add_published(score, bases)
        conditions = {condition for _, condition, _ in self.cells}
        self.conditions: Sequence[Condition] = in_order(conditions) if conditions else ()
        self.least = min((each.k for each in self.conditions if each.kind.counted), default=0)

    def _add_published(self, score: Score, bases: Sequence[str]) -> None:
        """Add the published cells of its systems, and of the systems without retrieval."""
        if not score.published:
            return
        from robomme_interference_data.evaluate.score.tables.paper import by_family

        for cell in (*score.published, *by_family()):
            if cell.simulator != self.simulator or cell.system not in self.styles:
                continue
            name = f"{cell.system}{PUBLISHED}"
            absent = cell.system in bases
            names = self.absent if absent else self.beside
            if name not in names:
                names.append(name)
            style = self.styles[cell.system]
            line = (0, (4, 2)) if absent else "none"
            self.styles[name] = SeriesStyle(
                f"{style.label}, published", style.color, "_", line, 1.2
            )
            self.cells[name, cell.condition, cell.part] = cell

    @property
    def kinds(self) -> list[ConditionKind]:
        """The kinds of its conditions, in the order of tables."""
        return list(dict.fromkeys(condition.kind for condition in self.conditions))

    def of(self, kinds: Container[ConditionKind]) -> Self:
        """Return the data of some kinds of conditions, at the same places on the x axis."""
        narrowed = copy(self)
        narrowed.conditions = [each for each in self.conditions if each.kind in kinds]
        names = {condition.name for condition in narrowed.conditions}
        narrowed.cells = {key: cell for key, cell in self.cells.items() if key[1] in names}
        drawn = {system for system, *_ in narrowed.cells}
        narrowed.systems = [system for system in self.systems if system in drawn]
        return narrowed

    def x(self, condition: str) -> float:
        """Return the place on the x axis: log2(k + 1), right of conditions without a count."""
        parsed = parse_condition(condition)
        plain = [each for each in self.conditions if not each.kind.counted]
        if not parsed.kind.counted:
            return 0.3 + 1.3 * plain.index(parsed)
        return 0.3 + 1.3 * len(plain) + math.log2((parsed.k + 1) / (self.least + 1))

    def parts(self, names: Sequence[str]) -> list[str]:
        """Return those of some parts that have cells with rows."""
        with_rows = {part for system, _, part in self.cells if system in self.systems}
        return [name for name in names if name in with_rows]

    def has_parts(self, system: str) -> bool:
        """Whether a system has cells of a part of the episodes."""
        return any(name == system and part for name, _, part in self.cells)

    def shown(self, systems: Sequence[str]) -> list[str]:
        """Return the conditions of the cells of some systems."""
        drawn = {condition for system, condition, _ in self.cells if system in systems}
        return [condition.name for condition in self.conditions if condition.name in drawn]


def _records(score: Score, table: str, simulator: str) -> list[dict[str, Any]]:
    """Return the rows of a table in one simulator; none without the table."""
    if table not in score.tables:
        return []
    records = score.tables[table].records()
    return [record for record in records if record["simulator"] == simulator]
