"""What a run is: its settings, which of them make it that run, and the header that says so."""

import platform
import re
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass, fields
from importlib import metadata
from pathlib import Path
from typing import Any

from robomme_interference_data.errors import InvalidOptionError, RunFolderError
from robomme_interference_data.evaluate.rows import PROTOCOL_VERSION

__all__ = [
    "IDENTITY",
    "RunConfig",
    "check_same_run",
    "default_system",
    "identity",
    "provenance",
]

IDENTITY = (
    "system",
    "policy",
    "memory",
    "simulator",
    "split_name",
    "revision",
    "episode_split",
    "model_seed",
    "retrieval",
    "retrieval_threshold",
)
"""Settings that can change a result: two runs that differ in one of them never share a folder."""


@dataclass(frozen=True)
class RunConfig:
    """The settings of a run.

    Attributes:
        system: Name under which the rows stand.
        policy: Which policy, as `make_policy` reads it.
        memory: Memory rule of `replay`; None for other policies.
        simulator: Name of the simulator.
        split: Folder of the split of buffers.
        split_name: `Split.name`.
        revision: `Split.revision`.
        episode_split: `train`, `val` or `test`.
        model_seed: Seed for the policy.
        retrieval: Encoder of the retrieval step, or None.
        retrieval_threshold: Cosine below which it cuts, or None for the encoder's own rule.
        robomme_python: Interpreter of the official simulator, or None.
        check_lesson: Whether to compare the dataset's lesson with the simulator's.
        videos: Whether to write videos.
        workers: Worker processes.
        rollout_s: Seconds that a rollout may take.
        simulator_s: Seconds that a reset, or up to 16 steps, may take.
        cache: Whether to keep decoded history frames on disk, for later conditions and runs.
        history_chunk: Frames of history handed over at a time.
        max_errors: Errors in a row after which the run stops.
    """

    system: str
    policy: str
    memory: str | None
    simulator: str
    split: str
    split_name: str
    revision: str
    episode_split: str = "test"
    model_seed: int = 0
    retrieval: str | None = None
    retrieval_threshold: float | None = None
    robomme_python: str | None = None
    check_lesson: bool = False
    videos: bool = False
    workers: int = 1
    rollout_s: float = 3600.0
    simulator_s: float = 1800.0
    cache: bool = False
    history_chunk: int = 64
    max_errors: int = 10


EXECUTION = tuple(f.name for f in fields(RunConfig) if f.name not in IDENTITY)
"""Settings of how a run is carried out: a run may be resumed with others."""


def default_system(policy: str, memory: str | None, retrieval: bool) -> str:
    """Return the name under which rows stand if none is given.

    Raises:
        InvalidOptionError: The policy does not say which system it is.
    """
    kind, _, target = policy.partition(":")
    if kind == "websocket":
        raise InvalidOptionError(
            f"the rows of {policy} need the name of the system that it serves",
            "Give --system, such as perceptual-framesamp-modul, or a name of your own: see "
            "docs/systems.md.",
        )
    name = re.sub(r"[^A-Za-z0-9._-]+", "-", target.rstrip("/").split("/")[-1]).strip("-")
    if policy == "replay":
        name = f"replay-{memory or 'full'}"
    name = name or policy
    return f"retrieval-{name}" if retrieval else name


def identity(config: RunConfig) -> dict[str, Any]:
    """Return what makes the run the one that it is, as plain values."""
    return {name: getattr(config, name) for name in IDENTITY} | {
        "protocol_version": PROTOCOL_VERSION
    }


def check_same_run(folder: Path, found: Mapping[str, Any], wanted: Mapping[str, Any]) -> None:
    """Check that a folder's run is the one that is wanted.

    Raises:
        RunFolderError: It is another; names every difference.
    """
    names = sorted({*found, *wanted}, key=lambda name: (name not in wanted, name))
    differing = [name for name in names if found.get(name) != wanted.get(name)]
    if differing:
        told = "; ".join(
            f"{name} is {found.get(name)!r} there, {wanted.get(name)!r} here" for name in differing
        )
        raise RunFolderError(
            f"{folder} holds another run: {told}",
            "Give another --out, or the settings of the run that is there (see run.json).",
        )


def provenance(command: list[str]) -> dict[str, Any]:
    """Return what produced a run: command, versions, and the state of the source tree."""
    versions = {"python": platform.python_version()}
    for name in ("robomme-interference-data", "numpy", "av", "mani-skill", "sapien", "torch"):
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {"command": command, "versions": versions, "git": _git(), "machine": platform.machine()}


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
