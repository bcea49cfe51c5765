"""A made-up full grid: outcomes that give the published rates, in rows as a run has them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from support import scoring as made

from robomme_interference_data.constants import DIFFICULTIES, FAMILIES
from robomme_interference_data.evaluate.run.row import Rollout
from robomme_interference_data.evaluate.score.tables.paper import published
from robomme_interference_data.schema.conditions import parse_condition

EPISODES = 50


def full_grid(*, retrieval: bool = False) -> list[Rollout]:
    """Return 25,200 rows of the twelve systems, or 27,000 with the retrieval one.

    In each cell as many episodes succeed as the paper reports. Episodes that are easy for one
    system under one condition tend to be so for all. Of frames, fewer are kept the more sessions.
    """
    numbers = np.random.default_rng(0)
    hard = numbers.normal(size=(len(FAMILIES), EPISODES)) + numbers.normal(size=(len(FAMILIES), 1))
    rows = []
    for cell in published():
        if cell.part or (cell.system == made.RETRIEVAL and not retrieval):
            continue
        own = hard + 0.6 * numbers.normal(size=hard.shape)
        won = own <= np.sort(own, axis=None)[round(cell.rate * cell.n) - 1]
        k, kept = parse_condition(cell.condition).k, numbers.random(hard.shape)
        samples = "framesamp" in cell.system and cell.condition != "no-history"
        base = made.row(cell.system, cell.condition, made.FAMILIES[0], 0, "f")
        for place, episode in np.ndindex(hard.shape):
            success = bool(won[place, episode])
            share = max(0.0, round(1 - k * kept[place, episode] / 5, 1))
            row = replace(
                base,
                simulator=cell.simulator,
                family=FAMILIES[place],
                episode=episode,
                seed=1000 * place + episode,
                difficulty=DIFFICULTIES[episode % 3],
                status="success" if success else "fail",
                success=success,
                evidence_kept=share if samples else None,
            )
            rows.append(row)
    return rows


def write(path: Path, *, retrieval: bool = False) -> Path:
    """Write it as parquet."""
    return made.write_parquet(path, full_grid(retrieval=retrieval))
