"""What makes a run the one that it is, and what the record says of an invocation."""

import dataclasses
import datetime
import platform
import subprocess
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robomme_interference_data.constants import PROTOCOL_VERSION
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.evaluate.policies.identity import plain
from robomme_interference_data.simulators.registry import simulator_class

from .config import AskConfig, RetrievalConfig, RunConfig
from .kind import RunKind
from .log import Invocation
from .plan import Plan

if TYPE_CHECKING:
    from robomme_interference_data.retrieval.selector import Selector


def run_identity(kind: RunKind[Any], plan: Plan) -> dict[str, Any]:
    """Return what can change a result, as plain values: it makes the run the one that it is."""
    config = kind.config
    return {
        "system": kind.system,
        "simulator": config.simulator,
        "revision": kind.buffer_set.revision,
        "split": config.split,
        "shift": config.shift,
        "model_seed": config.model_seed,
        "retrieval_index": _retrieval_index(config, kind.buffer_set, plan),
        "protocol_version": PROTOCOL_VERSION,
        **kind.identity(plan),
    }


def make_selector(config: RetrievalConfig) -> "Selector | None":
    """Make the retrieval step of a run, None if it has none; see `Selector` for its errors."""
    if config.retrieval is None:
        return None
    from robomme_interference_data.retrieval.selector import Selector

    return Selector(config.retrieval, rule=config.retrieval_rule, camera=config.retrieval_camera)


def _retrieval_index(config: RetrievalConfig, buffer_set: BufferSet, plan: Plan) -> Any:
    """Return what the retrieval step's choices depend on; None without one.

    Looks for the index of every dataset that a planned condition needs.
    """
    selector = make_selector(config)
    if selector is None:
        return None
    found = None  # the same for all: the buffers of a condition need the same datasets
    for name in plan.conditions:
        found = selector.identity(next(buffer_set.buffers(condition=name)))
    return plain(found)


def invocation(kind: RunKind[Any], plan: Plan, command: Sequence[str]) -> Invocation:
    """Return what is recorded of an invocation that begins now."""
    return Invocation(
        command=tuple(map(plain, command)),
        settings=plain(dataclasses.asdict(kind.config)),
        plan=plan,
        versions=package_versions(kind.config) | dict(kind.versions),
        git=_git(),
        machine=platform.machine(),
        policy=dict(kind.metadata),
        started=now(),
    )


def package_versions(config: RunConfig | AskConfig) -> dict[str, str]:
    """Return the versions of Python and of what a run uses, by name; what is missing is left out.

    RoboMME's interpreter has others: see `simulator_versions`.
    """
    names = ["robomme-interference-data", "numpy", "av", "torch"]
    if isinstance(config, RunConfig) and config.policy.startswith("lerobot:"):
        names.append("lerobot")
    if config.retrieval is not None:
        names.append("transformers")
    if isinstance(config, RunConfig):
        names += simulator_class(config.simulator).packages
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


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
