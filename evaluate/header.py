"""What `run.json` says: what was asked of a folder, each start of the command, how it stands."""

import dataclasses
import datetime
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from robomme_interference_data.evaluate.config import RunConfig
from robomme_interference_data.evaluate.log import summary
from robomme_interference_data.evaluate.plan import WorkItem, take_shard
from robomme_interference_data.evaluate.rows import Rollout
from robomme_interference_data.ids import EpisodeId
from robomme_interference_data.simulators.base import Status

__all__ = ["begun", "ended", "now", "plan_record", "planned", "standing"]

_PACKAGES = ("robomme-interference-data", "numpy", "av", "mani-skill", "sapien", "torch")


def plan_record(plan: Sequence[WorkItem], shard: str) -> dict[str, Any]:
    """Return a whole plan as plain values, with the shard of it that is run."""
    return {
        "families": list(dict.fromkeys(item.episode.family for item in plan)),
        "episodes": sorted({item.episode.index for item in plan}),
        "conditions": list(dict.fromkeys(item.condition for item in plan)),
        "shard": shard,
    }


def planned(plans: Iterable[Mapping[str, Any]], episode_split: str) -> tuple[WorkItem, ...]:
    """Return the rollouts of several plans, each once, in the order of the plans.

    Args:
        plans: As `plan_record` writes them; of each, its shard counts.
        episode_split: `train`, `val` or `test`.
    """
    items: dict[WorkItem, None] = {}
    for plan in plans:
        whole = [
            WorkItem(condition, EpisodeId(family, episode_split, index))
            for family in plan["families"]
            for index in plan["episodes"]
            for condition in plan["conditions"]
        ]
        number, of = plan["shard"].split("/")
        items |= dict.fromkeys(take_shard(whole, (int(number), int(of))))
    return tuple(items)


def standing(header: Mapping[str, Any], rows: Iterable[Rollout]) -> dict[str, Any]:
    """Return how a folder stands: `status`, `planned` and `counts` over all of its plans.

    Args:
        header: What `run.json` holds.
        rows: All rows of the folder.
    """
    kept = list(rows)
    finished = {
        (row.condition, EpisodeId(row.family, row.episode_split, row.episode))
        for row in kept
        if row.status != Status.ERROR
    }
    asked = planned(header["plans"], header["identity"]["episode_split"])
    whole = all((item.condition, item.episode) in finished for item in asked)
    return {
        "status": "complete" if whole else "incomplete",
        "planned": len(asked),
        "counts": summary(kept),
    }


def begun(
    header: Mapping[str, Any],
    config: RunConfig,
    plan: Mapping[str, Any],
    *,
    command: Sequence[str],
    policy: Mapping[str, Any],
    simulator: Mapping[str, str],
) -> dict[str, Any]:
    """Return what a start of the command changes in `run.json`.

    Args:
        header: What it holds.
        config: All settings.
        plan: As `plan_record` writes it.
        command: The command line; empty from Python.
        policy: What the policy says of itself.
        simulator: What the simulator says of itself: versions by name.
    """
    produced = {
        "command": list(command),
        "versions": _versions(config) | dict(simulator),
        "git": _git(),
        "machine": platform.machine(),
        "policy": dict(policy),
    }
    start = {**produced, "settings": dataclasses.asdict(config), "plan": dict(plan)}
    start["started"] = now()
    known = [dict(plan)] if plan not in header["plans"] else []
    return {
        **produced,  # of the latest start
        "status": "running",
        "plans": [*header["plans"], *known],
        "invocations": [*header.get("invocations", []), start],
    }


def ended(
    header: Mapping[str, Any], mine: Mapping[str, Any], rows: Iterable[Rollout]
) -> dict[str, Any]:
    """Return what the end of the latest start changes in `run.json`.

    Args:
        header: What it holds.
        mine: How that start ended: `stopped`, and `planned` and `counts` of its own plan.
        rows: All rows of the folder.
    """
    *earlier, last = header["invocations"]
    return {
        "invocations": [*earlier, {**last, **mine, "ended": now()}],
        "stopped": mine["stopped"],
        **standing(header, rows),
    }


def now() -> str:
    """Return the time, UTC, `2026-01-31T12:00:00Z`."""
    return datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _versions(config: RunConfig) -> dict[str, str]:
    names = [*_PACKAGES]
    names += ["lerobot"] if config.policy.startswith("lerobot:") else []
    names += ["transformers"] if config.retrieval is not None else []
    versions = {"python": platform.python_version()}
    for name in names:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return versions


def _git() -> dict[str, Any] | None:
    """Return commit and dirty flag of the source tree that runs; None if installed without one."""
    root = Path(__file__).resolve().parent.parent
    if not (root / ".git").exists():
        return None
    try:
        commit, changes = (
            subprocess.run(
                ["git", "-C", str(root), *words],
                check=True,
                capture_output=True,
                text=True,
                timeout=20,
            ).stdout.strip()
            for words in (["rev-parse", "HEAD"], ["status", "--porcelain", "-uno"])
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": commit, "dirty": bool(changes)}
