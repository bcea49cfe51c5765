"""The data of the figures of a score."""

import math
from collections.abc import Container, Sequence
from copy import copy
from typing import Self

from robomme_interference_data.evaluate.score.partners import base_of
from robomme_interference_data.evaluate.score.scoring import Score
from robomme_interference_data.evaluate.score.tables.cells import Cell
from robomme_interference_data.evaluate.score.tables.paper import by_family
from robomme_interference_data.evaluate.systems import published_base
from robomme_interference_data.schema.conditions import Condition, Kind, in_order, parse_condition
from robomme_interference_data.stats.significance import ALPHA
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
        distinguishable: Condition and pair of systems that differ significantly.
        by_evidence_kept: The rows of that table, without the simulator.
        chance: Success of guessing by part of the episodes, if all are questions.
    """

    def __init__(self, score: Score, simulator: str):
        self.simulator = simulator
        found = [one for one in score.cells if one.simulator == simulator and one.n]
        self.systems = list(dict.fromkeys(one.system for one in found))
        outcomes = score.outcomes[simulator]
        self.families = outcomes.families
        self.bases = {system: base_of(outcomes, system) for system in self.systems}
        self.contrasts = [one for one in score.contrasts if one.simulator == simulator]
        noise = score.tables.get("noise")
        repeats = [row[3:5] for row in noise.rows if row[0] == simulator] if noise else []
        pairs, flips = map(sum, zip(*repeats, strict=True)) if repeats else (0, 0)
        self.flips = flips / pairs if pairs else None
        self.distinguishable = {
            (one["condition"], frozenset((one["system"], one["against_system"])))
            for one in (score.tables["matrix"].records() if "matrix" in score.tables else ())
            if one["simulator"] == simulator and one["p_holm"] < ALPHA
        }
        kept = score.tables.get("by_evidence_kept")
        self.by_evidence_kept = (
            [row[1:] for row in kept.rows if row[0] == simulator] if kept else []
        )
        asked = sorted((one for one in found if one.chance >= 0), key=lambda one: one.n)
        self.chance = {one.part: one.chance for one in asked}
        bases = [b for s in self.systems if (b := published_base(s)) and b not in self.systems]
        self.styles = styles_of([*self.systems, *bases], outcomes.retrieving)
        self.styles[CHANCE] = SeriesStyle("chance", INK, "", ":", 0.9)
        self.cells: dict[tuple[str, str, str], Cell] = {
            (one.system, one.condition, one.part): one for one in found
        }
        self.absent, self.beside = list[str](), list[str]()
        for one in (*score.published, *(by_family() if score.published else ())):
            if one.simulator == simulator and one.system in self.styles:
                name = f"{one.system}{PUBLISHED}"
                names = self.absent if one.system in bases else self.beside
                names += [name] if name not in names else []
                style, line = (
                    self.styles[one.system],
                    (0, (4, 2)) if one.system in bases else "none",
                )
                label = f"{style.label}, published"
                self.styles[name] = SeriesStyle(label, style.color, "_", line, 1.2)
                self.cells[name, one.condition, one.part] = one
        conditions = {condition for _, condition, _ in self.cells}
        self.conditions: Sequence[Condition] = in_order(conditions) if conditions else ()
        self.least = min((one.k for one in self.conditions if one.kind.counted), default=0)

    @property
    def kinds(self) -> list[Kind]:
        """The kinds of its conditions, in the order of tables."""
        return list(dict.fromkeys(one.kind for one in self.conditions))

    def of(self, kinds: Container[Kind]) -> Self:
        """Return the data of some kinds of conditions, at the same places on the x axis."""
        found = copy(self)
        found.conditions = [one for one in self.conditions if one.kind in kinds]
        names = {one.name for one in found.conditions}
        found.cells = {key: cell for key, cell in self.cells.items() if key[1] in names}
        found.systems = [one for one in self.systems if any(one == key[0] for key in found.cells)]
        return found

    def x(self, condition: str) -> float:
        """Return the place on the x axis: log2(k + 1), right of conditions without a count."""
        one, plain = parse_condition(condition), [c for c in self.conditions if not c.kind.counted]
        if not one.kind.counted:
            return 0.3 + 1.3 * plain.index(one)
        return 0.3 + 1.3 * len(plain) + math.log2((one.k + 1) / (self.least + 1))

    def parts(self, names: Sequence[str]) -> list[str]:
        """Return those of some parts that have cells with rows."""
        with_rows = {part for system, _, part in self.cells if system in self.systems}
        return [name for name in names if name in with_rows]

    def has_parts(self, system: str) -> bool:
        """Whether a system has cells of a part of the episodes."""
        return any(name == system and part for name, _, part in self.cells)

    def shown(self, systems: Sequence[str]) -> list[str]:
        """Return the conditions of the cells of some systems."""
        found = {condition for system, condition, _ in self.cells if system in systems}
        return [one.name for one in self.conditions if one.name in found]
