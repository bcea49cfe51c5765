"""Made-up grids with known findings: what a report states of each can be worked out by hand."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from support import scoring as made

from robomme_interference_data.constants import FAMILIES
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.config import Expected
from robomme_interference_data.evaluate.score.scoring import Score

GRID = 450


def cell(
    system: str, condition: str, letters: str, families: Sequence[str] = FAMILIES
) -> list[Rollout]:
    """Rows of a system under a condition: a letter an episode, one family after the other."""
    base = made.row(system, condition, made.FAMILIES[0], 0, "s")
    rows = []
    for place, letter in enumerate(letters):
        if letter == "-":
            continue
        index, family = divmod(place, len(families))
        status = made.STATUS[letter]
        row = replace(
            base,
            family=families[family],
            episode=index,
            seed=place,
            difficulty=("easy", "medium", "hard")[index % 3],
            status=status,
            success=None if letter == "e" else letter == "s",
            error="it broke" if letter == "e" else None,
        )
        rows.append(row)
    return rows


def fall(system: str, both: int, lost: int, gained: int, neither: int) -> list[Rollout]:
    """Rows under k0 and k7: how many episodes succeed under both, k0 or k7 alone, or neither."""
    k0 = "s" * (both + lost) + "f" * (gained + neither)
    k7 = "s" * both + "f" * lost + "s" * gained + "f" * neither
    return cell(system, "k0", _mixed(k0)) + cell(system, "k7", _mixed(k7))


def _mixed(letters: str) -> str:
    """Return letters in another order, the same for each text of this length."""
    # 7 and 450 have no common divisor, so that every family has episodes of each group.
    return "".join(letters[place * 7 % len(letters)] for place in range(len(letters)))


def _errors() -> list[Rollout]:
    """Of alpha's k7, 122 of 450 rollouts broke, of which 31 succeed under k0.

    Over the 328 others: 162 (49.4%) succeed under k0, and 187 (57.0%) under k7, which are 41.6% of
    450. All 193 of k0 are 42.9%.
    """
    k0 = "s" * 162 + "f" * 166 + "s" * 31 + "f" * 91
    k7 = "s" * 142 + "f" * 20 + "s" * 45 + "f" * 121 + "e" * 122
    return cell("alpha", "k0", _mixed(k0)) + cell("alpha", "k7", _mixed(k7))


def _missing() -> list[Rollout]:
    """Alpha's k7 lacks 60 episodes, all of which succeed under k0."""
    k0 = "s" * 60 + "s" * 180 + "f" * 210
    k7 = "-" * 60 + "s" * 160 + "f" * 20 + "s" * 15 + "f" * 195
    alpha = cell("alpha", "k0", _mixed(k0)) + cell("alpha", "k7", _mixed(k7))
    return alpha + fall("beta", 150, 20, 14, 266)


def _one_system() -> list[Rollout]:
    rates = {"no-history": 60, "k0": 225, "k1": 180, "k3": 150, "k7": 120}
    return [
        row
        for condition, won in rates.items()
        for row in cell("alpha", condition, _mixed("s" * won + "f" * (GRID - won)))
    ]


def _tiny() -> list[Rollout]:
    """Twelve episodes of four families."""
    four = FAMILIES[:4]
    rows = cell("alpha", "k0", "ssssssffffff", four) + cell("alpha", "k7", "sssfffffffff", four)
    return (
        rows + cell("beta", "k0", "sssfffffffff", four) + cell("beta", "k7", "sssfffffffff", four)
    )


def _several_runs() -> list[Rollout]:
    """Three training runs of each system: those of alpha lose 20, 4 and 12 points."""
    losses = {"alpha": (99, 27, 63), "beta": (9, 8, 10)}
    return [
        replace(row, training_seed=seed)
        for system, lost_by_run in losses.items()
        for seed, lost in enumerate(lost_by_run)
        for row in fall(system, 200 - lost, lost, 9, 241)
    ]


FINDINGS: dict[str, Callable[[], list[Rollout]]] = {
    "fall": lambda: fall("alpha", 120, 137, 11, 182) + fall("beta", 150, 20, 14, 266),
    "no fall": lambda: fall("alpha", 180, 16, 14, 240) + fall("beta", 100, 20, 22, 308),
    # Beta comes first in no table, and both have 120 successes under k0.
    "rise": lambda: fall("alpha", 100, 20, 56, 274) + fall("beta", 90, 30, 28, 302),
    "tiny": _tiny,
    "one system": _one_system,
    "missing": _missing,
    "errors": _errors,
    "several runs": _several_runs,
    "no complete cell": _tiny,
}
"""Name of a finding to its rows."""


def scored(name: str, folder: Path) -> Score:
    """The score of a finding: on the benchmark's grid, and in one case with a margin."""
    path = made.write_parquet(folder / f"{name.replace(' ', '-')}.parquet", FINDINGS[name]())
    expected = Expected.OBSERVED if name == "tiny" else Expected.BENCHMARK
    return made.score(path, expected=expected, margin=5 if name == "no fall" else None)
