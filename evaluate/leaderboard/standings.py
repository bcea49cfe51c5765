"""A board as data: its systems with their numbers, from all of its rows scored together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from robomme_interference_data.errors import InterferenceError
from robomme_interference_data.evaluate.ceiling import ceiling, chance
from robomme_interference_data.evaluate.run.config import CeilingConfig
from robomme_interference_data.evaluate.score.config import Expected, Settings
from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.evaluate.score.partners import ceilings_of, share_weights
from robomme_interference_data.evaluate.score.scoring import Score, score
from robomme_interference_data.evaluate.score.tables.cells import SuccessCell
from robomme_interference_data.evaluate.score.tables.contrast import LESSON_ONLY
from robomme_interference_data.evaluate.score.tables.pairs import NO_PAIRS, Pairs, compare_cells
from robomme_interference_data.evaluate.score.tables.ranks import all_pairs, rankings
from robomme_interference_data.evaluate.systems import display_name
from robomme_interference_data.schema.conditions import NO_HISTORY, in_order
from robomme_interference_data.stats.bootstrap import Interval
from robomme_interference_data.stats.significance import holm

from .entries import Board, BoardStanding
from .plain_values import interval_values, known, letter, mean, rate_of_cell, stated
from .published import Case, Grid, ranked_by

_DRAWS = 100
"""Bootstrap samples: no number of a board depends on them."""


@dataclass(frozen=True)
class BoardSystem:
    """A system of a board, before its rows are scored.

    Attributes:
        system: Its label.
        standing: Why it is there.
        trained_on: What it was trained on; None if unknown.
        case: Its submission; None for a reference.
    """

    system: str
    standing: BoardStanding
    trained_on: str | None
    case: Case | None = None


@dataclass(frozen=True)
class BoardRows:
    """Rows of a board: files or folders, and the name of the system in those that state none."""

    paths: tuple[Path, ...]
    system: str | None = None


def settings_of(rows: Sequence[BoardRows]) -> Settings:
    """Return the settings of a score of all of a board's rows."""
    names = tuple(each.system for each in rows if each.system for _ in each.paths)
    paths = tuple(chain.from_iterable(each.paths for each in rows))
    return Settings(rows=paths, system=names, expected=Expected.OBSERVED)


class Standings:
    """A board with its scored rows.

    Attributes:
        board: The board.
        grid: What its buffer set expects; None if it has none.
        shown: Its systems by label.
        scored: The score of all of its rows.
        outcomes: The outcomes in its simulator.
        conditions: Conditions with rows, in order.
        last: The condition that systems are ranked by.
    """

    def __init__(
        self,
        board: Board,
        grid: Grid | None,
        rows: Sequence[BoardRows],
        shown: Mapping[str, BoardSystem],
    ):
        self.board = board
        self.grid = grid
        self.shown = shown
        self.scored: Score = score(settings_of(rows), _DRAWS)
        self.outcomes: Outcomes = self.scored.outcomes[board.simulator]
        ran = {name for system in self.outcomes.systems for name in self.outcomes.ran(system)}
        self.conditions = tuple(each.name for each in in_order(ran))
        self.last = ranked_by(self.conditions) if grid is None else grid.last

    @cached_property
    def _cells(self) -> dict[tuple[str, str, str], SuccessCell]:
        return {
            (cell.system, cell.condition, cell.part): cell
            for cell in self.scored.cells
            if cell.simulator == self.board.simulator and cell.n
        }

    def records(self) -> list[dict[str, Any]]:
        """Return the systems as plain values: by success under the last condition."""
        ranks = self._ranks()
        differences = self._differences()
        records = []
        for system, shown in self.shown.items():
            facts = next(iter(self.outcomes.facts_of(system)))
            record: dict[str, Any] = {
                "system": system,
                "name": display_name(system),
                "standing": str(shown.standing),
                **ranks.get(system, _UNRANKED),
                "trained_on": shown.trained_on,
                "memory": facts.memory,
                "retrieval": facts.retrieval,
                **stated(shown.case),
                "success": {
                    condition: rate_of_cell(cell)
                    for condition in self.conditions
                    if (cell := self._cells.get((system, condition, "")))
                },
                "families": {
                    family: rate_of_cell(cell)
                    for family in self.outcomes.families
                    if (cell := self._cells.get((system, self.last, family)))
                },
                **self._effects(system),
                "ceiling": self._ceiling(system),
                "differences": differences.get(system, {}),
                "cost": self._cost(system),
                "outcomes": self._letters(system),
            }
            records.append(record)
        return sorted(records, key=self._order)

    def _order(self, record: Mapping[str, Any]) -> tuple[Any, ...]:
        last = record["success"].get(self.last)
        rate = -1.0 if last is None else last["rate"]
        ranked = record["standing"] == BoardStanding.SUBMISSION
        return (-rate, not ranked, record["system"])

    def _ranks(self) -> dict[str, dict[str, Any]]:
        """Return rank and ties of the submissions, by the paired tests of all pairs."""
        systems = [
            name
            for name, shown in self.shown.items()
            if shown.standing is BoardStanding.SUBMISSION and self._ran_last(name)
        ]
        if not systems:
            return {}
        rates = {name: self._cells[name, self.last, ""].rate for name in systems}
        everywhere = np.ones(len(self.outcomes.episodes), bool)
        compared = all_pairs(self.outcomes, self.last, systems, everywhere)
        found = rankings(rates, compared)
        return {
            name: {
                "rank": each.rank,
                "rank_low": each.rank_low,
                "rank_high": each.rank_high,
                "tied": each.rank_low < each.rank_high,
            }
            for name, each in found.items()
        }

    @cached_property
    def controls(self) -> dict[str, str]:
        """The controls, with the condition that others are compared with.

        A control that ran without history only, such as a guess, sees none under any condition.
        """
        return {
            name: self.last if self._ran_last(name) else NO_HISTORY
            for name, shown in self.shown.items()
            if shown.standing is BoardStanding.CONTROL
            if self._ran_last(name) or (name, NO_HISTORY, "") in self._cells
        }

    def _differences(self) -> dict[str, dict[str, Any]]:
        """Return each system's difference to each control, on the same episodes."""
        compared = {
            (system, control): self._compare((control, condition), (system, self.last))
            for system in self.shown
            if self._ran_last(system) and system not in self.controls
            for control, condition in self.controls.items()
        }
        ps = holm([pairs.p for pairs in compared.values()])
        found: dict[str, dict[str, Any]] = {}
        for ((system, control), pairs), p in zip(compared.items(), ps, strict=True):
            if pairs.n:
                values = {"n": pairs.n, "p_holm": known(p), "paired": pairs.paired}
                found.setdefault(system, {})[control] = interval_values(pairs.change) | values
        return found

    def _compare(self, first: tuple[str, str], second: tuple[str, str]) -> Pairs:
        """Compare two cells over the episodes that count in both, also where they are unpaired."""
        outcomes = self.outcomes
        one, other = outcomes.cell(*first), outcomes.cell(*second)
        shared = outcomes.counted[one] & outcomes.counted[other]
        if not shared.any():
            return NO_PAIRS
        return compare_cells(
            outcomes.status[one][shared],
            outcomes.status[other][shared],
            outcomes.training,
            same_weights=share_weights(outcomes, first[0], second[0]),
            paired=outcomes.pairable(first[0], second[0]),
        )

    def _ran_last(self, system: str) -> bool:
        return (system, self.last, "") in self._cells

    def _effects(self, system: str) -> dict[str, Any]:
        """Return the fall from k0 to the last condition, and the retention."""
        found: dict[str, Any] = {"fall": None, "retention": None}
        table = self.scored.tables.get("effects")
        for row in [] if table is None else table.records():
            key = (row["simulator"], row["system"], row["condition"])
            if key != (self.board.simulator, system, self.last) or not row["n"]:
                continue
            if (row["against_system"], row["against_condition"]) == (system, LESSON_ONLY):
                interval = Interval(row["difference"], row["low"], row["high"])
                found["fall"] = interval_values(interval) | {"n": row["n"], "p_holm": row["p_holm"]}
            elif row["against_condition"] == NO_HISTORY and row["retention"] is not None:
                low, high = row["retention_low"], row["retention_high"]
                found["retention"] = {"value": row["retention"], "low": low, "high": high}
        return found

    def _ceiling(self, system: str) -> float | None:
        """Return the ideal observer's success with the same memory under the last condition."""
        facts = next(iter(self.outcomes.facts_of(system)))
        if self.grid is not None and facts.memory is not None and facts.retrieval is None:
            return self._computed(facts.memory)
        cells = (
            self._cells.get((name, self.last, "")) for name in ceilings_of(self.outcomes, system)
        )
        return next((cell.rate for cell in cells if cell), None)

    def _computed(self, memory: str) -> float | None:
        assert self.grid is not None
        config = CeilingConfig(memory=memory, conditions=(self.last,))
        try:
            cells = ceiling(self.grid.buffer_set, config)
        except InterferenceError:  # the evidence is unknown
            return None
        return cells[-1].success if cells else None

    @cached_property
    def chance(self) -> float | None:
        """Success of guessing, with nothing seen of the past; None if unknown."""
        if self.grid is not None:
            queries = map(self.grid.buffer_set.query, self.grid.buffer_set.episode_ids)
            return mean(chance(query, {}) for query in queries)
        return mean(
            known(cell.chance)
            for (_, condition, part), cell in self._cells.items()
            if condition == self.last and not part
        )

    def _cost(self, system: str) -> dict[str, Any] | None:
        table = self.scored.tables.get("cost")
        for row in [] if table is None else table.records():
            key = (row["simulator"], row["system"], row["condition"])
            if key == (self.board.simulator, system, self.last):
                return {name: row[name] for name in ("seconds", "seconds_per_success")}
        return None

    def _letters(self, system: str) -> dict[str, str]:
        """Return the outcome of each episode by condition, a letter each: see `letter`."""
        place = self.outcomes.systems.index(system)
        return {
            condition: "".join(map(letter, self.outcomes.counts[place, number].tolist()))
            for number, condition in enumerate(self.outcomes.conditions)
            if self.outcomes.has_rows[place, number]
        }

    def to_dict(self) -> dict[str, Any]:
        """Return the board as plain values, for JSON."""
        return {
            "board": self.board.name,
            "simulator": self.board.simulator,
            "buffer_set": self.board.buffer_set,
            "revision": self.scored.rows.revisions.get(self.board.simulator),
            "note": self.board.note,
            "conditions": list(self.conditions),
            "ranked_by": self.last,
            "chance": self.chance,
            "controls": self.controls,
            "notes": list(self.scored.notes),
            "episodes": [str(episode) for episode in self.outcomes.episodes],
            "systems": self.records(),
        }


_UNRANKED = {"rank": None, "rank_low": None, "rank_high": None, "tied": False}
