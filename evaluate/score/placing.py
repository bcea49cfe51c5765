"""Rows to outcomes: each row at its place in the arrays of its simulator."""

from collections.abc import Sequence, Set
from dataclasses import replace
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from robomme_interference_data.constants import ABILITIES, DIFFICULTIES, FAMILIES, RECORDINGS
from robomme_interference_data.evaluate.systems import FACT_COLUMNS, SYSTEMS, SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import DEFAULT_CONDITIONS, in_order

from .config import Expected
from .outcomes import STATUSES, TEST_EPISODES, Flags, Outcomes, Repeat
from .rows.reading import CheckedRows
from .rows.values import Row


def outcomes_of(rows: CheckedRows, expected: Expected) -> dict[str, Outcomes]:
    """Return the outcomes of each simulator, by its name; recordings have none."""
    by_simulator = {}
    for name in rows.names("simulator"):
        if name != RECORDINGS:
            here = [row for row in rows if row.simulator == name]
            # Other benchmarks do not have this one's grid, and their seeds may change the scene.
            other = name in {simulator for simulator, _ in rows.scenes}
            grid = Expected.OBSERVED if other else expected
            outcomes = _outcomes(here, name, grid, rows.without_revision)
            by_simulator[name] = replace(outcomes, seeds_repeat=not other)
    return by_simulator


def offline_outcomes(rows: CheckedRows) -> Outcomes | None:
    """Return the outcomes of offline runs, or None without any.

    Recordings have no grid: the expected episodes are those that occur in any row or in the plan
    of a run, and the expected cells those that have rows.
    """
    measured = [row for row in rows if row.simulator == RECORDINGS]
    if not measured:
        return None
    planned = {
        item.episode
        for run in rows.sources.values()
        if run is not None and run.identity.get("simulator") == RECORDINGS
        for item in run.items
    }
    outcomes = _outcomes(measured, RECORDINGS, Expected.OBSERVED, rows.without_revision, planned)
    return replace(outcomes, in_tables=outcomes.has_rows)


def _outcomes(
    rows: Sequence[Row],
    simulator: str,
    which: Expected,
    without_revision: frozenset[tuple[str, str]],
    planned: Set[EpisodeId] = frozenset(),
) -> Outcomes:
    """Return the outcomes of the rows of one simulator; `planned` episodes are expected, too."""
    observed = {row.condition for row in rows}
    expected_conditions = observed if which is Expected.OBSERVED else {*DEFAULT_CONDITIONS}
    held = {EpisodeId(*key) for key in {(row.family, row.split, row.episode) for row in rows}}
    expected = held | planned
    if which is Expected.BENCHMARK:
        expected = {
            EpisodeId(family, "test", index)
            for family in FAMILIES
            for index in range(TEST_EPISODES)
        }
    systems = tuple(sorted({row.system for row in rows}, key=_table_order))
    conditions = tuple(condition.name for condition in in_order(observed | expected_conditions))
    episodes = tuple(sorted(held | expected, key=lambda episode: episode.sort_key))
    seeds = {(row.training_seed, row.model_seed) for row in rows}
    repeats = tuple(Repeat(*seed) for seed in sorted(seeds, key=_repeat_order))

    at = _places(rows, systems, conditions, episodes, repeats)
    shape = (len(systems), len(conditions), len(episodes), len(repeats))
    status = np.full(shape, -1, np.int8)
    evidence, action_l1 = (np.full(shape, np.nan) for _ in range(2))
    status[at] = [STATUSES.index(row.status) for row in rows]
    evidence[at] = np.array([row.evidence_kept for row in rows], float)  # None becomes NaN
    action_l1[at] = np.array([row.action_l1 for row in rows], float)
    difficulty, ability = (np.full(len(episodes), -1) for _ in range(2))
    chance = np.full(len(episodes), np.nan)
    # Reading holds that the rows of an episode agree in all three.
    for row, episode in zip(rows, at[2].tolist(), strict=True):
        if row.difficulty is not None:
            difficulty[episode] = DIFFICULTIES.index(row.difficulty)
        if row.ability is not None:
            ability[episode] = ABILITIES.index(row.ability)
        if row.chance is not None:
            chance[episode] = row.chance
    facts = _facts_of(rows, systems)
    applies = _applies(facts, conditions, expected_conditions)
    return Outcomes(
        simulator,
        systems,
        conditions,
        episodes,
        repeats,
        status,
        evidence,
        action_l1,
        difficulty,
        ability,
        chance,
        expected=np.array([episode in expected for episode in episodes]),
        in_tables=applies | (status >= 0).any(axis=(2, 3)),
        without_revision=np.array([(simulator, name) in without_revision for name in systems]),
        facts=facts,
    )


def _places(
    rows: Sequence[Row],
    systems: Sequence[str],
    conditions: Sequence[str],
    episodes: Sequence[EpisodeId],
    repeats: Sequence[Repeat],
) -> tuple[NDArray[np.int64], ...]:
    """Return where each row is along each axis: an index of arrays, `(rows,)` each.

    At most one row is at a place, because reading keeps one row of a rollout.
    """
    keys = [(episode.family, episode.split, episode.index) for episode in episodes]
    axes: tuple[Sequence[object], ...] = (systems, conditions, keys, repeats)
    values: tuple[Sequence[object], ...] = (
        [row.system for row in rows],
        [row.condition for row in rows],
        [(row.family, row.split, row.episode) for row in rows],
        [(row.training_seed, row.model_seed) for row in rows],
    )
    indices = []
    for axis, column in zip(axes, values, strict=True):
        places = {value: place for place, value in enumerate(axis)}
        indices.append(np.array([places[value] for value in column]))
    return tuple(indices)


def _applies(
    facts: Sequence[frozenset[SystemFacts]], conditions: Sequence[str], expected: Set[str]
) -> Flags:
    """Whether an expected condition can be run with a system, `(S, C) bool`."""
    return np.array(
        [
            [
                condition in expected and all(each.applies(condition) for each in of_system)
                for condition in conditions
            ]
            for of_system in facts
        ]
    )


def _facts_of(rows: Sequence[Row], systems: Sequence[str]) -> tuple[frozenset[SystemFacts], ...]:
    facts: dict[str, set[SystemFacts]] = {system: set() for system in systems}
    for system, *values in set(map(attrgetter("system", *FACT_COLUMNS), rows)):
        facts[system].add(SystemFacts(**dict(zip(FACT_COLUMNS, values, strict=True))))
    return tuple(map(frozenset, facts.values()))


def _repeat_order(seed: tuple[int | None, int]) -> tuple[int, int]:
    training_seed, model_seed = seed
    return -1 if training_seed is None else training_seed, model_seed


def _table_order(system: str) -> tuple[int, str]:
    names = [*SYSTEMS]
    return names.index(system) if system in SYSTEMS else len(names), system
