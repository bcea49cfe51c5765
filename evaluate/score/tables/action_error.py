"""Action errors of offline runs: their means, and their changes between conditions."""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from robomme_interference_data.evaluate.score.comparisons.contrast import START, comparable
from robomme_interference_data.evaluate.score.rows.values import Row
from robomme_interference_data.schema.conditions import NO_HISTORY, in_order
from robomme_interference_data.simulators.registry import RECORDINGS
from robomme_interference_data.stats.bootstrap import (
    MIN_EPISODES,
    Floats,
    Interval,
    bootstrap,
    known_interval,
)
from robomme_interference_data.stats.significance import holm, sign_flip
from robomme_interference_data.viz.tables import Table

ERROR_TABLES = ("action_error", "action_error_changes", "action_error_values")

_Line = tuple[Any, ...]

_INTERVALS = (
    f"95% BCa bootstrap intervals over episodes, if at least {MIN_EPISODES} of them differ; "
    "repeats of an episode count with their mean."
)


def error_tables(rows: Iterable[Row], draws: int) -> list[Table]:
    """Return the tables of the rows of offline runs."""
    systems = defaultdict[str, list[Row]](list)
    for row in rows:
        if row.simulator == RECORDINGS and row.action_l1 is not None:
            systems[row.system].append(row)
    means, values, changes = list[_Line](), list[_Line](), list[_Line]()
    for system, found in sorted(systems.items()):
        conditions = [one.name for one in in_order({row.condition for row in found})]
        errors = _matrix(found, conditions, lambda row: [row.action_l1 or 0.0])[..., 0]
        for name, interval, n in _means(conditions, errors, draws):
            means.append((system, name, n, *interval))
        by_value = _matrix(found, conditions, _values)
        for value in range(by_value.shape[2]):
            for name, interval, n in _means(conditions, by_value[..., value], draws):
                values.append((system, name, value, n, *interval))
        changes += _changes(system, conditions, errors, draws)
    corrected = holm([change[-1] for change in changes])
    return [
        Table.make(
            "action_error",
            "Action error offline",
            "system condition n:count action_l1:number low:number high:number",
            means,
            "Mean absolute difference of actions to recorded ones over n episodes, in the actions' "
            f"units. {_INTERVALS}",
        ),
        Table.make(
            "action_error_values",
            "Action error offline by value of the action",
            "system condition value:count n:count action_l1:number low:number high:number",
            values,
            f"value: place in the action, from 0. {_INTERVALS}",
        ),
        Table.make(
            "action_error_changes",
            "Changes of the action error between conditions",
            "system condition against_condition n:count action_l1:number against_action_l1:number "
            "difference:number low:number high:number p:p p_holm:p",
            [(*change, p) for change, p in zip(changes, corrected, strict=True)],
            "difference: error under the condition minus that under the other one, over the n "
            "episodes that have both; negative is better. p: sign-flip test of the differences, "
            f"rounded to twentieths of the largest; p holm: corrected for this table. {_INTERVALS}",
        ),
    ]


def _values(row: Row) -> list[float]:
    return [*map(float, (row.action_l1_values or "").split())]


def _matrix(
    rows: Sequence[Row], conditions: Sequence[str], read: Callable[[Row], list[float]]
) -> Floats:
    """Return values of rows by episode and condition, means of repeats, NaN without: `(E, C, V)`.

    Of robots with several sizes of actions, the last values are those of the larger ones.
    """
    cells = defaultdict[tuple[tuple[str, str, int], str], list[list[float]]](list)
    for row in rows:
        cells[(row.family, row.split, row.episode), row.condition].append(read(row))
    episodes = sorted({episode for episode, _ in cells})
    size = max(len(one) for found in cells.values() for one in found)
    matrix = np.full((len(episodes), len(conditions), size), np.nan)
    for (episode, condition), found in cells.items():
        mean = np.mean(found, axis=0)
        matrix[episodes.index(episode), conditions.index(condition), : len(mean)] = mean
    return matrix


def _means(
    conditions: Sequence[str], errors: Floats, draws: int
) -> Iterator[tuple[str, Interval, int]]:
    for name, interval, column in zip(
        conditions, bootstrap(errors, RECORDINGS, draws), errors.T, strict=True
    ):
        known = column[~np.isnan(column)]
        if len(known):
            yield name, known_interval(interval, known), len(known)


def _changes(system: str, conditions: Sequence[str], errors: Floats, draws: int) -> Iterator[_Line]:
    """Yield each condition beside no-history, k0, and the kind that it is compared with."""
    floor = (system, NO_HISTORY) if NO_HISTORY in conditions else None
    pairs = [
        (name, other)
        for other in (NO_HISTORY, START)
        for name in conditions
        if other in conditions and name not in (NO_HISTORY, other)
    ]
    pairs += [(name, other) for name, (_, other) in comparable(system, conditions, floor)]
    for name, other in dict.fromkeys(pairs):
        both = errors[:, [conditions.index(name), conditions.index(other)]]
        both = both[~np.isnan(both).any(axis=1)]
        if not len(both):
            continue
        changes = both[:, 0] - both[:, 1]
        change = known_interval(bootstrap(changes[:, None], RECORDINGS, draws)[0], changes)
        largest = float(np.abs(changes).max())
        p, _ = sign_flip(changes / largest) if largest else (1.0, math.nan)
        yield system, name, other, len(both), *both.mean(axis=0).tolist(), *change, p
