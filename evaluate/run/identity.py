"""What makes a run the one that it is, and what the record says of a start of it."""

import dataclasses
import datetime
import platform
import subprocess
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from robomme_interference_data.constants import PROTOCOL_VERSION
from robomme_interference_data.data.buffer_set import Split
from robomme_interference_data.evaluate.policies.identity import plain, policy_identity
from robomme_interference_data.evaluate.rollout.worker import make_selector
from robomme_interference_data.evaluate.subgoals.registry import subgoals_identity

from .config import AskConfig, RetrievalConfig, RunConfig
from .log import Start
from .plan import Plan
from .versions import package_versions


def run_identity(
    config: RunConfig,
    system: str,
    split: Split,
    plan: Plan,
    said: Mapping[str, Any],
    written: Mapping[str, Any],
    versions: Mapping[str, str],
) -> dict[str, Any]:
    """Return what makes the run the one that it is, as plain values.

    Args:
        config: Its settings.
        system: Name under which its rows stand.
        split: The split.
        plan: What is asked for.
        said: What the policy says of itself.
        written: What writes its subgoals says of itself; empty if nothing does.
        versions: Of the simulator.
    """
    return {
        "system": system,
        "simulator": config.simulator,
        "simulator_version": dict(versions),
        "revision": split.revision,
        "episode_split": config.episode_split,
        "shift": config.shift,
        "model_seed": config.model_seed,
        "retrieval_index": retrieval_index(config, split, plan),
        "subgoals": subgoals_identity(config, written),
        "protocol_version": PROTOCOL_VERSION,
        **policy_identity(config.policy, config.policy_options, said),
    }


def retrieval_index(config: RetrievalConfig, split: Split, plan: Plan) -> Any:
    """Return what the retrieval step's choices depend on; None without one.

    Looks for the index of every dataset that a planned condition needs.
    """
    selector = make_selector(config)
    if selector is None:
        return None
    found = None  # the same for all: the buffers of a condition need the same datasets
    for name in plan.conditions:
        found = selector.identity(next(split.buffers(condition=name)))
    return plain(found)


def start_of(
    config: RunConfig | AskConfig,
    plan: Plan,
    said: Mapping[str, Any],
    versions: Mapping[str, str],
    command: Sequence[str],
) -> Start:
    """Return what is recorded of a start that begins now."""
    return Start(
        command=tuple(map(plain, command)),
        settings=plain(dataclasses.asdict(config)),
        plan=plan,
        versions=package_versions(config) | dict(versions),
        git=_git(),
        machine=platform.machine(),
        policy=dict(said),
        started=now(),
    )


def now() -> str:
    """Return the time, UTC, `2026-01-31T12:00:00Z`."""
    return datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _git() -> str | None:
    """Return the commit of the source tree that runs, with `-dirty` if it was changed."""
    root = Path(__file__).resolve().parents[2]
    command = ["git", "-C", str(root), "describe", "--always", "--abbrev=40", "--dirty"]
    try:
        done = subprocess.run(
            [*command, "--exclude=*"], check=True, capture_output=True, text=True, timeout=20
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() if (root / ".git").exists() else None
