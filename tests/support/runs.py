"""Runs over the tiny buffer set, on the simulator and with the cheat of `worlds`."""

import json
import os
import subprocess
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from support import worlds

from robomme_interference_data.evaluate import RunConfig, RunResult, run_evaluation
from robomme_interference_data.evaluate.rollout.rollout import run_rollout
from robomme_interference_data.evaluate.run.plan import WorkItem
from robomme_interference_data.evaluate.run.row import Rollout, read_record
from robomme_interference_data.evaluate.run.worker import RunContext
from robomme_interference_data.evaluate.systems import SystemFacts
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.runtime.executor import Executor, Serial
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.schema.rollouts import TIMING_COLUMNS

CHEAT = "python:support.worlds:make_cheat"
WORLD = "support.worlds:World"
EPISODE = EpisodeId("MoveCube", "test", 0)


def config(**changes: Any) -> RunConfig:
    """A run of two episodes under two conditions."""
    usual: dict[str, Any] = {
        "policy": CHEAT,
        "buffer_set": Path(os.environ[worlds.BUFFER_SET]),
        "out": Path("nowhere"),
        "simulator": WORLD,
        "system": "mine",
        "families": worlds.FAMILIES,
        "episodes": "0",
        "conditions": ("no-history", "k0"),
        "no_probe": True,  # tests count rollouts and calls; `test_probe.py` has those of the probe
    }
    return RunConfig(**usual | changes)


def run(
    out: Path, executor: Executor | None = None, *, progress: Any = None, **changes: Any
) -> RunResult:
    settings = config(out=out, **changes)
    return run_evaluation(settings, executor=executor or Serial(), progress=progress)


def run_one(out: Path, **changes: Any) -> RunResult:
    """A run of one rollout."""
    one: dict[str, Any] = {"conditions": ("no-history",), "families": ("MoveCube",)}
    return run(out, **one | changes)


def header(folder: Path) -> dict[str, Any]:
    """What `run.json` of a run says."""
    return json.loads((folder / "run.json").read_text())  # type: ignore[no-any-return]


def roll(condition: str, policy: Any, *, simulator: Any = None, **changes: Any) -> Rollout:
    """One rollout, outside of a run."""
    parts = {name: changes.pop(name) for name in ("selector", "clip", "writer") if name in changes}
    system, facts = changes.pop("system", "mine"), changes.pop("facts", SystemFacts())
    buffer_set = worlds.buffer_set_here()
    return run_rollout(
        RunContext(config(**changes), system, facts, buffer_set.name, buffer_set.revision),
        WorkItem(condition, EPISODE),
        simulator=simulator or worlds.World(),
        policy=policy,
        buffer_set=buffer_set,
        **parts,
    )


def untimed(rows: tuple[Rollout, ...]) -> list[dict[str, Any]]:
    return [
        {name: value for name, value in to_dict(row).items() if name not in TIMING_COLUMNS}
        for row in rows
    ]


def of_any_policy(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows without the columns that say which policy it was."""
    return [
        {name: value for name, value in row.items() if name not in ("policy", "policy_id")}
        for row in rows
    ]


def finished_rows(out: Path) -> list[dict[str, Any]]:
    """The recorded rows in canonical order, without what differs from run to run."""
    rows = read_record(out)
    once = {"attempt": 1, "repeated_because": None}
    return [row | once for row in untimed(tuple(rows[item] for item in sorted(rows)))]


def wait_for_rows(out: Path, count: int, running: subprocess.Popen[str]) -> None:
    log, end = out / "rollouts.jsonl", time.monotonic() + 200
    while not log.exists() or log.read_bytes().count(b"\n") < count:
        assert time.monotonic() < end and running.poll() is None, running.communicate()
        time.sleep(0.02)
