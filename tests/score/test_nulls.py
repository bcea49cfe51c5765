"""Sizes of tests and coverage of intervals where nothing differs, in 300 made-up grids a case.

The numbers are those of docs/explanation/statistics.md.
"""

import math
from collections import defaultdict
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.comparisons.families import over_families
from robomme_interference_data.evaluate.score.comparisons.pairs import pair
from robomme_interference_data.evaluate.score.comparisons.ranks import rank_table, systems_of
from robomme_interference_data.evaluate.score.comparisons.slopes import interactions_of
from robomme_interference_data.evaluate.score.comparisons.tables import comparison_table
from robomme_interference_data.evaluate.score.outcomes import Outcomes
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.stats.bootstrap import generator_of
from robomme_interference_data.stats.sequential import look_levels
from robomme_interference_data.stats.significance import mcnemar
from robomme_interference_data.stats.signs import simultaneous

pytestmark = pytest.mark.slow

GRIDS = 300
CONDITIONS = ("k0", "k1", "k3", "k7")
EPISODES = tuple(EpisodeId(family, "test", index) for family in FAMILIES for index in range(50))
PAGE = Path(__file__).parents[2] / "docs" / "explanation" / "statistics.md"

# Systems, and the share of the variance of an episode's difficulty that systems have in common.
CASES = {"6 systems": (6, 0.5), "12 systems": (12, 0.5), "12 systems, independent": (12, 0.0)}


def made_up(systems: int, shared: float, key: str) -> Outcomes:
    """Outcomes of systems whose rates are all 30%, under all conditions."""
    generator = generator_of(key)
    common = generator.normal(size=(1, 1, len(EPISODES)))
    own = generator.normal(size=(systems, len(CONDITIONS), len(EPISODES)))
    hard = math.sqrt(shared) * common + math.sqrt(1 - shared) * own
    status = (hard > -0.524401).astype(np.int8)[..., None]  # the normal quantile of 30%
    every = np.ones(len(EPISODES), bool)
    names = tuple(f"system-{number:02}" for number in range(systems))
    shape = (systems, len(CONDITIONS))
    return Outcomes(
        *("made-up", names, CONDITIONS, EPISODES, (0,), status),
        *(np.full(status.shape, np.nan), np.full(status.shape, np.nan)),
        *(np.zeros(len(EPISODES), int), np.full(len(EPISODES), np.nan), every),
        *(np.ones(shape, bool), np.zeros(systems, bool)),
    )


@cache
def simulated(case: str) -> dict[str, float]:
    """Share of grids with any finding, and of intervals that hold the true value."""
    counts = defaultdict[str, list[bool]](list)
    for grid in range(GRIDS):
        outcomes = made_up(*CASES[case], f"{case}, {grid}")
        contrasts = [*systems_of(outcomes), *interactions_of(outcomes, 2000)]
        for name in ("matrix", "systems", "interaction"):
            rows = comparison_table(name, contrasts).records()
            if name != "interaction":
                rows = [row for row in rows if row["condition"] == "k0"]
            counts[name].append(any(row["p_holm"] < 0.05 for row in rows))
            counts[f"{name}, pointwise"] += [row["low"] <= 0 <= row["high"] for row in rows]
            joint = [row["joint_low"] <= 0 <= row["joint_high"] for row in rows]
            counts[f"{name}, joint"].append(all(joint))
        leader = outcomes.status[:, 0, :, 0].mean(axis=1).argmin()  # 0 is success
        change = pair(*outcomes.status[leader, [0, 3]]).at(simultaneous(len(outcomes.systems)))
        counts["headline"].append(change.low <= 0 <= change.high)
        ranks = [row for row in rank_table([outcomes]).records() if row["condition"] == "k0"]
        counts["ranks"].append(
            all((r["rank_low"], r["rank_high"]) == (1, len(ranks)) for r in ranks)
        )
    return {name: sum(found) / len(found) for name, found in counts.items()}


def bound(share: float, n: int = GRIDS) -> float:
    """Three standard errors of a simulated share."""
    return 3 * math.sqrt(share * (1 - share) / n)


@pytest.mark.parametrize("case", CASES)
def test_no_table_of_systems_finds_more_than_5_percent(case: str) -> None:
    found = simulated(case)
    shown = ("matrix", "systems", "interaction", "interaction, pointwise", "headline", "ranks")
    line = " | ".join([case, *(f"{100 * found[name]:.1f}%" for name in shown)])
    assert f"| {line} |" in PAGE.read_text(encoding="utf-8")
    for name in ("matrix", "systems", "interaction"):
        assert found[name] <= 0.05 + bound(0.05)
        assert found[f"{name}, joint"] >= 0.95 - bound(0.05)
        if name != "systems":  # its intervals are all joint
            assert abs(found[f"{name}, pointwise"] - 0.95) <= 0.015
    assert min(found["ranks"], found["headline"]) >= 0.95 - bound(0.05)


FLIPS = {"all 10%": [0.1] * 9, "one 40%, others 2%": [0.4] + [0.02] * 8}


@cache
def families(case: str) -> float:
    chances = np.repeat(FLIPS[case], 50)[:, None]
    generator = generator_of(case)
    sign = np.where(generator.random((450, GRIDS)) < 0.5, 1.0, -1.0)
    values = np.where(generator.random((450, GRIDS)) < chances, sign, 0.0)
    found = over_families(values, np.repeat(np.arange(9), 50), case)
    return sum(one[-1] < 0.05 for one in found) / GRIDS


@pytest.mark.parametrize("case", FLIPS)
def test_families_that_flip_unequally_do_not_differ(case: str) -> None:
    assert families(case) <= 0.05 + bound(0.05)


@cache
def looking(levels: tuple[float, ...]) -> float:
    """Share of studies of two equal systems with a finding at any of ten looks."""
    generator = generator_of("looking")
    flips = generator.multinomial(45, [0.1, 0.1, 0.8], (2000, 10))[..., :2].cumsum(axis=1)
    ps = [[mcnemar(*map(int, both))[0] for both in study] for study in flips]
    return float((np.array(ps) <= levels).any(axis=1).mean())


def test_planned_looks_find_no_more_than_5_percent() -> None:
    assert looking((0.05,) * 10) > 0.09
    assert looking(look_levels(10)) <= 0.05 + bound(0.05, 2000)
