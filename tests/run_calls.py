"""Runs over the sample split, on the simulator and with the cheat of `rollout_doubles`."""

from pathlib import Path
from typing import Any

import factories

from robomme_interference_data import load_split
from robomme_interference_data.evaluate import RunResult, run_evaluation
from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.rows import TIMING_COLUMNS, Rollout

CHEAT = "python:rollout_doubles:make_cheat"
WORLD = "rollout_doubles:World"


def run(out: Path, **changes: Any) -> RunResult:
    options: dict[str, Any] = {
        "simulator": WORLD,
        "conditions": ["no-history", "k0"],
        "episodes": "0-1",
        "system": "mine",
    } | changes
    return run_evaluation(options.pop("policy", CHEAT), factories.split(), out, **options)


def run_one(out: Path, **changes: Any) -> RunResult:
    """A run of one rollout."""
    one: dict[str, Any] = {"conditions": ["no-history"], "families": ["MoveCube"], "episodes": "0"}
    return run(out, **one | changes)


def config(**changes: Any) -> RunConfig:
    split = load_split(factories.split())
    options: dict[str, Any] = {"system": "mine", "policy": "hold", "memory": None}
    options |= {"simulator": "tabletop", "split": str(split.root), "split_name": split.name}
    return RunConfig(**options | {"revision": split.revision} | changes)


def untimed(rows: tuple[Rollout, ...]) -> list[dict[str, Any]]:
    return [
        {name: value for name, value in row.as_dict().items() if name not in TIMING_COLUMNS}
        for row in rows
    ]
