"""Made-up rows of systems that do not differ, with training runs: for simulations of the tests."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import NormalDist

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from support import scoring as made

from robomme_interference_data.constants import DIFFICULTIES
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.stats.bootstrap import generator_of


@dataclass(frozen=True)
class NullGrid:
    """Systems with equal rates under all conditions.

    Whether an episode succeeds depends on what is alike for all systems (half of the variance), on
    the system and the episode (a fifth), on chance, and on the training run under a condition.
    """

    systems: int = 4
    conditions: Sequence[str] = ("k0", "k7")
    families: Sequence[str] = ("MoveCube",)
    episodes: int = 150  # of all families
    runs: int = 1
    spread: float = 0.0  # standard deviation of the runs' rates, as a share
    rate: float = 0.3

    def success(self, key: str) -> np.ndarray:
        """Outcomes by system, condition, run and episode."""
        generator, normal = generator_of(key), NormalDist()
        limit = normal.inv_cdf(self.rate)
        of_run = self.spread / normal.pdf(limit)
        shape = (self.systems, len(self.conditions), self.runs, self.episodes)
        latent = math.sqrt(0.5) * generator.normal(size=self.episodes)
        latent = latent + math.sqrt(0.2) * generator.normal(
            size=(self.systems, 1, 1, self.episodes)
        )
        latent = latent + math.sqrt(0.3) * generator.normal(size=shape)
        latent = latent + of_run * generator.normal(size=(*shape[:3], 1))
        return latent < limit * math.sqrt(1 + of_run**2)

    def write(self, path: Path, key: str) -> Path:
        """Write the rows of a grid, as parquet."""
        success = self.success(key)
        system, condition, run, episode = (axis.ravel() for axis in np.indices(success.shape))
        per_family = self.episodes // len(self.families)
        base = to_dict(made.row("system-0", "k0", "MoveCube", 0, "s"))
        columns = {name: [value] * success.size for name, value in base.items()}
        won = success.ravel()
        columns |= {
            "system": [f"system-{number}" for number in system],
            "policy": ["python"] * success.size,
            "policy_id": [f"{a} {b}" for a, b in zip(system, run, strict=True)],
            "condition": [self.conditions[number] for number in condition],
            "family": [self.families[number // per_family] for number in episode],
            "episode": episode % per_family,
            "seed": episode,
            "difficulty": [DIFFICULTIES[number % 3] for number in episode],
            "training_seed": run,
            "status": np.where(won, "success", "fail"),
            "success": won,
        }
        arrays = [pa.array(columns[field.name], field.type) for field in made.SCHEMA]
        pq.write_table(pa.table(arrays, schema=made.SCHEMA), path)
        return path
