"""Sizes of tests and coverage of intervals where nothing differs, in 300 made-up grids a case.

The numbers are those of docs/results/simulated-grids.md.
"""

import json
import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import scoring as made

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.score.outcomes import Outcomes, Repeat
from robomme_interference_data.evaluate.score.plots import figures
from robomme_interference_data.evaluate.score.tables import decay, interaction
from robomme_interference_data.evaluate.score.tables.contrast import Contrast
from robomme_interference_data.evaluate.score.tables.correction import (
    correct,
    primary_falls,
    with_primary,
)
from robomme_interference_data.evaluate.score.tables.effects import effects_of
from robomme_interference_data.evaluate.score.tables.equivalence import tost
from robomme_interference_data.evaluate.score.tables.evidence_kept import evidence_tables
from robomme_interference_data.evaluate.score.tables.families import over_families
from robomme_interference_data.evaluate.score.tables.pairs import pair
from robomme_interference_data.evaluate.score.tables.ranks import (
    all_pairs,
    matrix_table,
    rankings,
    system_pairs,
)
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.schema.conditions import NO_HISTORY
from robomme_interference_data.stats.bootstrap import generator_of
from robomme_interference_data.stats.sequential import look_levels
from robomme_interference_data.stats.significance import holm, mcnemar

pytestmark = pytest.mark.slow

GRIDS = 300
CONDITIONS = ("k0", "k1", "k3", "k7")
EPISODES = tuple(EpisodeId(family, "test", index) for family in FAMILIES for index in range(50))
PAGE = Path(__file__).parents[2] / "docs" / "results" / "simulated-grids.md"

# Systems, and the share of the variance of an episode's difficulty that systems have in common.
CASES = {"6 systems": (6, 0.5), "12 systems": (12, 0.5), "12 systems, independent": (12, 0.0)}


def made_up(
    systems: int, shared: float, key: str, conditions: Sequence[str] = CONDITIONS
) -> Outcomes:
    """Outcomes of systems whose rates are all 30%, under all conditions."""
    generator = generator_of(key)
    common = generator.normal(size=(1, 1, len(EPISODES)))
    own = generator.normal(size=(systems, len(conditions), len(EPISODES)))
    hard = math.sqrt(shared) * common + math.sqrt(1 - shared) * own
    status = (hard > -0.524401).astype(np.int8)[..., None]  # the normal quantile of 30%
    return Outcomes(
        simulator="made-up",
        systems=tuple(f"system-{number:02}" for number in range(systems)),
        conditions=tuple(conditions),
        episodes=EPISODES,
        repeats=(Repeat(None, 0),),
        status=status,
        evidence=np.full(status.shape, np.nan),
        action_l1=np.full(status.shape, np.nan),
        difficulty=np.zeros(len(EPISODES), int),
        ability=np.full(len(EPISODES), -1),
        chance=np.full(len(EPISODES), np.nan),
        expected=np.ones(len(EPISODES), bool),
        in_tables=np.ones((systems, len(conditions)), bool),
        without_revision=np.zeros(systems, bool),
        facts=(frozenset({SystemFacts()}),) * systems,
    )


def found_any(rows: list[dict[str, Any]], p: str = "p_holm") -> bool:
    """Whether a table has a finding."""
    return any(row[p] is not None and row[p] < 0.05 for row in rows)


def primary(outcomes: Outcomes, differences: Sequence[Contrast]) -> list[Contrast]:
    """The effects on all systems and the differences of their falls, corrected as in a score."""
    contrasts = [
        contrast
        for system in outcomes.systems
        for contrast in effects_of(outcomes, system, base=None, ceiling=None)
    ]
    return correct(with_primary([*contrasts, *differences], [outcomes]))


def departs(rows: list[dict[str, Any]]) -> bool:
    """Whether any p fit is below 0.05 after Holm's correction, which tables leave out."""
    return min(holm([row["p_fit"] for row in rows])) < 0.05


@cache
def simulated(case: str) -> dict[str, float]:
    """Share of grids with any finding, and of intervals that hold the true value."""
    counts = defaultdict[str, list[bool]](list)
    for grid in range(GRIDS):
        outcomes = made_up(*CASES[case], f"{case}, {grid}")
        pairs = matrix_table(correct(system_pairs(outcomes))).records()
        differences = interaction.interactions_of(outcomes, 2000)
        rows = {
            "matrix": [row for row in pairs if row["condition"] == "k0"],
            "interaction": interaction.interaction_table(correct(differences)).records(),
        }
        for name, records in rows.items():
            counts[name].append(found_any(records))
            counts[f"{name}, pointwise"] += [row["low"] <= 0 <= row["high"] for row in records]
            joint = [row["joint_low"] <= 0 <= row["joint_high"] for row in records]
            counts[f"{name}, joint"].append(all(joint))
        everywhere = np.ones(len(EPISODES), bool)
        won = (outcomes.status[:, 0, :, 0] == 0).mean(axis=1)  # 0 is success
        rates = dict(zip(outcomes.systems, won.tolist(), strict=True))
        ranked = rankings(rates, all_pairs(outcomes, "k0", outcomes.systems, everywhere)).values()
        counts["best"].append(any(ranking.p_holm < 0.05 for ranking in ranked))
        behind = [ranking.behind for ranking in ranked if not math.isnan(ranking.behind.value)]
        counts["best, joint"].append(all(one.low <= 0 <= one.high for one in behind))
        counts["ranks"].append(all((r.rank_low, r.rank_high) == (1, len(ranked)) for r in ranked))
        falls = [fall.joint for fall in primary_falls(primary(outcomes, differences), "made-up")]
        counts["headline"].append(all(fall.low <= 0 <= fall.high for fall in falls))
        counts["interaction, fit"].append(departs(rows["interaction"]))
        decays = decay.decay_table([outcomes], 2000).records()
        counts["decay"].append(found_any(decays))
        counts["decay, fit"].append(departs(decays))
    return {name: sum(found) / len(found) for name, found in counts.items()}


def bound(share: float, n: int = GRIDS) -> float:
    """Three standard errors of a simulated share."""
    return 3 * math.sqrt(share * (1 - share) / n)


@pytest.mark.parametrize("case", CASES)
def test_no_table_of_systems_finds_more_than_5_percent(case: str) -> None:
    found = simulated(case)
    shown = ("matrix", "best", "interaction", "interaction, pointwise", "headline", "ranks")
    line = " | ".join([case, *(f"{100 * found[name]:.1f}%" for name in shown)])
    assert f"| {line} |" in PAGE.read_text(encoding="utf-8")
    for name in ("matrix", "best", "interaction"):
        assert found[name] <= 0.05 + bound(0.05)
        assert found[f"{name}, joint"] >= 0.95 - bound(0.05)
        if name != "best":  # its intervals are all joint
            assert abs(found[f"{name}, pointwise"] - 0.95) <= 0.015
    assert min(found["ranks"], found["headline"]) >= 0.95 - bound(0.05)


@pytest.mark.parametrize("case", CASES)
def test_no_table_of_trends_finds_more_than_5_percent(case: str) -> None:
    found = simulated(case)
    names = ("decay", "decay, fit", "interaction, fit")
    line = " | ".join([case, *(f"{100 * found[name]:.1f}%" for name in names)])
    assert f"| {line} |" in PAGE.read_text(encoding="utf-8")
    assert max(found[name] for name in names) <= 0.05 + bound(0.05)


@cache
def unequal_families() -> float:
    """Share of grids with an effect of evidence, where easy families keep more of it."""
    found = []
    family = np.repeat(np.arange(9), 50)
    for grid in range(GRIDS):
        outcomes = made_up(1, 0.0, f"evidence, {grid}")
        generator = generator_of(f"evidence, {grid}, kept")
        shape = outcomes.status.shape
        easy = (0.1 + 0.075 * family)[:, None]
        status = (generator.random(shape) > easy).astype(np.int8)
        kept = generator.binomial(2, np.broadcast_to(easy, shape)) / 2
        one = replace(outcomes, status=status, evidence=kept)
        tables = {table.name: table for table in evidence_tables([one])}
        found.append(found_any(tables["evidence_effects"].records()))
    return sum(found) / GRIDS


def test_easy_families_that_keep_more_evidence_are_no_effect() -> None:
    share = unequal_families()
    assert f"{100 * share:.1f}% of grids in `evidence_effects`" in PAGE.read_text(encoding="utf-8")
    assert share <= 0.05 + bound(0.05)


@cache
def at_the_margin() -> float:
    """Share of 2,000 differences of 5 points that are claimed to be within 5 points."""
    generator = generator_of("margin")
    counts = generator.multinomial(450, [0.2, 0.1, 0.05, 0.65], 2000).tolist()
    found = []
    for both, lost, gained, neither in counts:
        pairs = [(0, 0)] * both + [(0, 1)] * lost + [(1, 0)] * gained + [(1, 1)] * neither
        first, second = np.array(pairs, np.int8)[:, :, None].transpose(1, 0, 2)
        found.append(tost(pair(first, second), 5) < 0.05)
    return sum(found) / len(found)


def test_a_difference_at_the_margin_is_seldom_equivalent() -> None:
    share = at_the_margin()
    assert f"equivalent in {100 * share:.1f}%" in PAGE.read_text(encoding="utf-8")
    assert share <= 0.05 + bound(0.05, 2000)


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
    share = families(case)
    assert f" in {100 * share:.1f}% if " in PAGE.read_text(encoding="utf-8")
    assert share <= 0.05 + bound(0.05)


@cache
def looking(levels: tuple[float, ...]) -> float:
    """Share of studies of two equal systems with a finding at any of ten looks."""
    generator = generator_of("looking")
    flips = generator.multinomial(45, [0.1, 0.1, 0.8], (2000, 10))[..., :2].cumsum(axis=1)
    ps = [[mcnemar(*map(int, both)) for both in study] for study in flips]
    return float((np.array(ps) <= levels).any(axis=1).mean())


def test_planned_looks_find_no_more_than_5_percent() -> None:
    unplanned, planned = looking((0.05,) * 10), looking(look_levels(10))
    statistics = PAGE.parents[1] / "explanation" / "statistics.md"
    assert f"equal systems in {100 * unplanned:.0f}%" in statistics.read_text(encoding="utf-8")
    assert f"equal systems in {100 * planned:.1f}%" in PAGE.read_text(encoding="utf-8")
    assert planned <= 0.05 + bound(0.05, 2000)


FILES = 20


def test_no_table_of_the_command_finds_too_much(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From files of rows to what is printed, with all tables that have a corrected p-value."""
    monkeypatch.setattr(figures, "draw_figures", lambda score, folder, suffixes: {})
    conditions = (NO_HISTORY, *CONDITIONS)
    counts = defaultdict[str, int](int)
    for grid in range(FILES):
        outcomes = made_up(3, 0.5, f"files, {grid}", conditions)
        generator = generator_of(f"files, {grid}, kept")
        kept = (generator.integers(0, 3, outcomes.status.shape) / 2).tolist()
        rows = [
            replace(
                made.row(outcomes.systems[s], conditions[c], "MoveCube", at.index, letter),
                family=at.family,
                seed=e,
                evidence_kept=kept[s][c][e][0],
            )
            for s, c, e, _ in np.ndindex(outcomes.status.shape)
            for at, letter in [(EPISODES[e], "sf"[outcomes.status[s, c, e, 0]])]
        ]
        path = made.write_csv(tmp_path / "rows.csv", rows)
        done = made.run("score", path, "--out", tmp_path / "out", "--margin", 1, "--json")
        assert done.exit_code == 0, done.output
        for name, table in json.loads(done.stdout)["tables"].items():
            for column in [one for one in (table or [{}])[0] if one.endswith("_holm")]:
                counts[f"{name}, {column}"] += found_any(table, column)
    assert {"effects, p_holm", "matrix, p_holm", "families, p_families_holm"} <= counts.keys()
    assert {"decay, p_holm", "evidence_effects, p_holm"} <= counts.keys()
    most = FILES * (0.05 + bound(0.05, FILES))
    assert {name: count for name, count in counts.items() if count > most} == {}
