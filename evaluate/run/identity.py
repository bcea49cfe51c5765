"""What identifies a run, and what its header has about an invocation."""

import dataclasses
import datetime
import math
import os
import platform
import subprocess
from collections.abc import Mapping, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from robomme_interference_data.constants import DEMONSTRATIONS, PROTOCOL_VERSION
from robomme_interference_data.data.buffer_set import BufferSet
from robomme_interference_data.schema.codec import to_dict
from robomme_interference_data.storage.text import digest_json

from .config import RetrievalConfig
from .plan import RunPlan
from .record import Invocation
from .worker import RunContext, make_selector, package_versions

_DEEPEST = 20
"""Maximum depth of lists and maps in metadata that is recorded as such."""


def run_identity(run: RunContext[Any], plan: RunPlan, buffer_set: BufferSet) -> dict[str, Any]:
    """Return what can change a result, as plain values: it identifies the run."""
    config = run.config
    return {
        "system": run.system,
        "facts": to_dict(run.facts),
        "simulator": config.simulator,
        "revision": run.revision,
        "split": config.split,
        "shift": config.shift,
        "training_seed": run.training_seed,
        "model_seed": config.model_seed,
        "retrieval_index": _retrieval_index(config, plan, buffer_set),
        "protocol_version": PROTOCOL_VERSION,
        **run.identity,
    }


def _retrieval_index(config: RetrievalConfig, plan: RunPlan, buffer_set: BufferSet) -> Any:
    """Return what the retrieval step depends on; raise if a planned condition lacks its index."""
    selector = make_selector(config)
    if selector is None:
        return None
    index = None  # the same for all: the buffers of a condition need the same datasets
    for name in plan.conditions:
        index = selector.identity(next(buffer_set.buffers(condition=name)))
    return plain(index)


def retrieval_text(config: RetrievalConfig, buffer_set: BufferSet) -> str | None:
    """Return the retrieval step of a run as `SystemFacts` have it; None if it has none."""
    if config.retrieval is None:
        return None
    from robomme_interference_data.retrieval.selector import RetrievalStep

    step = RetrievalStep(
        config.retrieval, rule=config.retrieval_rule, camera=config.retrieval_camera
    )
    return step.label(buffer_set.datasets[DEMONSTRATIONS])


def short_digest(identity: Mapping[str, Any]) -> str:
    """Return what identifies a policy or a model in a column: 16 letters of a SHA-256."""
    return digest_json([identity])[:16]


def invocation(run: RunContext[Any], plan: RunPlan, command: Sequence[str]) -> Invocation:
    """Return the record of an invocation that begins now."""
    return Invocation(
        command=tuple(map(plain, command)),
        settings=plain(dataclasses.asdict(run.config)),
        plan=plan,
        versions=package_versions(run.config) | dict(run.versions),
        git=_git(),
        machine=platform.machine(),
        policy=dict(run.metadata),
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
    # Of an installed package, git finds whatever repository the environment lies in.
    return done.stdout.strip() if (root / ".git").exists() else None


def plain(value: Any, depth: int = 0) -> Any:
    """Return a value as the files of a run can hold it; `ValueError` for NaN or an infinity.

    Integers above 63 bits, long arrays, and what is nested too deeply become text.
    """
    if isinstance(value, np.generic | np.ndarray):
        large = value.size > 32
        value = f"{value.dtype} array {value.shape}" if large else value.tolist()
    if isinstance(value, Mapping | list | tuple) and depth >= _DEEPEST:
        value = f"{type(value).__name__} of {len(value)}"
    if isinstance(value, Mapping):
        pairs = [(plain(str(key)), plain(entry, depth + 1)) for key, entry in value.items()]
        return dict(sorted(pairs, key=itemgetter(0)))  # in the order in which JSON is written
    if isinstance(value, list | tuple):
        return [plain(entry, depth + 1) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        raise ValueError(str(value))
    if value is None or isinstance(value, float):
        return value
    if isinstance(value, int):  # a bool too
        return value if -(1 << 63) <= value < 1 << 63 else hex(value)
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else repr(value)
    return str(text).encode("utf-8", "backslashreplace").decode()
